// SPDX-License-Identifier: MIT
// Moves the camera (around a point, or about its own position) and the light, by pointer and keys.
"use strict";

VIEW.makeControls = (camera, canvas, bounds, changed) => {
  const { Plane, Raycaster, Vector2, Vector3, OrbitControls } = THREE;
  const size = Math.max(bounds[0].distanceTo(bounds[1]), 1e-3);
  const center = bounds[0].clone().add(bounds[1]).multiplyScalar(0.5);
  const orbit = new OrbitControls(camera, canvas);
  orbit.zoomSpeed = 0.7;
  orbit.addEventListener("change", changed);
  let mode = "orbit";
  const light = new Vector3();
  let isLightShown = true;

  // "fly" rotates the camera about its position: the centre of rotation is just in front of it
  function setMode(wanted) {
    mode = wanted;
    const ahead = camera.getWorldDirection(new Vector3());
    const distance = mode === "fly" ? size * 1e-4 : Math.max(orbit.target.distanceTo(camera.position), size * 0.15);
    orbit.target.copy(camera.position).addScaledVector(ahead, distance);
    orbit.enableZoom = orbit.enablePan = mode === "orbit";
    orbit.rotateSpeed = mode === "fly" ? -0.35 : 0.7;
    orbit.update();
    changed();
  }

  function look(position, target, fov) {
    camera.fov = fov;
    camera.position.set(...position);
    orbit.target.set(...target);
    camera.updateProjectionMatrix();
    orbit.update();
    if (mode === "fly") setMode("fly");
    changed();
  }

  function move(right, up, ahead) {
    const forward = camera.getWorldDirection(new Vector3());
    const step = forward.clone().cross(camera.up).normalize().multiplyScalar(right).addScaledVector(camera.up, up).addScaledVector(forward, ahead);
    camera.position.add(step);
    orbit.target.add(step);
    orbit.update();
    changed();
  }

  // angles in radians, positive to the left and up
  function turn(left, up) {
    const sign = mode === "fly" ? 1 : -1;
    const arm = mode === "fly" ? orbit.target.clone().sub(camera.position) : camera.position.clone().sub(orbit.target);
    const length = arm.length();
    const azimuth = Math.atan2(arm.y, arm.x) + sign * left;
    const height = Math.max(-1.55, Math.min(1.55, Math.asin(Math.max(-1, Math.min(1, arm.z / length))) + sign * up));
    arm.set(Math.cos(azimuth) * Math.cos(height), Math.sin(azimuth) * Math.cos(height), Math.sin(height)).multiplyScalar(length);
    if (mode === "fly") orbit.target.copy(camera.position).add(arm);
    else camera.position.copy(orbit.target).add(arm);
    orbit.update();
    changed();
  }

  // ---------------------------------------------------------------- the light under the pointer

  const caster = new Raycaster();
  const toDevice = (event) => new Vector2((event.offsetX / canvas.clientWidth) * 2 - 1, 1 - (event.offsetY / canvas.clientHeight) * 2);
  function isOnLight(event) {
    const at = light.clone().project(camera);
    const [x, y] = [((at.x + 1) / 2) * canvas.clientWidth, ((1 - at.y) / 2) * canvas.clientHeight];
    return isLightShown && at.z < 1 && Math.hypot(x - event.offsetX, y - event.offsetY) < 16;
  }
  let plane = null;
  canvas.addEventListener("pointerdown", (event) => {
    if (!isOnLight(event)) return;
    plane = new Plane().setFromNormalAndCoplanarPoint(camera.getWorldDirection(new Vector3()), light);
    orbit.enabled = false;
    canvas.setPointerCapture(event.pointerId);
  }, { capture: true }); // before the camera's controls
  canvas.addEventListener("pointermove", (event) => {
    if (!plane) return canvas.classList.toggle("on-light", event.buttons === 0 && isOnLight(event));
    caster.setFromCamera(toDevice(event), camera);
    const hit = caster.ray.intersectPlane(plane, new Vector3());
    if (hit) moveLight(hit);
  });
  const drop = () => { plane = null; orbit.enabled = true; };
  canvas.addEventListener("pointerup", drop);
  canvas.addEventListener("pointercancel", drop);
  canvas.addEventListener("wheel", (event) => {
    if (mode !== "fly") return;
    event.preventDefault();
    move(0, 0, -Math.sign(event.deltaY) * size * 0.02);
  }, { passive: false });

  let onLight = () => {};
  function moveLight(to) {
    light.copy(to).clamp(bounds[0].clone().subScalar(size), bounds[1].clone().addScalar(size)); // farther away, it illuminates nothing
    onLight();
    changed();
  }

  return {
    light, size, center, look, move, turn, setMode, moveLight,
    mode: () => mode, target: () => orbit.target,
    whenLightMoves(call) { onLight = call; },
    showLight(isShown) { isLightShown = isShown; }, // a hidden one cannot be dragged
  };
};
