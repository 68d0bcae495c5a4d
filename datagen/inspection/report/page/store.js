// SPDX-License-Identifier: MIT
// Pixels and cameras, loaded when they are asked for. A page opened from disk may not read files, but it may
// load scripts: each tile is a script that calls REPORT.tile with its bytes (datagen/inspection/report/tiles.py
// fixes their form). Decoded tiles are kept up to a limit, the least recently used go first.
"use strict";

var REPORT = (() => {
  const MAX_BYTES = 48 << 20;
  const waiting = new Map(); // key -> {resolve, reject}
  const loading = new Map(); // key -> promise
  const kept = new Map(); // key -> image, oldest first
  let keptBytes = 0;
  let numRequested = 0;

  // every half float there is, as a number
  const half = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const mantissa = bits & 1023;
    half[bits] =
      exponent === 0 ? sign * mantissa * 2 ** -24
      : exponent === 31 ? (mantissa ? NaN : sign * Infinity)
      : sign * (1 + mantissa / 1024) * 2 ** (exponent - 15);
  }

  function element(tag, attributes = {}, ...children) {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "text") node.textContent = value;
      else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
      else if (value === true) node.setAttribute(name, "");
      else if (value !== false && value !== null && value !== undefined) node.setAttribute(name, value);
    }
    node.append(...children.filter((child) => child !== null && child !== undefined));
    return node;
  }

  function loadScript(source) {
    numRequested++;
    return new Promise((resolve, reject) => {
      const script = document.createElement("script");
      script.src = source;
      script.onload = () => { script.remove(); resolve(); };
      script.onerror = () => { script.remove(); reject(new Error(`${source} cannot be loaded`)); };
      document.head.append(script);
    });
  }

  // Scratch memory that every tile is decoded in: new buffers a tile would wait for the collector by the
  // hundred megabytes. Tiles are therefore decoded one after another.
  const scratch = [new Uint8Array(0), new Uint8Array(0)];
  let decoding = Promise.resolve();

  function scratchOf(which, size) {
    if (scratch[which].length < size) scratch[which] = new Uint8Array(size);
    return scratch[which].subarray(0, size);
  }

  function bytesOf(base64) {
    const padding = base64.endsWith("==") ? 2 : base64.endsWith("=") ? 1 : 0;
    const bytes = scratchOf(0, (base64.length / 4) * 3 - padding);
    if (bytes.setFromBase64) bytes.setFromBase64(base64);
    else {
      for (let start = 0, at = 0; start < base64.length; start += 65536) {
        const text = atob(base64.slice(start, start + 65536));
        for (let i = 0; i < text.length; i++) bytes[at++] = text.charCodeAt(i);
      }
    }
    return bytes;
  }

  async function inflate(bytes, size) {
    const raw = scratchOf(1, size);
    const stream = new DecompressionStream("deflate");
    const writer = stream.writable.getWriter();
    const wrote = writer.write(bytes).then(() => writer.close());
    wrote.catch(() => {}); // told by the reader too
    const reader = stream.readable.getReader();
    let at = 0;
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      if (at + value.length > size) throw new Error(`more than the expected ${size} bytes`);
      raw.set(value, at);
      at += value.length;
    }
    if (at !== size) throw new Error(`${at} bytes, expected ${size}`);
    return raw;
  }

  // Undo what encode_tile did: bytes gathered by their place in the word, differences along each row.
  function joinWords(raw, size, width, numRows) {
    const num = width * numRows;
    const words = size === 2 ? new Uint16Array(num) : new Uint32Array(num);
    let i = 0;
    for (let row = 0; row < numRows; row++) {
      let value = 0;
      for (let x = 0; x < width; x++, i++) {
        value = size === 2
          ? (value + raw[i] + (raw[num + i] << 8)) & 0xffff
          : (value + (raw[i] | (raw[num + i] << 8) | (raw[2 * num + i] << 16) | (raw[3 * num + i] << 24))) | 0;
        words[i] = value;
      }
    }
    return words;
  }

  class Picture {
    constructor(head, words) {
      Object.assign(this, head); // key, dtype, width, height, channels
      this.words = head.dtype === "float" ? new Float32Array(words.buffer) : words;
      this.numPixels = head.width * head.height;
    }
    // value of channel c at pixel i (row-major), as stored
    at(c, i) {
      const word = this.words[c * this.numPixels + i];
      return this.dtype === "half" ? half[word] : word;
    }
    all(i) {
      return Array.from({ length: this.channels }, (_, c) => this.at(c, i));
    }
  }

  // `carrier` is a function around a comment with the bytes in base64
  function tile(head, carrier) {
    const waits = waiting.get(head.key);
    if (!waits) return;
    waiting.delete(head.key);
    const size = head.dtype === "half" || head.dtype === "ushort" ? 2 : 4;
    const numRows = head.height * head.channels;
    decoding = decoding
      .then(() => {
        const source = carrier.toString();
        return inflate(bytesOf(source.slice(source.indexOf("/*") + 2, source.lastIndexOf("*/"))), head.width * numRows * size);
      })
      .then((raw) => waits.resolve(new Picture(head, joinWords(raw, size, head.width, numRows))))
      .catch((error) => waits.reject(new Error(`${head.key}: ${error.message}`)));
  }

  // The picture of `configuration/view/buffer`.
  function loadTile(key) {
    const found = kept.get(key);
    if (found) {
      kept.delete(key);
      kept.set(key, found);
      return Promise.resolve(found);
    }
    if (loading.has(key)) return loading.get(key);
    const promise = new Promise((resolve, reject) => {
      waiting.set(key, { resolve, reject });
      loadScript(`tiles/${key}.js`).catch((error) => { waiting.delete(key); reject(error); });
    }).then((picture) => {
      kept.set(key, picture);
      keptBytes += picture.words.byteLength;
      for (const [oldest, other] of kept) {
        if (keptBytes <= MAX_BYTES || oldest === key) break;
        kept.delete(oldest);
        keptBytes -= other.words.byteLength;
      }
      return picture;
    }).finally(() => loading.delete(key));
    loading.set(key, promise);
    return promise;
  }

  const configurations = new Map();
  const arrived = new Map();

  function loadConfiguration(id) {
    if (!configurations.has(id)) {
      const promise = loadScript(`configurations/${id}.js`).then(() => {
        if (!arrived.has(id)) throw new Error(`configurations/${id}.js holds something else`);
        return arrived.get(id);
      });
      promise.catch(() => configurations.delete(id));
      configurations.set(id, promise);
    }
    return configurations.get(id);
  }

  return {
    half, element, loadTile, loadConfiguration, tile,
    configuration(data) { arrived.set(data.id, data); },
    state: () => ({ keptBytes, numKept: kept.size, numRequested }),
  };
})();
