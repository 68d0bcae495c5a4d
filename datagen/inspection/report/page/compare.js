// SPDX-License-Identifier: MIT
// Compares predicted maps with the ground truth: the report's section with its tables, and pictures for the viewer.
// A picture is named `predicted:METHOD:MAP` or `error:METHOD:MAP`.
"use strict";

REPORT.compare = (() => {
  const { element, loadTile } = REPORT;
  const SHORT = { diffuse_albedo: "D", specular_albedo: "S", roughness: "R" };
  const MORE = 20; // rows that are added to the table of views at a time

  const methods = () => REPORT.predictions.methods;
  const methodOf = (slug) => methods().find((m) => m.slug === slug);
  const maps = () => REPORT.predictions.maps;

  // ---------------------------------------------------------------- pictures of the viewer

  let rowOf = null; // configuration/view -> row of the errors
  function errorsOf(slug, key) {
    if (!rowOf) {
      const { columns, rows, configurations } = REPORT.views;
      const name = columns.indexOf("name");
      rowOf = new Map(rows.map((cells, row) => [`${configurations[cells[0]][0]}/${cells[name]}`, row]));
    }
    const found = REPORT.predictions.errors[slug][rowOf.get(key)];
    return found ? { mse: found.slice(0, 3), has: maps().filter((_, bit) => found[3] & (1 << bit)) } : null;
  }

  function describe(name) {
    const [kind, slug, map] = name.split(":");
    if (kind !== "predicted" && kind !== "error") return null;
    const truth = REPORT.summary.buffers.find((b) => b.name === map), { label } = methodOf(slug);
    return kind === "predicted"
      ? { ...truth, name, kind, slug, map, label: `${SHORT[map]}, ${label}`, description: `${truth.description}, predicted by ${label}` }
      : { ...truth, name, kind, slug, map, label: `|error| of ${SHORT[map]}, ${label}`, description: `absolute difference of ${label}'s prediction and the ground truth; the colour is its mean over the channels` };
  }

  // Names of a view's pictures for a method, up to three per map: truth, prediction, error.
  function namesOf(slug, key, available) {
    const has = errorsOf(slug, key)?.has ?? [];
    return maps().filter((map) => available.includes(map)).flatMap((map) => has.includes(map) ? [map, `predicted:${slug}:${map}`, `error:${slug}:${map}`] : [map]);
  }

  class ErrorPicture {
    constructor(truth, predicted) {
      if (truth.width !== predicted.width || truth.height !== predicted.height) throw new Error("prediction and truth differ in size");
      Object.assign(this, { truth, predicted, dtype: "float", width: truth.width, height: truth.height, channels: truth.channels, numPixels: truth.numPixels });
    }
    all(i) { return Array.from({ length: this.channels }, (_, c) => Math.abs(this.predicted.at(c, i) - this.truth.at(c, i))); }
    // the value that is painted: the mean over the channels
    at(_, i) {
      let sum = 0;
      for (let c = 0; c < this.channels; c++) sum += Math.abs(this.predicted.at(c, i) - this.truth.at(c, i));
      return sum / this.channels;
    }
  }

  // The picture with a name; `get` returns the view's other pictures.
  async function picture(name, stem, get) {
    const [kind, slug, map] = name.split(":");
    if (kind === "predicted") return loadTile(`predictions/${slug}/${stem}/${map}`);
    const [truth, predicted] = await Promise.all([get(map), get(`predicted:${slug}:${map}`)]);
    return new ErrorPicture(truth, predicted);
  }

  // ---------------------------------------------------------------- section of the report

  // three digits, which are easily compared in tables
  const figure = (value) => (value === null || value === undefined ? "unknown" : value === 0 ? "0" : value < 1e-4 ? value.toExponential(2) : value.toPrecision(3));

  const count = (number, what) => `${number} ${what}${number === 1 ? "" : "s"}`;

  function mean(errors) {
    const known = errors.slice(0, 3).filter((value) => value !== null);
    return known.length ? known.reduce((a, b) => a + b, 0) / known.length : null;
  }

  function totals() {
    const best = Object.fromEntries(maps().map((map) => [map, Math.min(...methods().map((m) => m.total[map] ?? Infinity))]));
    const cell = (m, map) => {
      const text = figure(m.total[map]);
      return methods().length > 1 && m.total[map] === best[map] ? element("b", { text, title: "the lowest error of all methods" }) : text;
    };
    return REPORT.charts.table(["method", "views", ...maps().map((map) => `MSE of ${SHORT[map]}`), "not predicted", "with problems"],
      methods().map((m) => [m.label, m.num_views, ...maps().map((map) => cell(m, map)), m.num_missing, m.num_problems]), "Errors of the whole dataset by method");
  }

  function troubles(method) {
    const link = (key) => element("a", { href: `#view/${key}?method=${method.slug}`, text: key });
    const parts = [];
    if (method.num_problems) parts.push(element("details", { class: "problems", open: method.num_problems <= 10 },
      element("summary", { text: `${method.label}: ${count(method.num_problems, "prediction")} with problems` }),
      element("ul", {}, ...method.problems.map(([id, view, text]) => element("li", {}, link(`${id}/${view}`), `: ${text}`)))));
    if (method.num_missing) parts.push(element("details", { class: "problems" },
      element("summary", { text: `${method.label}: ${count(method.num_missing, "view")} not predicted` }),
      element("p", {}, ...method.missing.flatMap((key) => [link(key), " "]), method.num_missing > method.missing.length ? `and ${method.num_missing - method.missing.length} more` : "")));
    return parts;
  }

  function fill() {
    const home = document.getElementById("predictions");
    if (!methods().length) {
      home.append(element("p", { class: "note", text: "No predictions were given. To compare predicted maps with the ground truth: datagen report DATASET --predictions FOLDER." }));
      return;
    }
    const method = element("select", { id: "worst-method", onchange: rank }, ...methods().map((m) => element("option", { value: m.slug, text: m.label })));
    const map = element("select", { id: "worst-map", onchange: rank }, element("option", { value: "", text: "D, S and R (mean)" }), ...maps().map((name) => element("option", { value: name, text: SHORT[name] })));
    const body = element("tbody"), more = element("button", { type: "button", text: "show more", onclick: () => show(MORE) });
    let order = [], shown = 0;
    function rank() {
      const at = maps().indexOf(map.value), errors = REPORT.predictions.errors[method.value];
      const value = (row) => { const e = errors[row.order]; return e ? (at < 0 ? mean(e) : e[at]) : null; };
      order = REPORT.gallery.all().filter((row) => errors[row.order]).map((row) => [row, value(row)]);
      order.sort((a, b) => (b[1] ?? Infinity) - (a[1] ?? Infinity) || a[0].order - b[0].order); // unknown errors come first
      body.replaceChildren();
      shown = 0;
      show(MORE);
    }
    function show(howMany) {
      for (const [row] of order.slice(shown, shown + howMany)) {
        const open = `#view/${row.key}?method=${method.value}`;
        body.append(element("tr", { "data-view": row.key },
          element("th", { scope: "row" }, element("a", { href: open, class: "pictured" }, REPORT.overview.thumbnail(row.id, row.name), element("span", { text: row.key }))),
          ...methods().flatMap((m) => maps().map((name, k) => {
            const errors = REPORT.predictions.errors[m.slug][row.order];
            return element("td", { class: "number", text: errors ? figure(errors[k]) : "none" });
          }))));
      }
      shown += howMany;
      more.hidden = shown >= order.length;
    }
    home.append(
      element("p", { class: "note", text: "Mean squared errors of linear values over surface pixels; those of the whole dataset are means over all predicted pixels." }),
      totals(), ...methods().flatMap(troubles),
      element("h3", { text: "Views, worst first" }),
      element("form", { class: "controls", onsubmit: (event) => event.preventDefault() }, element("label", {}, "by the error of ", method), element("label", {}, "in ", map)),
      element("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Errors by view" }, element("table", { id: "worst-views" },
        element("caption", { class: "unseen", text: "Mean squared errors by view and method" }),
        element("thead", {},
          methods().length > 1 ? element("tr", {}, element("td"), ...methods().map((m) => element("th", { scope: "colgroup", colspan: 3, text: m.label }))) : null,
          element("tr", {}, element("th", { scope: "col", text: "view" }), ...methods().flatMap(() => maps().map((name) => element("th", { scope: "col", text: `MSE of ${SHORT[name]}` }))))),
        body)), more);
    rank();
  }

  // Orders of the gallery: mean error of a method, views without a prediction last.
  function orders() {
    return Object.fromEntries(methods().map((m) => [`largest error, ${m.label}`, (row) => {
      const errors = REPORT.predictions.errors[m.slug][row.order];
      return errors ? -(mean(errors) ?? Infinity) : 1;
    }]));
  }

  return { fill, orders, methods, methodOf, describe, namesOf, errorsOf, picture, figure };
})();
