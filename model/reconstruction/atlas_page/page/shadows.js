// SPDX-License-Identifier: MIT
// Shadow maps of point lights: distances to the nearest surface through the six faces of a cube around each light.
// Layer 6 k + f of the texture array is face f of light k. Faces look along +x, -x, +y, -y, +z, -z, with +z up, or
// +y for the last two; the shader selects them by the same rule. Distances, divided by `range`, have 24 bits in RGB.
"use strict";

VIEW.MAX_SOURCES = 8; // as in sources.py

VIEW.shadowShader = {
  vertex: `
    precision highp float;
    uniform mat4 viewMatrix, projectionMatrix;
    in vec3 position;
    out vec3 point;
    void main() {
      point = position;
      gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
    }`,

  fragment: `
    precision highp float;
    uniform vec3 cameraPosition;
    uniform float range;
    in vec3 point;
    out vec4 color;
    void main() {
      float steps = floor(clamp(distance(point, cameraPosition) / range, 0.0, 1.0) * 16777215.0);
      color = vec4(floor(steps / 65536.0), floor(mod(steps, 65536.0) / 256.0), mod(steps, 256.0), 255.0) / 255.0;
    }`,

  // `n` is the normal of the plane through `point`: every texel is compared with that plane's distance along the
  // texel's ray, so a plane does not shadow itself at any inclination.
  visibility: `
    float storedDistance(sampler2DArray maps, ivec2 texel, int layer, float range) {
      vec3 bytes = floor(texelFetch(maps, ivec3(texel, layer), 0).rgb * 255.0 + 0.5);
      return dot(bytes, vec3(65536.0, 256.0, 1.0)) / 16777215.0 * range;
    }

    // share in [0, 1] of a light at 'from' that reaches 'point', interpolated bilinearly between four texels
    float visibility(sampler2DArray maps, int light, vec3 from, vec3 point, vec3 n, float range) {
      vec3 way = point - from, size = abs(way);
      float far = length(way);
      int axis = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2;
      vec3 ahead = vec3(0.0), up = axis == 2 ? vec3(0.0, 1.0, 0.0) : vec3(0.0, 0.0, 1.0);
      ahead[axis] = way[axis] < 0.0 ? -1.0 : 1.0;
      vec3 right = cross(ahead, up);
      int side = textureSize(maps, 0).x, layer = 6 * light + 2 * axis + (way[axis] < 0.0 ? 1 : 0);
      vec2 at = (vec2(dot(way, right), dot(way, up)) / max(size[axis], 1e-9) * 0.5 + 0.5) * float(side) - 0.5;
      vec2 low = floor(at), share = at - low;
      float height = dot(n, way), seen = 0.0;
      for (int k = 0; k < 4; k++) {
        vec2 corner = vec2(k & 1, k >> 1), weight = mix(1.0 - share, share, corner);
        vec2 texel = clamp(low + corner, 0.0, float(side - 1));
        vec2 tangent = (texel + 0.5) / float(side) * 2.0 - 1.0;
        float slope = dot(n, normalize(ahead + tangent.x * right + tangent.y * up));
        // the plane's distance on the texel's ray, at least 0.8 of the point's, since a curved surface leaves its plane
        float plane = abs(slope) > 1e-4 ? height / slope : far;
        float expected = plane > 0.0 ? clamp(plane, 0.8 * far, far) : far;
        float stored = storedDistance(maps, ivec2(texel), layer, range);
        seen += weight.x * weight.y * (stored >= 0.99 * expected - 1e-4 * range ? 1.0 : 0.0);
      }
      return seen;
    }`,
};

// Maps of `count` lights with `side` texels per side, of those meshes of `world` that `render` leaves visible.
VIEW.makeShadows = (renderer, world, count, side, near, range) => {
  const T = THREE;
  const target = new T.WebGLArrayRenderTarget(side, side, 6 * count, { minFilter: T.NearestFilter, magFilter: T.NearestFilter, generateMipmaps: false });
  const material = new T.RawShaderMaterial({ glslVersion: T.GLSL3, vertexShader: VIEW.shadowShader.vertex, fragmentShader: VIEW.shadowShader.fragment, uniforms: { range: { value: range } }, side: T.DoubleSide });
  const camera = new T.PerspectiveCamera(90, 1, near, range);

  function render(light, position) {
    renderer.setClearColor(0xffffff, 1);
    world.overrideMaterial = material;
    for (let face = 0; face < 6; face++) {
      const axis = face >> 1, ahead = new T.Vector3().setComponent(axis, face % 2 ? -1 : 1);
      camera.up.set(0, axis === 2 ? 1 : 0, axis === 2 ? 0 : 1);
      camera.position.copy(position);
      camera.lookAt(ahead.add(position));
      renderer.setRenderTarget(target, 6 * light + face);
      renderer.clear();
      renderer.render(world, camera);
    }
    world.overrideMaterial = null;
    renderer.setRenderTarget(null);
    renderer.setClearColor(0x000000, 1);
  }
  return { texture: target.texture, render };
};
