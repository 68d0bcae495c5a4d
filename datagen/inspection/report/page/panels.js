// SPDX-License-Identifier: MIT
// Converts stored numbers to screen pixels, and keeps the frame (zoom, centre) that all panels share.
"use strict";

REPORT.panels = (() => {
  const HATCH = [58, 46];

  function srgbByte(linear) {
    if (!(linear > 0)) return 0;
    const encoded = linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
    return Math.min(255, Math.round(255 * encoded));
  }

  // table of the sRGB byte of every half float at an exposure, which makes redrawing fast
  const tables = new Map();
  function screenTable(exposure) {
    if (!tables.has(exposure)) {
      const table = new Uint8Array(65536);
      for (let bits = 0; bits < 65536; bits++) table[bits] = srgbByte(REPORT.half[bits] * exposure);
      if (tables.size > 3) tables.delete(tables.keys().next().value);
      tables.set(exposure, table);
    }
    return tables.get(exposure);
  }

  function percentile(values, share) {
    const step = Math.max(1, Math.floor(values.length / 20000));
    const some = [];
    for (let i = 0; i < values.length; i += step) if (values[i] > 0) some.push(values[i]);
    some.sort((a, b) => a - b);
    return some.length ? some[Math.min(some.length - 1, Math.floor(share * some.length))] : 1;
  }

  // The scale of a buffer's colours, for drawing and for the legend above the picture. `high` of a scalar is at the bright
  // end of the colour map.
  function scaleOf(buffer, picture, view, exposure, maxError) {
    if (buffer.kind === "error") return { kind: "scalar", low: 0, high: maxError, needsSurface: true };
    if (buffer.is_radiance) return { kind: "color", exposure, legend: `× ${REPORT.charts.number(exposure)}, sRGB` };
    switch (buffer.map || buffer.name) {
      case "diffuse_albedo": case "specular_albedo": return { kind: "color", exposure: 1, legend: "sRGB", needsSurface: true };
      case "normal_world": return { kind: "normal", legend: "x y z as R G B", needsSurface: true };
      case "roughness": return { kind: "scalar", low: 0, high: 1, needsSurface: true };
      case "depth_z_m": {
        const high = percentile(picture.words, 0.98);
        return { kind: "scalar", low: 0, high, unit: "m", skipZero: true };
      }
      default: {
        const high = view.statistics ? Math.min(view.statistics.best_views, view.statistics.num_views) : 12;
        return { kind: "scalar", low: 0, high };
      }
    }
  }

  // Draw a picture, a pixel per value; `mask` (a Picture or null) is 0 where there is no surface.
  function paint(canvas, picture, scale, mask) {
    const { width, height, words, numPixels } = picture;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const out = image.data;
    const table = scale.kind === "color" ? screenTable(scale.exposure) : null;
    const map = REPORT.summary.color_map;
    for (let i = 0; i < numPixels; i++) {
      let red, green, blue, isValid = !(scale.needsSurface && mask && !(mask.at(0, i) > 0));
      if (scale.kind === "color") {
        red = table[words[i]]; green = table[words[numPixels + i]]; blue = table[words[2 * numPixels + i]];
        for (let c = 0; c < 3; c++) if ((words[c * numPixels + i] & 0x7c00) === 0x7c00) isValid = false; // NaN or Inf
      } else if (scale.kind === "normal") {
        red = 127.5 + 127.5 * picture.at(0, i); green = 127.5 + 127.5 * picture.at(1, i); blue = 127.5 + 127.5 * picture.at(2, i);
        if (!(red + green + blue < Infinity)) isValid = false;
      } else {
        const value = picture.at(0, i);
        if (!Number.isFinite(value) || (scale.skipZero && value === 0)) isValid = false;
        const share = (value - scale.low) / (scale.high - scale.low);
        [red, green, blue] = map[Math.max(0, Math.min(255, Math.round(255 * share))) || 0];
      }
      if (!isValid) red = green = blue = HATCH[((i % width) + Math.floor(i / width)) >> 2 & 1];
      const o = 4 * i;
      out[o] = red; out[o + 1] = green; out[o + 2] = blue; out[o + 3] = 255;
    }
    context.putImageData(image, 0, 0);
  }

  // The colour scale of a scalar with the values at its ends.
  function scaleBar(scale) {
    const text = (value) => `${REPORT.charts.number(value)}${scale.unit ? ` ${scale.unit}` : ""}`;
    const map = REPORT.summary.color_map, stops = [];
    for (let k = 0; k <= 16; k++) stops.push(`rgb(${map[Math.min(255, k * 16)]})`);
    return REPORT.element("span", { class: "scale", role: "img", "aria-label": `colours from ${text(scale.low)} to ${text(scale.high)}` },
      text(scale.low), REPORT.element("i", { style: `background:linear-gradient(90deg,${stops})` }), text(scale.high));
  }

  // The part of the picture that every panel shows.
  class Frame {
    constructor(width, height) { Object.assign(this, { width, height }); this.fit(); }
    fit() { this.zoom = 1; this.x = this.width / 2; this.y = this.height / 2; }
    scaleIn(canvas) { return Math.min(canvas.clientWidth / this.width, canvas.clientHeight / this.height) * this.zoom; }
    // from pixel coordinates to a canvas's coordinates in CSS pixels, and back
    toScreen(canvas, x, y) {
      const s = this.scaleIn(canvas);
      return [canvas.clientWidth / 2 + (x - this.x) * s, canvas.clientHeight / 2 + (y - this.y) * s];
    }
    toImage(canvas, sx, sy) {
      const s = this.scaleIn(canvas);
      return [this.x + (sx - canvas.clientWidth / 2) / s, this.y + (sy - canvas.clientHeight / 2) / s];
    }
    // zoom by a factor about the point (x, y) of the picture
    zoomAt(factor, x, y) {
      const zoom = Math.max(1, Math.min(64, this.zoom * factor));
      const ratio = this.zoom / zoom;
      this.x = x + (this.x - x) * ratio;
      this.y = y + (this.y - y) * ratio;
      this.zoom = zoom;
      this.clamp();
    }
    move(dx, dy) { this.x += dx; this.y += dy; this.clamp(); }
    clamp() {
      const [w, h] = [this.width / 2 / this.zoom, this.height / 2 / this.zoom];
      this.x = Math.max(w, Math.min(this.width - w, this.x));
      this.y = Math.max(h, Math.min(this.height - h, this.y));
    }
  }

  function prepare(canvas) {
    const ratio = window.devicePixelRatio || 1;
    const [w, h] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = "#17181a";
    context.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    return context;
  }

  function show(context, canvas, source, frame) {
    const s = frame.scaleIn(canvas);
    const [x, y] = frame.toScreen(canvas, 0, 0);
    context.imageSmoothingEnabled = s < 1;
    context.drawImage(source, x, y, frame.width * s, frame.height * s);
  }

  function drawCursor(context, canvas, frame, cursor) {
    if (!cursor) return;
    const s = frame.scaleIn(canvas);
    const [x, y] = frame.toScreen(canvas, cursor.x, cursor.y);
    const side = Math.max(s, 7), shift = (s - side) / 2;
    for (const [color, wide] of [["#000", 3], ["#fff", 1]]) {
      context.strokeStyle = color;
      context.lineWidth = wide;
      context.strokeRect(x + shift, y + shift, side, side);
    }
  }

  return { Frame, paint, scaleOf, scaleBar, prepare, show, drawCursor, srgbByte };
})();
