// SPDX-License-Identifier: MIT
// Recomputes a pixel's statistics: projects its surface point into each chosen view and fetches the colour there, as
// the statistics do (datagen/multiview/statistics.py: fetch_bilinear). Letters: p the world point, (u, v) its
// projection in pixels, z its depth in that view.
"use strict";

REPORT.sources = (() => {
  const { element, loadTile } = REPORT;
  const NO_VIEW = 65535, PATCH = 25, SIDE = 100;

  function unproject(camera, x, y, depth) {
    const local = [((x + 0.5 - camera.cx_px) / camera.fx_px) * depth, ((y + 0.5 - camera.cy_px) / camera.fy_px) * depth, depth];
    return [0, 1, 2].map((r) => camera.world_from_camera[r].slice(0, 3).reduce((a, m, k) => a + m * local[k], camera.world_from_camera[r][3]));
  }

  function project(camera, p) {
    const offset = [0, 1, 2].map((k) => p[k] - camera.world_from_camera[k][3]);
    const local = [0, 1, 2].map((c) => [0, 1, 2].reduce((a, r) => a + camera.world_from_camera[r][c] * offset[r], 0));
    return { u: (camera.fx_px * local[0]) / local[2] + camera.cx_px, v: (camera.fy_px * local[1]) / local[2] + camera.cy_px, z: local[2], distance: Math.hypot(...offset) };
  }

  // Colour interpolated from the four pixels around the projection, without those of another depth.
  function fetchColor(beauty, depth, at) {
    const { width, height } = beauty;
    const x = Math.max(0, Math.min(width - 1, at.u - 0.5)), y = Math.max(0, Math.min(height - 1, at.v - 0.5));
    const left = Math.floor(x), top = Math.floor(y);
    const tolerance = at.z * REPORT.summary.depth_agreement;
    const total = [0, 0, 0];
    let weights = 0;
    for (const [dx, dy] of [[0, 0], [1, 0], [0, 1], [1, 1]]) {
      const i = Math.min(top + dy, height - 1) * width + Math.min(left + dx, width - 1);
      let weight = (dx ? x - left : 1 - x + left) * (dy ? y - top : 1 - y + top);
      if (!(Math.abs(depth.at(0, i) - at.z) <= tolerance)) weight = 0;
      for (let c = 0; c < 3; c++) total[c] += weight * beauty.at(c, i);
      weights += weight;
    }
    if (weights > 1e-3) return total.map((value) => value / weights);
    return beauty.all(Math.floor(at.v) * width + Math.floor(at.u));
  }

  function orderStatistics(colors) {
    return [0, 1, 2].map((c) => {
      const sorted = colors.map((color) => color[c]).sort((a, b) => a - b);
      const num = sorted.length;
      return { min: sorted[0], median: 0.5 * (sorted[(num - 1) >> 1] + sorted[num >> 1]), max: sorted[num - 1] };
    });
  }

  // The chosen views of pixel (x, y): name, projection, distance and colour, best first.
  async function find(configuration, view, x, y, isCurrent = () => true) {
    const stem = `${configuration.id}/`;
    const [chosen, depth, beauty] = await Promise.all(["sources", "depth_z_m", "beauty"].map((name) => loadTile(`${stem}${view.name}/${name}`)));
    const pixel = y * chosen.width + x;
    const indices = chosen.all(pixel).filter((index) => index !== NO_VIEW);
    const p = unproject(view.camera, x, y, depth.at(0, pixel));
    const found = [];
    for (const index of indices) { // in sequence, for at most two more pictures in memory
      if (!isCurrent()) return null;
      const other = configuration.views[index];
      const isOwn = other.name === view.name;
      const at = isOwn ? { ...project(view.camera, p), u: x + 0.5, v: y + 0.5 } : project(other.camera, p);
      const [otherBeauty, otherDepth] = isOwn ? [beauty, depth] : await Promise.all(["beauty", "depth_z_m"].map((name) => loadTile(`${stem}${other.name}/${name}`)));
      const color = isOwn ? beauty.all(pixel) : fetchColor(otherBeauty, otherDepth, at);
      found.push({ view: other, isOwn, at, color, patch: patchOf(otherBeauty, at) });
    }
    return found;
  }

  function patchOf(beauty, at) {
    const half = PATCH >> 1, left = Math.floor(at.u) - half, top = Math.floor(at.v) - half;
    const colors = [];
    for (let y = top; y < top + PATCH; y++) for (let x = left; x < left + PATCH; x++) {
      colors.push(x < 0 || y < 0 || x >= beauty.width || y >= beauty.height ? null : beauty.all(y * beauty.width + x));
    }
    return colors;
  }

  function drawPatch(canvas, patch, exposure) {
    canvas.width = canvas.height = PATCH;
    const context = canvas.getContext("2d");
    const image = context.createImageData(PATCH, PATCH);
    patch.forEach((color, i) => {
      for (let c = 0; c < 3; c++) image.data[4 * i + c] = color ? REPORT.panels.srgbByte(color[c] * exposure) : 46;
      image.data[4 * i + 3] = 255;
    });
    context.putImageData(image, 0, 0);
  }

  function listNode(configuration, found, exposure, format) {
    return element("ol", { class: "sources" }, ...found.map((source) => {
      const canvas = element("canvas", { width: PATCH, height: PATCH, style: `width:${SIDE}px;height:${SIDE}px`, role: "img", "aria-label": `${source.view.name} around the point` });
      drawPatch(canvas, source.patch, exposure);
      const [u, v] = [Math.floor(source.at.u), Math.floor(source.at.v)];
      return element("li", { "data-view": source.view.name },
        element("a", { href: `#view/${configuration.id}/${source.view.name}@${u},${v}`, title: "open this view at this pixel" }, element("span", { class: "patch" }, canvas),
          element("span", { text: `${source.view.name}${source.isOwn ? " (this view)" : ""} at ${u}, ${v}; ${source.at.distance.toFixed(2)} m` })),
        element("code", { text: source.color.map(format).join("  ") }));
    }));
  }

  return { find, orderStatistics, listNode };
})();
