// SPDX-License-Identifier: MIT
// Shows all buffers of a view, or predicted maps and the ground truth, side by side or under a wipe, with common zoom,
// exposure and pixel values.
"use strict";

REPORT.viewer = (() => {
  const { element, loadTile, loadConfiguration, compare } = REPORT;
  const { Frame, paint, scaleOf, scaleBar, prepare, show, drawCursor } = REPORT.panels;
  const HIDDEN_FIRST = ["observation_count"];
  let ui = null, state = null, generation = 0, frameAsked = false;
  const shownBuffers = new Set();
  const painted = new Map(); // buffer -> canvas with a pixel per value, reused for all views
  const panelOf = new Map(); // buffer, or "wipe" -> its figure, reused for all views
  const settings = { stops: 0, isWipe: false, wipeA: "beauty", wipeB: "diffuse_albedo", wipeAt: 0.5, method: "", maxError: 0.2 };
  const ERROR_SCALES = [0.02, 0.05, 0.1, 0.2, 0.5, 1];

  const buffers = () => REPORT.summary.buffers;
  const bufferOf = (name) => buffers().find((b) => b.name === name) || compare.describe(name);
  const exposure = () => state.view.exposure * 2 ** settings.stops;

  // Six digits distinguish all half floats, nine all 32-bit floats.
  const format = (value, digits = 6) => (Number.isFinite(value) ? String(Number(value.toPrecision(digits))) : String(value));
  const unitOf = (b) => (b.is_radiance ? "W/(m² sr)" : b.unit === "1" ? "" : b.unit.replace(/^1 \((.*)\)$/, "$1"));
  const digitsOf = (picture) => (picture.dtype === "float" && !picture.truth ? 9 : 6); // errors to six digits

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
      wipeA: element("select", { id: "wipe-a", "aria-label": "left of the wipe", onchange: () => { settings.wipeA = ui.wipeA.value; load(); } }),
      wipeB: element("select", { id: "wipe-b", "aria-label": "right of the wipe", onchange: () => { settings.wipeB = ui.wipeB.value; load(); } }),
      wipeAt: element("input", { id: "wipe-at", type: "range", min: 0, max: 1, step: 0.005, value: 0.5, "aria-label": "position of the wipe", oninput: () => { settings.wipeAt = Number(ui.wipeAt.value); redraw(); } }),
      method: element("select", { id: "method", onchange: () => setMethod(ui.method.value) }, element("option", { value: "", text: "none" }), ...compare.methods().map((m) => element("option", { value: m.slug, text: m.label }))),
      maxError: element("select", { id: "max-error", onchange: () => setMaxError(Number(ui.maxError.value)) }, ...ERROR_SCALES.map((value) => element("option", { value, text: `0 to ${value}`, selected: value === settings.maxError }))),
      zoomText: element("output", { id: "zoom-text" }),
      panels: element("div", { id: "panels", tabindex: "0", role: "application", "aria-label": "Pictures. Arrow keys move the cursor, plus and minus zoom, S shows the source views of the pixel." }),
      pixel: element("p", { id: "pixel", text: "Point at a picture, or use the arrow keys." }),
      values: element("tbody", { id: "values" }),
      facts: element("p", { id: "facts", class: "note" }),
      errors: element("table", { id: "errors", hidden: true }),
      sources: element("div", { id: "sources", "aria-live": "polite" }),
      spoken: element("p", { class: "unseen", role: "status", "aria-live": "polite" }),
      message: element("p", { class: "notice", role: "alert", hidden: true }),
      wipeControls: element("span", { hidden: true }),
    };
    for (const [select, value] of [[ui.wipeA, settings.wipeA], [ui.wipeB, settings.wipeB]]) {
      select.append(...buffers().map(option), ...compare.methods().map((m) => element("optgroup", { label: m.label },
        ...REPORT.predictions.maps.flatMap((map) => ["predicted", "error"].map((kind) => option(bufferOf(`${kind}:${m.slug}:${map}`)))))));
      select.value = value;
    }
    ui.wipeControls.append(ui.wipeA, " | ", ui.wipeB, ui.wipeAt);
    ui.configuration.append(...REPORT.views.configurations.map(([id, split]) => element("option", { value: id, text: `${id} (${split})` })));
    for (const b of buffers()) if (!HIDDEN_FIRST.includes(b.name)) shownBuffers.add(b.name);
    const choices = ui.choices = element("fieldset", {}, element("legend", { text: "pictures" }), ...buffers().map((b) => element("label", {}, element("input", {
      type: "checkbox", checked: shownBuffers.has(b.name),
      onchange: (event) => { event.target.checked ? shownBuffers.add(b.name) : shownBuffers.delete(b.name); load(); },
    }), ` ${b.label}`)));
    home.append(
      element("h1", { class: "unseen", text: "Viewer" }),
      element("div", { class: "bar", role: "toolbar", "aria-label": "Viewer controls" },
        element("a", { href: "#report", class: "back", text: "← report", "aria-label": "back to the report" }),
        element("label", {}, "configuration ", ui.configuration), element("label", {}, "view ", ui.view),
        button("‹", "previous view (P)", () => step(-1)), button("›", "next view (N)", () => step(1)),
        element("label", {}, "exposure ", ui.exposure), ui.exposureText, button("auto", "the view's exposure (0 stops)", () => setStops(0)),
        ui.compareControls = element("span", { hidden: !compare.methods().length }, element("label", {}, "predictions ", ui.method), " ", ui.errorControl = element("label", { hidden: true }, "errors ", ui.maxError)),
        button("−", "zoom out (-)", () => zoom(0.5)), button("+", "zoom in (+)", () => zoom(2)), button("fit", "show everything (0)", fit), ui.zoomText,
        element("label", {}, ui.isWipe, " wipe"), ui.wipeControls,
        element("details", {}, element("summary", { text: "pictures" }), choices),
        element("details", {}, element("summary", { text: "keys" }), element("ul", {}, ...[
          "arrows: move the cursor, with Shift by 10 pixels", "+ − 0: zoom in, out, fit", "[ ]: exposure down, up", "W: wipe; , .: move it", "S or Enter: source views of the pixel", "N P: next, previous view", "M: next method's predictions, or none", "Esc: back to the report",
        ].map((text) => element("li", { text }))))),
      ui.message,
      element("div", { class: "stage" }, ui.panels,
        element("aside", { "aria-label": "Pixel" },
          element("h2", { text: "Pixel" }), ui.pixel,
          element("table", {}, element("caption", { class: "unseen", text: "Values of the pixel in linear units" }),
            element("thead", {}, element("tr", {}, element("th", { scope: "col", text: "buffer" }), element("th", { scope: "col", text: "value, as stored" }))), ui.values),
          ui.errors,
          element("h2", { text: "Source views" }), ui.sources,
          element("h2", { text: "View" }), ui.facts)),
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
      s: showSources, Enter: showSources, n: () => step(1), p: () => step(-1), m: nextMethod,
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

  // Show a method's predictions ("" = none); a wipe then compares the truth with the prediction.
  function setMethod(slug) {
    settings.method = ui.method.value = slug;
    ui.errorControl.hidden = !slug;
    const usesOther = (name) => name.includes(":") && !name.includes(`:${slug}:`);
    if (slug && (usesOther(settings.wipeB) || !settings.wipeB.includes(":"))) {
      settings.wipeA = ui.wipeA.value = REPORT.predictions.maps[0];
      settings.wipeB = ui.wipeB.value = `predicted:${slug}:${REPORT.predictions.maps[0]}`;
    } else if (!slug) {
      for (const [box, key, plain] of [[ui.wipeA, "wipeA", "beauty"], [ui.wipeB, "wipeB", "diffuse_albedo"]]) if (usesOther(settings[key])) settings[key] = box.value = plain;
    }
    ui.choices.disabled = Boolean(slug);
    if (state) load();
  }

  function nextMethod() {
    const all = ["", ...compare.methods().map((m) => m.slug)];
    setMethod(all[(all.indexOf(settings.method) + 1) % all.length]);
    ui.spoken.textContent = settings.method ? `predictions of ${compare.methodOf(settings.method).label}` : "no predictions";
  }

  function setMaxError(value) {
    settings.maxError = value;
    repaint((buffer) => buffer.kind === "error");
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

  async function open(id, name, cursor, method) {
    if (!ui) build();
    const mine = ++generation;
    if (method !== undefined && method !== settings.method && compare.methodOf(method)) {
      state = null; // so that setMethod loads nothing
      setMethod(method);
    }
    ui.message.hidden = true;
    ui.sources.replaceChildren(element("p", { class: "note", text: "Click a pixel to see the views of its minimum, median and maximum." }));
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
    state = { configuration, view, hasPixels: entry[2], frame: before || new Frame(width, height), pictures: {}, coming: {}, scales: {}, mask: null, cursor: null, isReady: false };
    ui.configuration.value = id;
    ui.view.replaceChildren(...configuration.views.map((v) => element("option", { value: v.name, text: v.name })));
    ui.view.value = name;
    ui.values.replaceChildren();
    ui.pixel.textContent = "Point at a picture, or use the arrow keys.";
    document.title = `${id} / ${name}: ${REPORT.summary.name}`;
    tellExposure();
    const { render } = view, { number } = REPORT.charts;
    ui.facts.textContent = [`${width} × ${height} pixels`, `${render.path_samples} light paths per pixel`, render.estimated_rel_mse == null ? null : `estimated error ${number(render.estimated_rel_mse)}`,
      `${number(render.clipped_pixels)} clipped pixels`, `exposure ${number(view.exposure)}`].filter(Boolean).join(", ");
    await load(cursor);
  }

  function complain(text) {
    ui.message.textContent = text;
    ui.message.hidden = false;
  }

  function wanted() {
    const key = `${state.configuration.id}/${state.view.name}`, available = state.view.buffers;
    const isThere = (name) => {
      const { kind, slug, map } = bufferOf(name);
      return kind ? available.includes(map) && Boolean(compare.errorsOf(slug, key)?.has.includes(map)) : available.includes(name);
    };
    if (settings.isWipe) return [...new Set([settings.wipeA, settings.wipeB])].filter(isThere);
    if (settings.method) return compare.namesOf(settings.method, key, available);
    return buffers().map((b) => b.name).filter((name) => shownBuffers.has(name) && isThere(name));
  }

  // Load the pictures that are shown and not loaded yet, and draw each when it is loaded.
  async function load(cursor) {
    if (!state) return;
    const mine = ++generation, current = state;
    current.isReady = false;
    document.getElementById("viewer").dataset.ready = "false";
    ui.message.hidden = true;
    layOut();
    if (!current.hasPixels) {
      complain("This report does not contain the pixels of this configuration; `datagen report DATASET --pixels all` writes all pixels.");
      return showThumbnail();
    }
    tellMethod();
    const stem = `${current.configuration.id}/${current.view.name}`, available = current.view.buffers;
    const failures = [];
    const get = (name) => {
      if (current.pictures[name]) return Promise.resolve(current.pictures[name]);
      return current.coming[name] ??= (name.includes(":") ? compare.picture(name, stem, get) : loadTile(`${stem}/${name}`))
        .then((picture) => (current.pictures[name] = picture))
        .finally(() => { delete current.coming[name]; });
    };
    async function bring(name, isShown) {
      try {
        await get(name);
        if (isShown && mine === generation) repaint((buffer) => buffer.name === name);
      } catch (error) {
        failures.push(error.message);
      }
    }
    if (available.includes("surface_mask")) await bring("surface_mask", false);
    current.mask = current.pictures.surface_mask || null;
    await Promise.all(wanted().map((name) => bring(name, true)));
    await Promise.all(["instance_id", "material_id"].filter((name) => available.includes(name)).map((name) => bring(name, false)));
    if (mine !== generation) return;
    if (failures.length) complain(`${[...new Set(failures)].join("; ")}: write the report again.`);
    const shown = new Set(wanted());
    // free the memory of hidden canvases without waiting for garbage collection
    for (const [name, canvas] of painted) if (!shown.has(name)) { canvas.width = canvas.height = 0; painted.delete(name); }
    for (const figure of panelOf.values()) if (!figure.isConnected) { const canvas = figure.querySelector("canvas"); canvas.width = canvas.height = 0; }
    current.isReady = true;
    if (cursor) {
      setCursor(cursor.x, cursor.y);
      if (current.frame.zoom > 1) current.frame.move(cursor.x - current.frame.x, cursor.y - current.frame.y);
    } else tellValues();
    redraw();
    document.getElementById("viewer").dataset.ready = "true";
  }

  // Show a method's errors in this view, and its problems.
  function tellMethod() {
    const { method } = settings, key = `${state.configuration.id}/${state.view.name}`;
    ui.errors.hidden = !method;
    if (!method) return;
    const { label, problems } = compare.methodOf(method), found = compare.errorsOf(method, key);
    const problem = problems.find(([id, view]) => `${id}/${view}` === key);
    if (!found) complain(`${label} has no prediction of this view.`);
    else if (problem) complain(`${label}: ${problem[2]}.`);
    ui.errors.replaceChildren(element("caption", { text: `Mean squared error, ${label}` }), element("tbody", {}, ...(found ? REPORT.predictions.maps.map((map, k) =>
      element("tr", { "data-mse": map }, element("th", { scope: "row", text: bufferOf(map)?.label ?? map }), element("td", { text: compare.figure(found.mse[k]) }))) : [])));
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
    ui.panels.classList.toggle("compare", Boolean(settings.method) && !settings.isWipe);
    const names = settings.isWipe ? ["wipe"] : wanted();
    const figures = names.map((name) => {
      if (!panelOf.has(name)) panelOf.set(name, newPanel(name));
      const figure = panelOf.get(name), canvas = figure.querySelector("canvas");
      const isTruth = settings.method && !settings.isWipe && !name.includes(":");
      const label = name === "wipe" ? `${bufferOf(settings.wipeA).label} | ${bufferOf(settings.wipeB).label}` : `${bufferOf(name).label}${isTruth ? " (truth)" : ""}`;
      figure.querySelector("b").textContent = label;
      canvas.style.aspectRatio = `${width}/${height}`;
      if (name !== "wipe") tellScale(name);
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
    if (!state) return;
    const shown = wanted();
    for (const [name, picture] of Object.entries(state.pictures)) {
      const buffer = bufferOf(name);
      if (!buffer || !shown.includes(name) || !test(buffer)) continue;
      state.scales[name] = scaleOf(buffer, picture, state.view, exposure(), settings.maxError);
      tellScale(name);
      if (!painted.has(name)) painted.set(name, document.createElement("canvas"));
      paint(painted.get(name), picture, state.scales[name], state.mask);
    }
    redraw();
  }

  // Legend or scale above a picture.
  function tellScale(name) {
    const figure = panelOf.get(name), scale = state.scales[name];
    if (figure) figure.querySelector(".facts").replaceChildren(scale ? (scale.kind === "scalar" ? scaleBar(scale) : scale.legend) : "loading ...");
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
    if (name !== "wipe") {
      if (state.scales[name] && painted.has(name)) show(context, canvas, painted.get(name), frame);
    } else {
      const at = settings.wipeAt * canvas.clientWidth;
      for (const [which, left, wide] of [[settings.wipeA, 0, at], [settings.wipeB, at, canvas.clientWidth - at]]) {
        if (!state.scales[which] || !painted.has(which)) continue;
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
    const derived = Object.keys(state.pictures).filter((name) => name.includes(":")).map(bufferOf).filter((b) => b.slug === settings.method || (settings.isWipe && [settings.wipeA, settings.wipeB].includes(b.name))).sort((a, b) => a.slug.localeCompare(b.slug) || b.kind.localeCompare(a.kind));
    ui.values.replaceChildren(...[...buffers(), ...derived].filter((b) => state.pictures[b.name]).map((b) => {
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
    const head = element("p", { text: `Looking up the source views of column ${x}, row ${y} ...` });
    ui.sources.replaceChildren(head);
    ui.sources.dataset.ready = "false";
    let found;
    try {
      found = await REPORT.sources.find(mine.configuration, mine.view, x, y, isCurrent);
    } catch (error) {
      head.textContent = `This report does not contain the source views (${error.message}).`;
      return;
    }
    if (!found || !isCurrent()) return;
    const statistics = mine.view.statistics;
    const note = statistics && statistics.visibility === "trace" ? " The statistics tested visibility by tracing; this list tests it by depth buffers, which may choose other views near edges." : "";
    if (!found.length) head.textContent = `Column ${x}, row ${y} has no source views: it shows no surface, so its statistics are its own colour.`;
    else {
      head.textContent = `${found.length} source ${found.length === 1 ? "view" : "views"} of column ${x}, row ${y}, the best first.${note}`;
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
