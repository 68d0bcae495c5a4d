// SPDX-License-Identifier: MIT
// The parts of three.js that the 3D page uses; the bundle contains nothing else.
export {
  BufferAttribute, BufferGeometry, DataTexture, DoubleSide, GLSL3, LinearFilter, LinearMipmapLinearFilter, Mesh, MeshBasicMaterial,
  NearestFilter, PerspectiveCamera, Plane, RawShaderMaterial, Raycaster, RepeatWrapping, Scene, SphereGeometry, SRGBColorSpace, Texture,
  Vector2, Vector3, WebGLArrayRenderTarget, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
