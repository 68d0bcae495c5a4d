// SPDX-License-Identifier: MIT
// What the 3D page takes from three.js; the rest is left out of the bundle.
export {
  BufferAttribute, BufferGeometry, DataTexture, DoubleSide, GLSL3, LinearFilter, LinearMipmapLinearFilter, Mesh, MeshBasicMaterial,
  NearestFilter, PerspectiveCamera, Plane, RawShaderMaterial, Raycaster, RepeatWrapping, Scene, SphereGeometry, SRGBColorSpace, Texture,
  Vector2, Vector3, WebGLArrayRenderTarget, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
