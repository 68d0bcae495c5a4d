// SPDX-License-Identifier: MIT
// One view in all its buffers: side by side or under a wipe, with linked zoom, exposure and values.
"use strict";

REPORT.viewer = (() => {
  const { element, loadTile, loadConfiguration } = REPORT;
  const { Frame, paint, scaleOf, prepare, show, drawCursor } = REPORT.panels;
  const HIDDEN_FIRST = ["observation_count"];
  let ui = null, state = null, generation = 0, frameAsked = false;
  const shownBuffers = new Set();
  const painted = new Map(); // buffer -> canvas of its own size, kept from view to view
  const panelOf = new Map(); // buffer, or "wipe" -> its figure, likewise
  const settings = { stops: 0, isWipe: false, wipeA: "beauty", wipeB: "diffuse_albedo", wipeAt: 0.5 };

  const buffers = () => REPORT.summary.buffers;
  const bufferOf = (name) => buffers().find((b) => b.name === name);
  const exposure = () => state.view.exposure * 2 ** settings.stops;

  // Six digits tell any half float from its neighbours, nine any 32-bit float.
  const format = (value, digits = 6) => (Number.isFinite(value) ? String(Number(value.toPrecision(digits))) : String(value));
  const unitOf = (b) => (b.is_radiance ? "W/(m² sr)" : b.unit === "1" ? "" : b.unit.replace(/^1 \((.*)\)$/, "$1"));
  const digitsOf = (picture) => (picture.dtype === "float" ? 9 : 6);

  // ---------------------------------------------------------------- controls

  function build() {
    const home = document.getElementById("viewer");
    const button = (text, label, onclick) => element("button", { type: "button", text, "aria-label": label, title: label, onclick });
    const option = (b) => element("option", { value: b.name, text: b.label });
    ui = {
      configuration: element("select", { id: "configuration", onchange: () => openFirst(ui.configuration.value) }),
      view: element("select", { id: "view", onchange: () => { location.hash = `#view/${state.configuration.id}/${ui.view.value}`; } }),
      exposure: element("input", { id: "exposure", type: "range", min: -10, max: 10, step: 0.1, value: 0, oninput: () => setStops(Number(ui.exposure.value)) }),
      exposureText: element("output", { for: "exposure", id: "exposure-text" }),
      isWipe: element("input", { type: "checkbox", id: "is-wipe", onchange: () => setWipe(ui.isWipe.checked) }),
      wipeA: element("select", { id: "wipe-a", "aria-label": "left of the wipe", onchange: () => { settings.wipeA = ui.wipeA.value; load(); } }, ...buffers().map(option)),
      wipeB: element("select", { id: "wipe-b", "aria-label": "right of the wipe", onchange: () => { settings.wipeB = ui.wipeB.value; load(); } }, ...buffers().map(option)),
      wipeAt: element("input", { id: "wipe-at", type: "range", min: 0, max: 1, step: 0.005, value: 0.5, "aria-label": "position of the wipe", oninput: () => { settings.wipeAt = Number(ui.wipeAt.value); redraw(); } }),
      zoomText: element("output", { id: "zoom-text" }),
      panels: element("div", { id: "panels", tabindex: "0", role: "application", "aria-label": "Pictures. Arrow keys move the cursor, plus and minus zoom, S shows the source views of the pixel." }),
      pixel: element("p", { id: "pixel", text: "Point at a picture, or use the arrow keys." }),
      values: element("tbody", { id: "values" }),
      sources: element("div", { id: "sources", "aria-live": "polite" }),
      spoken: element("p", { class: "unseen", role: "status", "aria-live": "polite" }),
      message: element("p", { class: "notice", role: "alert", hidden: true }),
      wipeControls: element("span", { hidden: true }),
    };
    ui.wipeA.value = settings.wipeA;
    ui.wipeB.value = settings.wipeB;
    ui.wipeControls.append(ui.wipeA, " | ", ui.wipeB, ui.wipeAt);
    ui.configuration.append(...REPORT.views.configurations.map(([id, split]) => element("option", { value: id, text: `${id} (${split})` })));
    for (const b of buffers()) if (!HIDDEN_FIRST.includes(b.name)) shownBuffers.add(b.name);
    const choices = element("fieldset", {}, element("legend", { text: "pictures" }), ...buffers().map((b) => element("label", {}, element("input", {
      type: "checkbox", checked: shownBuffers.has(b.name),
      onchange: (event) => { event.target.checked ? shownBuffers.add(b.name) : shownBuffers.delete(b.name); load(); },
    }), ` ${b.label}`)));
    home.append(
      element("h1", { class: "unseen", text: "Viewer" }),
      element("div", { class: "bar", role: "toolbar", "aria-label": "Viewer controls" },
        element("a", { href: "#report", class: "back", text: "← report", "aria-label": "back to the report" }),
        element("label", {}, "configuration ", ui.configuration), element("label", {}, "view ", ui.view),
        button("‹", "previous view (P)", () => step(-1)), button("›", "next view (N)", () => step(1)),
        element("label", {}, "exposure ", ui.exposure), ui.exposureText, button("auto", "the view's own exposure (0 stops)", () => setStops(0)),
        button("−", "zoom out (-)", () => zoom(0.5)), button("+", "zoom in (+)", () => zoom(2)), button("fit", "show everything (0)", fit), ui.zoomText,
        element("label", {}, ui.isWipe, " wipe"), ui.wipeControls,
        element("details", {}, element("summary", { text: "pictures" }), choices),
        element("details", {}, element("summary", { text: "keys" }), element("ul", {}, ...[
          "arrows: move the cursor, with Shift by 10 pixels", "+ − 0: zoom in, out, fit", "[ ]: exposure down, up", "W: wipe; , .: move it", "S or Enter: source views of the pixel", "N P: next, previous view", "Esc: back to the report",
        ].map((text) => element("li", { text }))))),
      ui.message,
      element("div", { class: "stage" }, ui.panels,
        element("aside", { "aria-label": "Pixel" },
          element("h2", { text: "Pixel" }), ui.pixel,
          element("table", {}, element("caption", { class: "unseen", text: "Values of the pixel in linear units" }),
            element("thead", {}, element("tr", {}, element("th", { scope: "col", text: "buffer" }), element("th", { scope: "col", text: "value, as stored" }))), ui.values),
          element("h2", { text: "Source views" }), ui.sources)),
      ui.spoken);
    ui.panels.addEventListener("keydown", onKey);
    document.addEventListener("keydown", (event) => {
      if (document.getElementById("viewer").hidden) return;
      if (event.key === "Escape") location.hash = "#report";
      else if (event.target === document.body) onKey(event);
    });
    new ResizeObserver(redraw).observe(ui.panels);
  }

  function onKey(event) {
    if (!state || event.ctrlKey || event.metaKey || event.altKey) return;
    const far = event.shiftKey ? 10 : 1;
    const actions = {
      ArrowLeft: () => moveCursor(-far, 0), ArrowRight: () => moveCursor(far, 0), ArrowUp: () => moveCursor(0, -far), ArrowDown: () => moveCursor(0, far),
      "+": () => zoom(2), "=": () => zoom(2), "-": () => zoom(0.5), 0: fit,
      "[": () => setStops(settings.stops - 0.5), "]": () => setStops(settings.stops + 0.5),
      w: () => setWipe(!settings.isWipe), ",": () => moveWipe(-0.05), ".": () => moveWipe(0.05),
      s: showSources, Enter: showSources, n: () => step(1), p: () => step(-1),
    };
    const act = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }

  function setStops(stops) {
    settings.stops = Math.max(-10, Math.min(10, Math.round(stops * 10) / 10));
    ui.exposure.value = settings.stops;
    if (!state) return;
    repaint((buffer) => buffer.is_radiance);
    tellExposure();
  }

  function tellExposure() {
    const text = `${settings.stops >= 0 ? "+" : ""}${settings.stops.toFixed(1)} stops, × ${REPORT.charts.number(exposure())}`;
    ui.exposureText.textContent = text;
    ui.exposure.setAttribute("aria-valuetext", text);
  }

  function setWipe(isOn) {
    settings.isWipe = ui.isWipe.checked = isOn;
    load();
  }

  function moveWipe(by) {
    settings.wipeAt = Math.max(0, Math.min(1, settings.wipeAt + by));
    ui.wipeAt.value = settings.wipeAt;
    redraw();
  }

  function zoom(factor) {
    const at = state.cursor ? [state.cursor.x + 0.5, state.cursor.y + 0.5] : [state.frame.x, state.frame.y];
    state.frame.zoomAt(factor, ...at);
    redraw();
  }

  function fit() { state.frame.fit(); redraw(); }

  function step(by) {
    const all = REPORT.gallery.all(); // in the order of the plan, across configurations
    const here = all.findIndex((v) => v.key === `${state.configuration.id}/${state.view.name}`);
    const next = all[(here + by + all.length) % all.length];
    location.hash = `#view/${next.key}`;
  }

  function openFirst(id) {
    const number = REPORT.views.configurations.findIndex(([other]) => other === id);
    const row = REPORT.views.rows.find((r) => r[0] === number);
    location.hash = `#view/${id}/${row[REPORT.views.columns.indexOf("name")]}`;
  }

  // ---------------------------------------------------------------- opening a view

  async function open(id, name, cursor) {
    if (!ui) build();
    const mine = ++generation;
    ui.message.hidden = true;
    ui.sources.replaceChildren(element("p", { class: "note", text: "Click a pixel to see which views its minimum, median and maximum come from." }));
    const entry = REPORT.views.configurations.find(([other]) => other === id);
    if (!entry) return complain(`There is no configuration ${id} in this report.`);
    let configuration;
    try {
      configuration = await loadConfiguration(id);
    } catch (error) {
      return complain(error.message);
    }
    if (mine !== generation) return;
    const view = configuration.views.find((v) => v.name === name);
    if (!view) return complain(`${id} has no view ${name}.`);
    const { width_px: width, height_px: height } = view.camera;
    const before = state && state.frame.width === width && state.frame.height === height ? state.frame : null;
    state = { configuration, view, hasPixels: entry[2], frame: before || new Frame(width, height), pictures: {}, scales: {}, mask: null, cursor: null, isReady: false };
    ui.configuration.value = id;
    ui.view.replaceChildren(...configuration.views.map((v) => element("option", { value: v.name, text: v.name })));
    ui.view.value = name;
    ui.values.replaceChildren();
    ui.pixel.textContent = "Point at a picture, or use the arrow keys.";
    document.title = `${id} / ${name}: ${REPORT.summary.name}`;
    tellExposure();
    if (!state.hasPixels) complain("The pixels of this configuration are not part of this report. `datagen report DATASET --pixels all` writes those of every view.");
    await load(cursor);
  }

  function complain(text) {
    ui.message.textContent = text;
    ui.message.hidden = false;
  }

  const wanted = () => (settings.isWipe ? [...new Set([settings.wipeA, settings.wipeB])] : buffers().map((b) => b.name).filter((n) => shownBuffers.has(n)))
    .filter((name) => state.view.buffers.includes(name));

  // Load what is shown and not there yet, one tile after another, and draw each as it comes.
  async function load(cursor) {
    if (!state) return;
    const mine = ++generation, current = state;
    current.isReady = false;
    document.getElementById("viewer").dataset.ready = "false";
    layOut();
    if (!current.hasPixels) return showThumbnail();
    const stem = `${current.configuration.id}/${current.view.name}`;
    try {
      if (!current.mask && current.view.buffers.includes("surface_mask")) current.mask = await loadTile(`${stem}/surface_mask`);
      for (const name of wanted()) {
        if (mine !== generation) return;
        if (current.pictures[name]) continue;
        current.pictures[name] = await loadTile(`${stem}/${name}`);
        if (mine !== generation) return;
        repaint((buffer) => buffer.name === name);
      }
      for (const name of ["instance_id", "material_id"]) {
        if (!current.pictures[name] && current.view.buffers.includes(name)) current.pictures[name] = await loadTile(`${stem}/${name}`);
      }
    } catch (error) {
      if (mine === generation) complain(`${error.message}: write the report again.`);
      return;
    }
    if (mine !== generation) return;
    current.isReady = true;
    if (cursor) {
      setCursor(cursor.x, cursor.y);
      if (current.frame.zoom > 1) current.frame.move(cursor.x - current.frame.x, cursor.y - current.frame.y);
    } else tellValues();
    redraw();
    document.getElementById("viewer").dataset.ready = "true";
  }

  function showThumbnail() {
    const { configuration, view } = state;
    ui.panels.replaceChildren(element("img", { src: `thumbnails/${configuration.id}/${view.name}.jpg`, alt: `${configuration.id}, ${view.name}, small`, class: "only" }));
    document.getElementById("viewer").dataset.ready = "true";
  }

  // ---------------------------------------------------------------- drawing

  function layOut() {
    const { width, height } = state.frame;
    ui.wipeControls.hidden = !settings.isWipe;
    ui.panels.classList.toggle("wipe", settings.isWipe);
    const names = settings.isWipe ? ["wipe"] : wanted();
    const figures = names.map((name) => {
      if (!panelOf.has(name)) panelOf.set(name, newPanel(name));
      const figure = panelOf.get(name), canvas = figure.querySelector("canvas");
      const label = name === "wipe" ? `${bufferOf(settings.wipeA).label} | ${bufferOf(settings.wipeB).label}` : bufferOf(name).label;
      figure.querySelector("b").textContent = label;
      canvas.style.aspectRatio = `${width}/${height}`;
      canvas.setAttribute("aria-label", `${label} of ${state.configuration.id}, ${state.view.name}`);
      return figure;
    });
    const present = [...ui.panels.children];
    if (present.length !== figures.length || present.some((node, i) => node !== figures[i])) ui.panels.replaceChildren(...figures);
    redraw();
  }

  function newPanel(name) {
    const canvas = element("canvas", { "data-buffer": name, role: "img" });
    listen(canvas);
    return element("figure", {}, element("figcaption", {}, element("b"), element("span", { class: "facts" })), canvas);
  }

  function repaint(test) {
    for (const [name, picture] of Object.entries(state.pictures)) {
      const buffer = bufferOf(name);
      if (!buffer || !test(buffer)) continue;
      state.scales[name] = scaleOf(buffer, picture, state.view, exposure());
      if (!painted.has(name)) painted.set(name, document.createElement("canvas"));
      paint(painted.get(name), picture, state.scales[name], state.mask);
    }
    redraw();
  }

  function redraw() {
    if (frameAsked || !state || !ui) return;
    frameAsked = true;
    requestAnimationFrame(() => {
      frameAsked = false;
      if (document.getElementById("viewer").hidden) return;
      for (const canvas of ui.panels.querySelectorAll("canvas")) drawPanel(canvas);
      const s = state.frame.zoom;
      ui.zoomText.textContent = `zoom ${Number(s.toPrecision(3))}`;
    });
  }

  function drawPanel(canvas) {
    const name = canvas.dataset.buffer, { frame } = state;
    const context = prepare(canvas);
    const facts = canvas.parentElement.querySelector(".facts");
    if (name !== "wipe") {
      if (state.scales[name]) show(context, canvas, painted.get(name), frame);
      facts.textContent = state.scales[name] ? state.scales[name].legend : "loading ...";
    } else {
      const at = settings.wipeAt * canvas.clientWidth;
      for (const [which, left, wide] of [[settings.wipeA, 0, at], [settings.wipeB, at, canvas.clientWidth - at]]) {
        if (!state.scales[which]) continue;
        context.save();
        context.beginPath();
        context.rect(left, 0, wide, canvas.clientHeight);
        context.clip();
        show(context, canvas, painted.get(which), frame);
        context.restore();
      }
      context.fillStyle = "#000";
      context.fillRect(at - 1.5, 0, 3, canvas.clientHeight);
      context.fillStyle = "#fff";
      context.fillRect(at - 0.5, 0, 1, canvas.clientHeight);
    }
    drawCursor(context, canvas, frame, state.cursor);
  }

  // ---------------------------------------------------------------- pointer, cursor, values

  function listen(canvas) {
    let drag = null;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      state.frame.zoomAt(2 ** (-event.deltaY / 240), ...state.frame.toImage(canvas, event.offsetX, event.offsetY));
      redraw();
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      const onLine = canvas.dataset.buffer === "wipe" && Math.abs(event.offsetX - settings.wipeAt * canvas.clientWidth) < 8;
      drag = { x: event.offsetX, y: event.offsetY, far: 0, onLine };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (drag) {
        const [dx, dy] = [event.offsetX - drag.x, event.offsetY - drag.y];
        drag.far += Math.abs(dx) + Math.abs(dy);
        [drag.x, drag.y] = [event.offsetX, event.offsetY];
        if (drag.onLine) return moveWipe(dx / canvas.clientWidth);
        if (drag.far > 3) {
          const s = state.frame.scaleIn(canvas);
          state.frame.move(-dx / s, -dy / s);
          redraw();
        }
        return;
      }
      const [x, y] = state.frame.toImage(canvas, event.offsetX, event.offsetY);
      setCursor(Math.floor(x), Math.floor(y));
    });
    canvas.addEventListener("pointerup", () => {
      const wasClick = drag && drag.far <= 3 && !drag.onLine;
      drag = null;
      if (wasClick) showSources();
    });
    canvas.addEventListener("pointercancel", () => { drag = null; });
  }

  function setCursor(x, y) {
    const { width, height } = state.frame;
    if (x < 0 || y < 0 || x >= width || y >= height) return;
    if (state.cursor && state.cursor.x === x && state.cursor.y === y) return;
    state.cursor = { x, y };
    tellValues();
    redraw();
  }

  function moveCursor(dx, dy) {
    const { frame } = state;
    const from = state.cursor || { x: Math.floor(frame.x), y: Math.floor(frame.y) };
    setCursor(Math.max(0, Math.min(frame.width - 1, from.x + dx)), Math.max(0, Math.min(frame.height - 1, from.y + dy)));
    const [x, y] = [state.cursor.x + 0.5, state.cursor.y + 0.5];
    const [w, h] = [frame.width / 2 / frame.zoom, frame.height / 2 / frame.zoom];
    if (Math.abs(x - frame.x) > w || Math.abs(y - frame.y) > h) frame.move(x - frame.x, y - frame.y);
    const first = ui.values.querySelector("tr");
    ui.spoken.textContent = `${ui.pixel.textContent}. ${first ? first.textContent : ""}`;
  }

  function tellValues() {
    if (!state.cursor) return;
    const { x, y } = state.cursor;
    const pixel = y * state.frame.width + x;
    const names = state.configuration.names[state.view.names];
    const nameOf = (buffer, table) => {
      const picture = state.pictures[buffer];
      const id = picture ? picture.at(0, pixel) : null;
      return id === null ? "" : id === 0 ? "none" : names[table][id] || `id ${id}`;
    };
    ui.pixel.textContent = `column ${x}, row ${y}; instance ${nameOf("instance_id", "instances")}; material ${nameOf("material_id", "materials")}`;
    ui.values.replaceChildren(...buffers().filter((b) => state.pictures[b.name]).map((b) => {
      const picture = state.pictures[b.name];
      const values = picture.all(pixel).map((v) => format(v, digitsOf(picture)));
      return element("tr", { "data-buffer": b.name }, element("th", { scope: "row", title: `${b.description} [${b.unit}]` }, b.label, element("small", { text: unitOf(b) })),
        element("td", {}, ...values.map((text) => element("span", { class: "value", text: `${text} ` }))));
    }));
  }

  // ---------------------------------------------------------------- source views

  async function showSources() {
    if (!state || !state.cursor || !state.hasPixels) return;
    const mine = state, { x, y } = state.cursor;
    const isCurrent = () => state === mine && mine.asked === `${x},${y}`;
    mine.asked = `${x},${y}`;
    const head = element("p", { text: `Looking up the views behind column ${x}, row ${y} ...` });
    ui.sources.replaceChildren(head);
    ui.sources.dataset.ready = "false";
    let found;
    try {
      found = await REPORT.sources.find(mine.configuration, mine.view, x, y, isCurrent);
    } catch (error) {
      head.textContent = `The source views are not part of this report (${error.message}).`;
      return;
    }
    if (!found || !isCurrent()) return;
    const statistics = mine.view.statistics;
    const note = statistics && statistics.visibility === "trace" ? " The statistics asked traced rays what hides a point; here the depth buffers are asked, which may choose others near edges." : "";
    if (!found.length) head.textContent = `No view stands behind column ${x}, row ${y}: it shows no surface, so its statistics are its own colour.`;
    else {
      head.textContent = `${found.length} ${found.length === 1 ? "view stands" : "views stand"} behind column ${x}, row ${y}, the best first.${note}`;
      const order = REPORT.sources.orderStatistics(found.map((source) => source.color));
      ui.sources.append(
        element("table", { class: "recomputed" }, element("caption", { text: "From these colours" }), element("tbody", {}, ...["min", "median", "max"].map((what) =>
          element("tr", { "data-statistic": what }, element("th", { scope: "row", text: what }), element("td", {}, ...order.map((c) => element("span", { class: "value", text: `${format(c[what], 5)} ` }))))))),
        REPORT.sources.listNode(mine.configuration, found, exposure(), (v) => format(v, 4)));
    }
    ui.sources.dataset.ready = "true";
  }

  function close() {
    generation++;
    state = null;
    if (ui) ui.panels.replaceChildren();
    document.title = `${REPORT.summary.name}: dataset report`;
  }

  const frame = () => state && { ...state.frame };

  return { open, close, frame };
})();
