// SPDX-License-Identifier: MIT
// The report's sections, from data/summary.js.
"use strict";

REPORT.overview = (() => {
  const { element } = REPORT;
  const { table, number, percent, bytes, histogram, heatMap } = REPORT.charts;
  const section = (id) => document.getElementById(id);

  function duration(seconds) {
    if (seconds === null || seconds === undefined) return "unknown";
    if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
    if (seconds < 90) return `${seconds.toPrecision(3)} s`;
    return seconds < 5400 ? `${(seconds / 60).toFixed(1)} min` : `${(seconds / 3600).toFixed(1)} h`;
  }

  const count = (number, what) => `${number} ${what}${number === 1 ? "" : "s"}`;

  function cards(pairs) {
    return element("dl", { class: "cards" }, ...pairs.map(([name, value, more]) =>
      element("div", {}, element("dt", { text: name }), element("dd", {}, element("b", { text: value }), more ? element("span", { text: more }) : null))));
  }

  function viewLink(configuration, view, text) {
    return element("a", { href: `#view/${configuration}/${view}`, text: text || `${configuration} / ${view}` });
  }

  function thumbnail(configuration, view) {
    return element("img", { src: `thumbnails/${configuration}/${view}.jpg`, loading: "lazy", decoding: "async", width: 160, alt: `${configuration}, ${view}` });
  }

  // The first view of each of the first rooms.
  function rooms(sheets) {
    const { columns, rows, configurations } = REPORT.views;
    const [which, name] = [columns.indexOf("configuration"), columns.indexOf("name")];
    const first = new Map();
    for (const row of rows) if (!first.has(row[which])) first.set(row[which], row[name]);
    return element("ul", { class: "rooms" }, ...[...first].slice(0, 12).map(([number, view]) => {
      const [id, split] = configurations[number];
      return element("li", {}, element("a", { href: `#view/${id}/${view}` }, thumbnail(id, view), element("span", { text: `${id} (${split})` })),
        sheets[id] ? element("a", { class: "sheet", href: sheets[id], text: "contact sheet" }) : "");
    }));
  }

  function fillOverview(data) {
    const e = data.effort;
    const errors = data.findings.views.reduce((a, v) => a + v.errors, 0);
    const warnings = data.findings.views.reduce((a, v) => a + v.warnings, 0);
    section("overview").append(
      rooms(data.sheets),
      data.is_complete ? "" : element("p", { class: "notice", text: `${data.missing.length} configurations are missing: ${data.missing.slice(0, 8).join(", ")}${data.missing.length > 8 ? " ..." : ""}` }),
      ...data.unreadable.map(([file, why]) => element("p", { class: "notice", text: `${file} cannot be read and is not in any figure: ${why}` })),
      cards([
        ["Views", number(data.num_views), `${data.num_configurations} ${data.num_configurations === 1 ? "configuration" : "configurations"}, ${data.resolution.join(" × ")} pixels`],
        ["Disk", bytes(e.num_bytes), e.bytes_per_view ? `${bytes(e.bytes_per_view)} per view` : ""],
        ["Time", e.why_not ? "unknown" : duration(e.hours * 3600), e.why_not || `sum over units; ${number(e.views_per_hour)} views per unit-hour`],
        ["Cost", e.cost === null || e.cost === undefined ? "unknown" : number(e.cost, 4), e.cost === null || e.cost === undefined ? "needs --cost, a unit's price per hour" : `at ${number(e.price_per_hour)} per unit-hour`],
        ["Peak memory", e.peak_memory_mb ? bytes(e.peak_memory_mb * 1e6) : "unknown", e.hosts ? `${e.hosts.length} host${e.hosts.length === 1 ? "" : "s"}` : ""],
        ["Findings", data.findings.is_checked ? count(errors, "error") : "not verified", data.findings.is_checked ? count(warnings, "warning") : ""],
        ["Leakage", data.splits.shared.length ? `${data.splits.shared.length} shared assets` : "none", `${data.splits.rows.length} split${data.splits.rows.length === 1 ? "" : "s"}; the recipe ${data.splits.is_disjoint_asked ? "requires" : "does not require"} disjoint splits`],
      ]));
    if (!e.why_not) {
      section("overview").append(element("h3", { text: "Time by stage" }), table(["stage", "sum over units", "median per view"],
        [...Object.entries(e.stages).map(([name, s]) => [name, duration(s), ""]), ...Object.entries(e.view_stages).map(([name, s]) => [`render: ${name}`, "", duration(s)])], "Time by stage"));
    }
    section("overview").append(element("details", {}, element("summary", { text: "recipe and versions" }),
      element("p", { text: `Report made ${data.made}; rendered with ${data.variant}.` }),
      element("pre", { text: JSON.stringify({ versions: data.versions, recipe: data.recipe }, null, 1) })));
  }

  function fillFindings(data) {
    const found = data.findings, home = section("findings");
    if (!found.is_checked) home.append(element("p", { text: "The dataset was not verified for this report." }));
    else {
      home.append(table(["check", "asserts", "checked", "errors", "warnings"], found.checks, "Checks"));
      for (const note of found.notes) home.append(element("p", { class: "note", text: `Note: ${note}` }));
      home.append(element("h3", { text: found.views.length ? "Worst first" : "Nothing was found" }));
      const list = element("ol", { class: "worst" });
      let shown = 0;
      const more = element("button", { type: "button", text: "show more", onclick: () => show(50) });
      function show(howMany) {
        for (const item of found.views.slice(shown, shown + howMany)) {
          const where = item.view ? viewLink(item.configuration, item.view) : element("span", { text: item.configuration || "the dataset" });
          list.append(element("li", {},
            item.view ? element("a", { href: `#view/${item.configuration}/${item.view}` }, thumbnail(item.configuration, item.view)) : element("span", { class: "blank" }),
            element("div", {}, element("b", {}, where), ` ${count(item.errors, "error")}, ${count(item.warnings, "warning")}`,
              element("ul", {}, ...item.faults.map(([severity, check, , got, expected]) => element("li", { class: severity }, element("b", { text: `${severity}: ${check}: ` }), `${got}; expected ${expected}`))),
              item.errors + item.warnings > item.faults.length ? element("p", { class: "note", text: `and ${item.errors + item.warnings - item.faults.length} more: datagen verify --json lists all` }) : null)));
        }
        shown += howMany;
        more.hidden = shown >= found.views.length;
      }
      show(12);
      home.append(list, more);
    }
    for (const strip of found.stand_out) {
      home.append(element("h3", { text: `Views with the ${strip.title}` }),
        element("ul", { class: "strip" }, ...strip.rows.map(([configuration, view, value]) => element("li", {},
          element("a", { href: `#view/${configuration}/${view}` }, thumbnail(configuration, view), element("span", { text: `${configuration} / ${view}: ${number(value)}` }))))));
    }
  }

  function fillAssets(data) {
    const assets = data.assets, home = section("assets");
    home.append(element("h3", { text: "Surface pixels by material class" }),
      element("ul", { class: "shares" }, ...assets.class_shares.map(([name, share]) => element("li", {},
        element("span", { text: name }), element("span", { class: "track" }, element("span", { class: "fill", style: `width:${Math.max(100 * share, 0.3)}%` })), element("span", { text: percent(share) })))));
    for (const [what, names] of Object.entries(assets.never_used)) {
      if (names.length) home.append(element("p", {}, element("b", { text: `Never used, ${what}: ` }), names.join(", ")));
    }
    home.append(element("h3", { text: `Assets (${assets.rows.length})` }),
      table(["asset", "kind", "class or category", "configurations", "times placed", "share of pixels", "licence", "author"],
        assets.rows.map((row) => [row.id, row.kind, row.class, row.configurations, row.placed, percent(row.pixel_share), row.license, row.author]), "Assets by use"),
      element("details", {}, element("summary", { text: `materials by share of pixels (${assets.num_materials})` }), table(["material", "share of pixels"], assets.materials.map(([name, share]) => [name, percent(share)]), "Materials by share of pixels")));
  }

  function fillSplits(data) {
    const splits = data.splits;
    section("splits").append(table(["split", "configurations", "views", "assets"], splits.rows, "Splits"));
    if (!splits.shared.length) {
      section("splits").append(element("p", { text: splits.rows.length > 1 ? "No asset is used by more than one split." : "There is only one split, so nothing can leak." }));
    } else {
      section("splits").append(
        element("p", { class: splits.is_disjoint_asked ? "notice" : "note", text: `${splits.shared.length} assets are used by more than one split${splits.is_disjoint_asked ? ", although the recipe requires disjoint splits" : "; the recipe does not require disjoint splits"}.` }),
        table(["asset", "kind", "splits"], splits.shared.map((s) => [s.asset, s.kind, s.splits.join(", ")]), "Assets that several splits share"));
    }
  }

  function fill(data) {
    document.title = `${data.name}: dataset report`;
    document.getElementById("title").textContent = `${data.name}: dataset report`;
    fillOverview(data);
    fillFindings(data);
    section("distributions").append(
      element("p", { class: "note", text: "Only pixels with a surface are counted, values beyond an axis in its outermost bars. Colours are linear Rec.709." }),
      element("div", { class: "charts" }, ...data.distributions.map(histogram)));
    const coverage = data.coverage;
    section("coverage").append(element("div", { class: "beside" }, heatMap(coverage), element("div", {},
      element("p", { text: `${percent(coverage.filled_share)} of the fine cells contain pixels. Of ${coverage.coarse_total} coarse cells, ${coverage.coarse_filled} contain at least ${percent(coverage.threshold)} of all surface pixels.` }),
      element("p", { text: `${percent(coverage.metal_share)} of the surface pixels have S > 0.3, ${percent(coverage.gloss_share)} R < 0.3.` }),
      coverage.lack_for_training ? element("p", { class: "notice", text: `${coverage.lack_for_training}.` }) : "",
      element("h3", { text: coverage.missing.length ? "Missing" : "Nothing is missing" }),
      element("ul", { class: "missing" }, ...coverage.missing.map((text) => element("li", { text }))))));
    fillAssets(data);
    fillSplits(data);
  }

  return { fill, thumbnail };
})();
