// SPDX-License-Identifier: MIT
// Shows every view as a thumbnail. Only rows near the visible part exist, so thousands of views remain fast.
"use strict";

REPORT.gallery = (() => {
  const { element } = REPORT;
  const MIN_CARD_WIDTH = 220, TEXT_HEIGHT = 64, EXTRA_ROWS = 2;
  let rows = [], shown = [], scroller, canvas, status, faults;

  let orders = {
    "as planned": null,
    "most findings first": (v) => -v.faults,
    "largest estimated error first": (v) => -(v.rel_mse ?? -1),
    "fewest observations first": (v) => v.mean_count ?? 1e9,
    "most samples first": (v) => -v.samples,
  };

  function readTable(data, found) {
    faults = new Map(found.views.map((v) => [`${v.configuration}/${v.view}`, v.errors * 1000 + v.warnings]));
    return data.rows.map((cells, order) => {
      const row = { order };
      data.columns.forEach((name, i) => { row[name] = cells[i]; });
      const [id, split, hasPixels] = data.configurations[row.configuration];
      Object.assign(row, { id, split, hasPixels, key: `${id}/${row.name}` });
      row.faults = faults.get(row.key) || 0;
      return row;
    });
  }

  function choose() {
    const split = document.getElementById("by-split").value;
    const text = document.getElementById("by-name").value.trim().toLowerCase();
    const rank = orders[document.getElementById("by-order").value];
    shown = rows.filter((v) => (!split || v.split === split) && (!text || v.key.toLowerCase().includes(text)));
    if (rank) shown.sort((a, b) => rank(a) - rank(b) || a.order - b.order);
    status.textContent = `${shown.length.toLocaleString("en-GB")} of ${rows.length.toLocaleString("en-GB")} views`;
    scroller.scrollTop = 0;
    draw(true);
  }

  const effort = (view) => [`${view.samples} samples`, view.rel_mse === null ? null : `error ${REPORT.charts.number(view.rel_mse, 2)}`].filter(Boolean).join(", ");

  let first = -1, last = -1, drawnWidth = 0;

  function draw(isForced = false) {
    const width = scroller.clientWidth;
    const columns = Math.max(2, Math.floor(width / MIN_CARD_WIDTH));
    const cardWidth = Math.floor(width / columns), cardHeight = Math.round(cardWidth / 1.6) + TEXT_HEIGHT;
    const numRows = Math.ceil(shown.length / columns);
    canvas.style.height = `${numRows * cardHeight}px`;
    canvas.style.setProperty("--card-width", `${cardWidth}px`);
    const from = Math.max(0, Math.floor(scroller.scrollTop / cardHeight) - EXTRA_ROWS);
    const to = Math.min(numRows, Math.ceil((scroller.scrollTop + scroller.clientHeight) / cardHeight) + EXTRA_ROWS);
    if (!isForced && from === first && to === last && width === drawnWidth) return;
    [first, last, drawnWidth] = [from, to, width];
    canvas.replaceChildren(...shown.slice(from * columns, to * columns).map((view, i) => {
      const index = from * columns + i;
      const more = [view.faults ? "findings" : null, view.split, view.mean_count === null ? null : `${view.mean_count.toFixed(1)} obs.`, view.hasPixels ? null : "no pixels"].filter(Boolean).join(", ");
      return element("li", { "aria-setsize": shown.length, "aria-posinset": index + 1, style: `top:${Math.floor(index / columns) * cardHeight}px;left:${(index % columns) * cardWidth}px` },
        element("a", { href: `#view/${view.key}`, class: view.faults >= 1000 ? "error" : view.faults ? "warning" : null }, REPORT.overview.thumbnail(view.id, view.name),
          element("span", { text: `${view.name}, ${view.id}` }), element("small", { text: more }),
          element("small", { text: effort(view) })));
    }));
  }

  function fill(data, found) {
    rows = readTable(data, found);
    orders = { ...orders, ...REPORT.compare.orders() };
    status = element("output", { "aria-live": "polite" });
    canvas = element("ul", { class: "cards-of-views" });
    scroller = element("div", { class: "gallery", tabindex: "0", role: "region", "aria-label": "All views" }, canvas);
    const splits = [...new Set(rows.map((v) => v.split))];
    document.getElementById("views").append(
      element("form", { class: "controls", onsubmit: (event) => event.preventDefault() },
        element("label", {}, "split ", element("select", { id: "by-split", onchange: choose }, element("option", { value: "", text: "all" }), ...splits.map((text) => element("option", { text })))),
        element("label", {}, "order ", element("select", { id: "by-order", onchange: choose }, ...Object.keys(orders).map((text) => element("option", { text })))),
        element("label", {}, "name contains ", element("input", { id: "by-name", type: "search", size: 16, oninput: choose })), status),
      scroller);
    scroller.addEventListener("scroll", () => requestAnimationFrame(() => draw()));
    new ResizeObserver(() => draw()).observe(scroller);
    choose();
  }

  return { fill, all: () => rows };
})();
