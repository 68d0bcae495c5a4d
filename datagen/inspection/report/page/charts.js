// SPDX-License-Identifier: MIT
// Draws histograms, the coverage map and tables as SVG and HTML that can be read without colour.
"use strict";

REPORT.charts = (() => {
  const { element } = REPORT;
  const WIDTH = 340, HEIGHT = 130, LEFT = 44, BOTTOM = 22, TOP = 8, RIGHT = 18;

  function svg(tag, attributes = {}, text) {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    if (text !== undefined) node.textContent = text;
    return node;
  }

  function number(value, digits = 3) {
    if (value === null || value === undefined) return "unknown";
    if (!Number.isFinite(value)) return String(value);
    if (value !== 0 && (Math.abs(value) >= 1e6 || Math.abs(value) < 1e-3)) return value.toExponential(1);
    if (Number.isInteger(value)) return value.toLocaleString("en-GB");
    return String(Number(value.toPrecision(digits)));
  }

  function percent(share) {
    const value = 100 * share;
    return `${value >= 10 || value === 0 ? value.toFixed(0) : value >= 0.1 ? value.toFixed(1) : value.toPrecision(1)} %`;
  }

  function bytes(count) {
    for (const [unit, size] of [["TB", 1e12], ["GB", 1e9], ["MB", 1e6], ["kB", 1e3]]) {
      if (count >= size) return `${(count / size).toFixed(count < 10 * size ? 2 : 0)} ${unit}`;
    }
    return `${count} bytes`;
  }

  function quantile(figure, share) {
    const total = figure.counts.reduce((a, b) => a + b, 0);
    let before = 0;
    for (let i = 0; i < figure.counts.length; i++) {
      const inside = figure.counts[i];
      if (inside && before + inside >= share * total) {
        const at = (share * total - before) / inside;
        const [low, high] = [figure.edges[i], figure.edges[i + 1]];
        if (figure.scale === "whole") return (low + high) / 2;
        return figure.scale === "log" ? low * (high / low) ** at : low + at * (high - low);
      }
      before += inside;
    }
    return NaN;
  }

  function ticks(figure) {
    const low = figure.edges[0], high = figure.edges[figure.edges.length - 1];
    if (figure.scale === "log") {
      const found = [];
      const decades = Math.log10(high / low);
      for (let e = Math.ceil(Math.log10(low) - 1e-9); e <= Math.log10(high) + 1e-9; e += Math.max(1, Math.round(decades / 5))) found.push(10 ** e);
      return found;
    }
    const raw = Math.max((high - low) / 5, figure.scale === "whole" ? 1 : 0);
    const size = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((k) => k * size).find((s) => s >= raw * 0.999);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) found.push(k * step || 0); // never -0
    return found;
  }

  function histogram(figure) {
    const total = figure.counts.reduce((a, b) => a + b, 0);
    const tallest = Math.max(...figure.counts, 1);
    const low = figure.edges[0], high = figure.edges[figure.edges.length - 1];
    const place = (v) => LEFT + (WIDTH - LEFT - RIGHT) * (figure.scale === "log" ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low));
    const base = HEIGHT - BOTTOM;
    const spoken = total
      ? `Histogram of ${figure.title}${figure.unit === "1" ? "" : ` in ${figure.unit}`} over ${number(total)} ${figure.what}: median ${number(quantile(figure, 0.5))}, 90 percent between ${number(quantile(figure, 0.05))} and ${number(quantile(figure, 0.95))}`
      : `Histogram of ${figure.title}: nothing to count`;
    const picture = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": spoken });
    for (const share of [0.5, 1]) {
      const y = base - (base - TOP) * share;
      picture.append(svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y, y2: y, class: "grid" }));
      picture.append(svg("text", { x: LEFT - 5, y: y + 4, class: "tick end" }, percent((share * tallest) / Math.max(total, 1))));
    }
    figure.counts.forEach((count, i) => {
      if (!count) return;
      const x = place(figure.edges[i]), height = Math.max(0.75, ((base - TOP) * count) / tallest);
      const bar = svg("rect", { x, y: base - height, width: Math.max(place(figure.edges[i + 1]) - x - 0.6, 0.5), height, class: "bar" });
      bar.append(svg("title", {}, `${number(figure.edges[i])} to ${number(figure.edges[i + 1])}: ${number(count)} (${percent(count / total)})`));
      picture.append(bar);
    });
    picture.append(svg("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: base, y2: base, class: "axis" }));
    for (const at of ticks(figure)) {
      picture.append(svg("line", { x1: place(at), x2: place(at), y1: base, y2: base + 4, class: "axis" }));
      picture.append(svg("text", { x: place(at), y: HEIGHT - 5, class: "tick middle" }, number(at)));
    }
    const facts = total ? `median ${number(quantile(figure, 0.5))}, 90 % in ${number(quantile(figure, 0.05))} to ${number(quantile(figure, 0.95))}` : "nothing to count";
    return element("figure", { class: "chart" },
      element("figcaption", {}, element("b", { text: figure.title }), `${figure.unit === "1" ? "" : ` [${figure.unit}]`}, ${figure.what}`, element("span", { class: "facts", text: facts })),
      picture,
      lazyTable(`Numbers of ${figure.title}`, ["from", "to", figure.what], () => figure.counts.map((count, i) => [number(figure.edges[i], 4), number(figure.edges[i + 1], 4), number(count)])));
  }

  // A folded table, built when it is first opened.
  function lazyTable(label, head, makeRows) {
    const details = element("details", {}, element("summary", { text: "numbers", "aria-label": label }));
    details.addEventListener("toggle", () => {
      if (details.open && !details.querySelector("table")) details.append(table(head, makeRows(), label));
    });
    return details;
  }

  // Cells are text or nodes; columns of numbers are aligned right.
  function table(head, rows, label) {
    const isNumber = (cell) => typeof cell === "number" || /^[-\d.,e+]+( %| [kMGT]?B)?$/.test(cell);
    return element("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label },
      element("table", {},
        element("caption", { class: "unseen", text: label }),
        element("thead", {}, element("tr", {}, ...head.map((text) => element("th", { scope: "col", text })))),
        element("tbody", {}, ...rows.map((row) => element("tr", {}, ...row.map((cell) =>
          cell instanceof Node ? element("td", { class: isNumber(cell.textContent) ? "number" : null }, cell) : element("td", { text: typeof cell === "number" ? number(cell) : cell, class: isNumber(cell) ? "number" : null })))))));
  }

  function cssColor(share) {
    const map = REPORT.summary.color_map;
    const [r, g, b] = map[Math.max(0, Math.min(255, Math.round(share * 255)))];
    return `rgb(${r},${g},${b})`;
  }

  // R upwards, luminance of D to the right; colours are shares on a logarithmic scale.
  function heatMap(coverage) {
    const cells = coverage.cells, num = cells.length, side = 11, left = 54, top = 8;
    const total = Math.max(cells.flat().reduce((a, b) => a + b, 0), 1);
    const size = num * side;
    const picture = svg("svg", { viewBox: `0 0 ${left + size + 90} ${top + size + 40}`, role: "img", class: "heat",
      "aria-label": `Coverage of roughness against luminance of D: ${percent(coverage.filled_share)} of ${num} by ${num} cells contain pixels; missing regions are listed next to it` });
    picture.append(svg("rect", { x: left, y: top, width: size, height: size, class: "empty" }));
    const scale = (count) => Math.max(0, Math.min(1, 1 + Math.log10(count / total) / 6));
    cells.forEach((row, r) => row.forEach((count, l) => {
      if (!count) return;
      const cell = svg("rect", { x: left + l * side, y: top + size - (r + 1) * side, width: side, height: side, fill: cssColor(scale(count)) });
      cell.append(svg("title", {}, `R ${number(r / num)} to ${number((r + 1) / num)}, luminance ${number(l / num)} to ${number((l + 1) / num)}: ${percent(count / total)}`));
      picture.append(cell);
    }));
    for (let k = 0; k <= 4; k++) {
      picture.append(svg("text", { x: left - 6, y: top + size - (k * size) / 4 + 4, class: "tick end" }, k / 4));
      picture.append(svg("text", { x: left + (k * size) / 4, y: top + size + 15, class: "tick middle" }, k / 4));
    }
    picture.append(svg("text", { x: left + size / 2, y: top + size + 33, class: "tick middle" }, "luminance of D"));
    picture.append(svg("text", { x: 0, y: 0, class: "tick middle", transform: `translate(14 ${top + size / 2}) rotate(-90)` }, "roughness R"));
    for (let k = 0; k <= 60; k++) picture.append(svg("rect", { x: left + size + 16, y: top + size - ((k + 1) * size) / 61, width: 14, height: size / 61 + 0.5, fill: cssColor(k / 60) }));
    for (let k = 0; k <= 6; k += 2) picture.append(svg("text", { x: left + size + 36, y: top + size - (k * (size - 10)) / 6, class: "tick" }, k === 6 ? "100 %" : k === 4 ? "1 %" : k === 2 ? "0.01 %" : "10⁻⁴ %"));
    return picture;
  }

  return { histogram, heatMap, table, number, percent, bytes };
})();
