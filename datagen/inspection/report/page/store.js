// SPDX-License-Identifier: MIT
// Loads pixels and cameras on demand. A page opened from disk may not read files. Cameras are scripts. Tiles are
// pages (tile.html) in sandboxed frames, which a browser runs in a separate process: their text, which it would
// otherwise keep until it collects garbage, is freed with that process. Decoded tiles are cached up to a limit; the
// least recently used are evicted first.
"use strict";

var REPORT = (() => {
  const MAX_BYTES = 40 << 20; // of decoded tiles that are kept
  const MAX_FRAME_BYTES = 12 << 20; // of tiles decoded by one process
  const MAX_FRAMES = 3; // that decode at the same time
  const MAX_SILENCE_MS = 10000; // from a frame's load event to its first message
  const loading = new Map(); // key -> promise
  const kept = new Map(); // key -> image, oldest first
  let keptBytes = 0;
  let numRequested = 0;

  // the value of every half float
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
    return new Promise((resolve, reject) => {
      const script = document.createElement("script");
      script.src = source;
      script.onload = () => { script.remove(); resolve(); };
      script.onerror = () => { script.remove(); reject(new Error(`${source} cannot be loaded`)); };
      document.head.append(script);
    });
  }

  class Picture {
    constructor(head, buffer) {
      Object.assign(this, head); // key, dtype, width, height, channels
      this.words = new { half: Uint16Array, ushort: Uint16Array, uint: Uint32Array, float: Float32Array }[head.dtype](buffer);
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

  // Frames that decode. The last finished frame stays until the next one finishes, which keeps their common process;
  // after MAX_FRAME_BYTES all are removed, and the next frame starts a new process.
  const queue = []; // {key, resolve, reject}, oldest first
  const working = new Map(); // key -> entry of the queue with its frame
  let lastFrame = null, frameBytes = 0;

  function startFrames() {
    while (queue.length && working.size < MAX_FRAMES) {
      const job = queue.shift();
      job.frame = element("iframe", { sandbox: "allow-scripts", src: `tiles/${job.key}.html`, title: "pixels", hidden: true, tabindex: "-1" });
      // for a missing page the browser loads its error page, which sends no message
      job.frame.addEventListener("load", () => { job.timer ??= setTimeout(() => finish(job, { error: "cannot be loaded" }), MAX_SILENCE_MS); });
      working.set(job.key, job);
      numRequested++;
      document.body.append(job.frame);
    }
  }

  function finish(job, told) {
    clearTimeout(job.timer);
    working.delete(job.key);
    if (lastFrame) lastFrame.remove();
    lastFrame = job.frame;
    frameBytes += told.words ? told.words.byteLength : 0;
    if (frameBytes > MAX_FRAME_BYTES && !working.size) {
      lastFrame.remove();
      lastFrame = null;
      frameBytes = 0;
    }
    if (told.words) job.resolve(new Picture(told.head, told.words));
    else job.reject(new Error(`tiles/${job.key}.html: ${told.error}`));
    if (frameBytes <= MAX_FRAME_BYTES) startFrames();
  }

  window.addEventListener("message", (event) => {
    const job = event.data && working.get(event.data.key);
    if (!job || event.source !== job.frame.contentWindow) return;
    if (!event.data.isRead) return finish(job, event.data);
    clearTimeout(job.timer);
    job.timer = 0; // the frame responds and needs no timer
  });

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
      queue.push({ key, resolve, reject });
      startFrames();
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
        if (!arrived.has(id)) throw new Error(`configurations/${id}.js does not contain this configuration`);
        return arrived.get(id);
      });
      promise.catch(() => configurations.delete(id));
      configurations.set(id, promise);
    }
    return configurations.get(id);
  }

  return {
    half, element, loadTile, loadConfiguration,
    configuration(data) { arrived.set(data.id, data); },
    state: () => ({ keptBytes, numKept: kept.size, numRequested }),
  };
})();
