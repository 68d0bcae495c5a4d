// SPDX-License-Identifier: MIT
// Loads the asset, draws it after every change, and adds the controls.
"use strict";

(async () => {
  const T = THREE, { scene: data } = VIEW;
  const $ = (id) => document.getElementById(id);
  const canvas = $("picture");
  const SHOWN = ["lit", "D, diffuse albedo", "S, specular albedo", "R, roughness", "seen texels", "normal", "confidence"];

  function element(tag, attributes = {}, ...children) {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "text") node.textContent = value;
      else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
      else if (value !== false && value !== null && value !== undefined) node.setAttribute(name, value);
    }
    node.append(...children);
    return node;
  }
  function complain(text) { $("notice").textContent = text; $("notice").hidden = false; }
  if (!data) return complain("data/scene.js is missing: write the page again.");

  const numbers = (text, Kind) => {
    const bytes = Uint8Array.fromBase64 ? Uint8Array.fromBase64(text) : Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return Kind ? new Kind(bytes.buffer) : bytes;
  };

  // ---------------------------------------------------------------- scene

  let renderer;
  try {
    renderer = new T.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    return complain(`WebGL 2 is not available in this browser (${error.message}).`);
  }
  const world = new T.Scene(), camera = new T.PerspectiveCamera(60, 1, 0.01, 100);
  camera.up.set(0, 0, 1);
  // The bounds for navigation: those of the cameras with a margin, else of the asset. A room's mesh may include
  // distant outdoor geometry.
  const places = data.cameras.length ? data.cameras.map((c) => c.position) : data.bounds;
  const bounds = [Math.min, Math.max].map((pick) => new T.Vector3(...[0, 1, 2].map((k) => pick(...places.map((p) => p[k])))));
  if (data.cameras.length) {
    const margin = Math.max(1, 0.25 * bounds[0].distanceTo(bounds[1]));
    bounds[0].subScalar(margin);
    bounds[1].addScalar(margin);
  }
  let isAsked = false;
  const changed = () => {
    if (isAsked) return;
    isAsked = true;
    requestAnimationFrame(() => { isAsked = false; draw(); });
  };
  const controls = VIEW.makeControls(camera, canvas, bounds, changed);
  const whole = data.bounds.map((corner) => new T.Vector3(...corner));
  camera.near = controls.size * 2e-3;
  camera.far = 4 * (controls.size + whole[0].distanceTo(whole[1]));

  const range = camera.far, near = controls.size * 1e-3;
  const shadows = VIEW.makeShadows(renderer, world, 1, 512, near, range);
  let sourceShadows = null; // made when the sources are first switched on

  const fixed = (pick) => ({ value: Array.from({ length: VIEW.MAX_SOURCES }, (_, k) => pick(data.sources[k] || { position: [0, 0, 0], vector: [0, 0, 0], radiance: [0, 0, 0], rest: 0 })) });
  const vectors = (name) => fixed((source) => new T.Vector3(...source[name]));
  const shared = {
    lightShadow: { value: shadows.texture }, sourceShadow: { value: shadows.texture }, range: { value: range }, hasShadows: { value: true },
    numSources: { value: 0 }, sourcePosition: vectors("position"), sourceVector: vectors("vector"), sourceRadiance: vectors("radiance"), sourceRest: fixed((source) => source.rest),
    lightPosition: { value: controls.light }, lightIntensity: { value: new T.Vector3() }, exposure: { value: 1 }, fill: { value: 0 }, shown: { value: 0 },
    colorMap: { value: texture(new Uint8Array(data.colorMap.flatMap((rgb) => [...rgb, 255])), 256, 1, false) },
  };

  function texture(pixels, width, height, isColor) {
    const made = pixels instanceof Uint8Array ? new T.DataTexture(pixels, width, height) : new T.Texture(pixels);
    made.colorSpace = isColor ? T.SRGBColorSpace : "";
    made.flipY = false;
    made.magFilter = T.LinearFilter;
    made.minFilter = width > 256 || height > 256 ? T.LinearMipmapLinearFilter : T.LinearFilter;
    made.generateMipmaps = made.minFilter !== T.LinearFilter;
    made.wrapS = made.wrapT = T.RepeatWrapping;
    made.anisotropy = Math.min(4, renderer.capabilities.getMaxAnisotropy());
    made.needsUpdate = true;
    return made;
  }

  const lamps = [];
  const holders = new Map(); // uniform of each image, by name
  for (const material of data.materials) {
    const geometry = new T.BufferGeometry();
    for (const [name, values, size] of [["position", material.positions, 3], ["normal", material.normals, 3], ["uv", material.uv, 2]]) {
      geometry.setAttribute(name, new T.BufferAttribute(numbers(values, Float32Array), size));
    }
    geometry.setIndex(new T.BufferAttribute(numbers(material.faces, Uint32Array), 1));
    const grey = () => ({ value: texture(new Uint8Array([128, 128, 128, 255]), 1, 1, false) });
    const uniforms = { ...shared, isLamp: { value: Boolean(material.emission) }, emission: { value: new T.Vector3(...(material.emission || [0, 0, 0])) }, diffuseMap: grey(), specularMap: grey(), roughMap: grey() };
    for (const [name, kind] of material.images) holders.set(name, { uniform: uniforms[`${kind}Map`], isColor: kind !== "rough" });
    const mesh = new T.Mesh(geometry, new T.RawShaderMaterial({ glslVersion: T.GLSL3, vertexShader: VIEW.shader.vertex, fragmentShader: VIEW.shader.fragment, uniforms, side: T.DoubleSide }));
    mesh.frustumCulled = false;
    if (material.emission) lamps.push(mesh);
    world.add(mesh);
    for (const key of ["positions", "normals", "uv", "faces"]) delete material[key];
  }
  const bulb = new T.Mesh(new T.SphereGeometry(1, 16, 12), new T.MeshBasicMaterial({ color: 0xffe08a }));
  world.add(bulb);

  // The light's shadow map is redrawn when the light has moved. Its ball and the lamps cast no shadows.
  let shadowsFrom = null;
  function drawShadows() {
    bulb.visible = false;
    if (shared.hasShadows.value && !shadowsFrom?.equals(controls.light)) {
      shadows.render(0, controls.light);
      shadowsFrom = controls.light.clone();
    }
    if (shared.numSources.value && !sourceShadows) {
      sourceShadows = VIEW.makeShadows(renderer, world, data.sources.length, 256, near, range);
      for (const lamp of lamps) lamp.visible = false;
      data.sources.forEach((source, k) => sourceShadows.render(k, shared.sourcePosition.value[k]));
      for (const lamp of lamps) lamp.visible = true;
      shared.sourceShadow.value = sourceShadows.texture;
    }
  }

  function draw() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight], ratio = Math.min(window.devicePixelRatio || 1, 2);
    if (canvas.width !== Math.floor(width * ratio) || canvas.height !== Math.floor(height * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(width, height, false);
    }
    if (camera.aspect !== width / height) {
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    if (shared.shown.value === 0) drawShadows();
    bulb.position.copy(controls.light);
    bulb.scale.setScalar(0.012 * camera.position.distanceTo(controls.light));
    bulb.visible = shared.shown.value === 0 && settings.showsLight;
    controls.showLight(bulb.visible);
    renderer.render(world, camera);
  }

  // ---------------------------------------------------------------- settings

  const home = bounds[0].clone().lerp(bounds[1], 0.5);
  home.z = bounds[0].z + 0.6 * (bounds[1].z - bounds[0].z);
  // a grey surface at a third of the room's size reflects about 0.2
  const unit = 0.4 * Math.PI * (controls.size / 3) ** 2;
  const settings = { stops: 0, power: 0, fill: 0.06, showsLight: true };
  const ui = {};

  function slider(name, label, min, max, step, value, show, set) {
    const output = element("output"), box = element("input", { id: name, type: "range", min, max, step, value, oninput: () => apply(Number(box.value)) });
    function apply(given) {
      box.value = given;
      set(given);
      output.textContent = show(given);
      box.setAttribute("aria-valuetext", show(given));
      changed();
    }
    ui[name] = { apply, get: () => Number(box.value) };
    return element("label", {}, label, box, output);
  }
  function checkbox(name, label, value, isDisabled, set) {
    const box = element("input", { id: name, type: "checkbox", disabled: isDisabled ? "" : null, onchange: () => apply(box.checked) });
    function apply(given) {
      box.checked = given && !isDisabled;
      set(box.checked);
      changed();
    }
    ui[name] = { apply, get: () => box.checked };
    box.checked = value;
    return element("label", { class: "check" }, box, label);
  }
  const metres = (value) => `${value.toFixed(2)} m`, stops = (value) => `${value >= 0 ? "+" : ""}${value.toFixed(1)} EV`;

  function choose(number) {
    if (!ui.shown.options[number] || ui.shown.options[number].disabled) return;
    ui.shown.value = number;
    shared.shown.value = number;
    $("spoken").textContent = `shown: ${SHOWN[number]}`;
    const colors = (share) => `rgb(${data.colorMap[Math.round(255 * share)]})`;
    const legend = $("legend");
    legend.hidden = ![3, 4, 6].includes(number);
    if (number === 3 || number === 6) legend.replaceChildren(number === 3 ? "R 0" : "network", element("i", { style: `background:linear-gradient(90deg,${Array.from({ length: 17 }, (_, k) => colors(k / 16))})` }), number === 3 ? "1" : "light");
    if (number === 4) legend.replaceChildren(element("i", { class: "one", style: `background:${colors(0.95)}` }), "seen", element("i", { class: "one", style: `background:${colors(0.15)}` }), "filled in");
    changed();
  }

  function setMode(mode) {
    ui.mode.value = mode;
    controls.setMode(mode);
    $("spoken").textContent = mode === "fly" ? "camera turns about its position" : "camera turns around the asset";
  }

  // A view from the edge of the room: from the camera farthest from the others, towards the cameras' centre.
  const OUTSIDE = -1, ROOM = -2;
  function wholeRoom() {
    const at = data.cameras.map((c) => new T.Vector3(...c.position));
    const apart = at.map((from) => at.reduce((sum, to) => sum + from.distanceTo(to), 0));
    const first = apart.indexOf(Math.max(...apart));
    if (first < 0 || apart[first] < 0.5 * at.length) return null; // cameras at one position determine no edge
    const middle = at.reduce((sum, to) => sum.add(to), new T.Vector3()).divideScalar(at.length);
    return { name: "room", fov: 75, position: at[first].toArray(), target: middle.toArray() };
  }
  const room = wholeRoom();

  let current = OUTSIDE;
  function lookFrom(number) {
    current = number;
    const from = number === ROOM ? room : data.cameras[number];
    if (from) {
      controls.look(from.position, from.target, from.fov);
      setMode("fly");
    } else { // from outside, or where an asset has no cameras
      const at = controls.center.clone().add(new T.Vector3(-0.75, -1, 0.6).normalize().multiplyScalar(1.3 * controls.size));
      setMode("orbit"); // before the camera moves, since setMode preserves the centre of rotation
      controls.look(at.toArray(), controls.center.toArray(), 50);
    }
    ui.camera.value = from ? number : OUTSIDE;
    $("spoken").textContent = `camera ${from ? from.name : "outside"}`;
  }

  function build() {
    const axis = (k, label) => slider(`light-${"xyz"[k]}`, label, bounds[0].getComponent(k) - controls.size, bounds[1].getComponent(k) + controls.size, 0.01, 0, metres,
      (value) => { const to = controls.light.clone(); to.setComponent(k, value); controls.light.copy(to); });
    const isMissing = { 4: !data.materials.some((m) => m.hasMask), 6: !data.materials.some((m) => m.hasConfidence) };
    ui.shown = element("select", { id: "shown", onchange: () => choose(Number(ui.shown.value)) }, ...SHOWN.map((text, number) =>
      element("option", { value: number, text, disabled: isMissing[number] ? "" : null })));
    ui.camera = element("select", { id: "camera", onchange: () => lookFrom(Number(ui.camera.value)) }, ...(room ? [element("option", { value: ROOM, text: "the room" })] : []), element("option", { value: OUTSIDE, text: "outside" }), ...data.cameras.map((c, k) => element("option", { value: k, text: c.name })));
    ui.mode = element("select", { id: "mode", onchange: () => setMode(ui.mode.value) }, element("option", { value: "orbit", text: "turn around the asset" }), element("option", { value: "fly", text: "look around" }));
    const sizes = data.materials.flatMap((m) => m.images.map(([, , width, height]) => Math.max(width, height)));
    document.querySelector("aside").append(
      element("h1", { text: data.title }),
      element("label", { class: "wide" }, "shown", ui.shown), element("label", { class: "wide" }, "camera", ui.camera), element("label", { class: "wide" }, "dragging", ui.mode),
      slider("exposure", "exposure", -8, 8, 0.1, 0, stops, (value) => { settings.stops = value; shared.exposure.value = 2 ** value; }),
      element("h2", { text: "Light" }),
      slider("power", "power", -6, 6, 0.1, 0, stops, (value) => { settings.power = value; shared.lightIntensity.value.setScalar(unit * 2 ** value); }),
      slider("fill", "fill", 0, 1, 0.01, 0.06, (value) => value.toFixed(2), (value) => { settings.fill = value; shared.fill.value = value; }),
      axis(0, "x"), axis(1, "y"), axis(2, "z"),
      checkbox("shadows", "shadows", true, false, (value) => { shared.hasShadows.value = value; }),
      element("p", { class: "note", text: "Drag the yellow ball, or use the keys, to move the point light. Fill approximates light from all directions." }),
      element("h2", { text: "Lights of the room" }),
      checkbox("sources", "switched on", false, !data.sources.length, (value) => { shared.numSources.value = value ? data.sources.length : 0; }),
      element("p", { class: "note", id: "sources-note", text: data.sources.length ? `${data.numLights === 1 ? "1 light" : `${data.numLights} lights`}, as ${data.sources.length === 1 ? "1 point" : `${data.sources.length} points`} at their centres; without reflected light.` : "There are none that this page can show." }),
      element("h2", { text: "Keys" }),
      element("ul", {}, ...["W A S D, Q E: move", "arrows: turn", "I J K L, U O: move the light", "1 to 7: displayed quantity", "[ ]: exposure", "C: next camera; F: look or turn around", "with Shift: farther"].map((text) => element("li", { text }))),
      element("p", { class: "note", id: "sizes", text: `${data.materials.length} ${data.materials.length === 1 ? "material" : "materials"}, textures up to ${Math.max(1, ...sizes)} texels per side` }),
      ...data.notes.map((text) => element("p", { class: "note", text })));
    controls.whenLightMoves(() => { for (const k of [0, 1, 2]) ui[`light-${"xyz"[k]}`].apply(controls.light.getComponent(k)); });
    for (const name of ["exposure", "power", "fill", "shadows", "sources"]) ui[name].apply(ui[name].get());
    ui.power.apply(0);
    controls.moveLight(home);
    lookFrom(room ? ROOM : data.cameras.length ? 0 : OUTSIDE);
    choose(0);
  }

  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const far = (event.shiftKey ? 4 : 1) * controls.size * 0.01, angle = event.shiftKey ? 0.2 : 0.05;
    const pushed = (x, y, z) => () => controls.moveLight(controls.light.clone().add(new T.Vector3(x, y, z).multiplyScalar(far)));
    const act = {
      w: () => controls.move(0, 0, far), s: () => controls.move(0, 0, -far), a: () => controls.move(-far, 0, 0), d: () => controls.move(far, 0, 0), q: () => controls.move(0, -far, 0), e: () => controls.move(0, far, 0),
      ArrowLeft: () => controls.turn(angle, 0), ArrowRight: () => controls.turn(-angle, 0), ArrowUp: () => controls.turn(0, angle), ArrowDown: () => controls.turn(0, -angle),
      j: pushed(-1, 0, 0), l: pushed(1, 0, 0), k: pushed(0, -1, 0), i: pushed(0, 1, 0), u: pushed(0, 0, -1), o: pushed(0, 0, 1),
      "[": () => ui.exposure.apply(Math.max(settings.stops - 0.5, -8)), "]": () => ui.exposure.apply(Math.min(settings.stops + 0.5, 8)),
      c: () => lookFrom(current + 1 < data.cameras.length ? current + 1 : room ? ROOM : OUTSIDE), f: () => setMode(controls.mode() === "fly" ? "orbit" : "fly"),
    }[event.key.length === 1 ? event.key.toLowerCase() : event.key] || (/^[1-7]$/.test(event.key) ? () => choose(Number(event.key) - 1) : null);
    if (!act) return;
    event.preventDefault();
    act();
  });

  // ---------------------------------------------------------------- images

  function loadScript(source) {
    return new Promise((resolve, reject) => {
      const script = element("script", { src: source });
      script.onload = () => { script.remove(); resolve(); };
      script.onerror = () => { script.remove(); reject(new Error(`${source} cannot be loaded: write the page again`)); };
      document.head.append(script);
    });
  }

  async function put(name, text) {
    const blob = new Blob([numbers(text)], { type: "image/png" });
    const picture = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
    const { uniform, isColor } = holders.get(name);
    uniform.value.dispose();
    uniform.value = texture(picture, picture.width, picture.height, isColor);
    changed();
  }

  async function loadImages() {
    await loadScript("data/preview.js");
    const previews = VIEW.preview;
    delete VIEW.preview;
    await Promise.all(Object.entries(previews).map(([name, text]) => put(name, text)));
    draw();
    performance.mark("preview");
    document.documentElement.dataset.ready = "preview";
    for (const material of data.materials) for (const [name, , width, height] of material.images) {
      if (Math.max(width, height) <= 1024) continue; // the preview is the full image
      await loadScript(`data/${name}.js`);
      const text = VIEW.images[name];
      delete VIEW.images[name];
      await put(name, text);
    }
    draw();
    performance.mark("full");
    document.documentElement.dataset.ready = "true";
  }

  document.title = `${data.title}: 3D`;
  build();
  new ResizeObserver(changed).observe(canvas);
  // for tests and scripts
  Object.assign(VIEW, {
    state: () => ({ ...settings, shown: shared.shown.value, light: controls.light.toArray(), camera: camera.position.toArray(), target: controls.target().toArray(), fov: camera.fov, intensity: shared.lightIntensity.value.x, shadows: ui.shadows.get(), sources: ui.sources.get() }),
    set(wanted) {
      if (wanted.camera) controls.look(wanted.camera, wanted.target, wanted.fov);
      if (wanted.light) controls.moveLight(new T.Vector3(...wanted.light));
      if (wanted.showsLight !== undefined) settings.showsLight = wanted.showsLight;
      for (const name of ["exposure", "power", "fill", "shadows", "sources"]) if (wanted[name] !== undefined) ui[name].apply(wanted[name]);
      draw();
    },
    // displayed colours of pixels (RGBA, rows from the top)
    read(x, y, width = 1, height = 1) {
      draw();
      const gl = renderer.getContext(), bytes = new Uint8Array(4 * width * height);
      gl.readPixels(x, canvas.height - y - height, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return Array.from({ length: height }, (_, row) => [...bytes.slice(4 * width * (height - 1 - row), 4 * width * (height - row))]).flat();
    },
  });
  draw();
  try {
    await loadImages();
  } catch (error) {
    complain(error.message);
  }
})();
