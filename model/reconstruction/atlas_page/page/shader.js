// SPDX-License-Identifier: MIT
// The project's BSDF (docs/bsdf.md, model/shading.py) for the movable light and the asset's own sources: (1-S) D/pi + F D_b G1 G1 / (4 cos cos)
// with Beckmann's distribution, the exact Smith term and Schlick's Fresnel term; alpha = R^2 in [1e-3, 1].
// n normal, o to the viewer, i to the light, h half vector. World space, metres, Z up.
"use strict";

VIEW.shader = {
  vertex: `
    precision highp float;
    uniform mat4 viewMatrix, projectionMatrix;
    in vec3 position, normal;
    in vec2 uv;
    out vec3 point, shadingNormal;
    out vec2 at;
    void main() {
      point = position;
      shadingNormal = normal;
      at = vec2(uv.x, 1.0 - uv.y); // row 0 of an image is at v = 1
      gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
    }`,

  fragment: `
    precision highp float;
    precision highp sampler2DArray;
    uniform sampler2D diffuseMap, specularMap, roughMap, colorMap;
    uniform sampler2DArray lightShadow, sourceShadow;
    uniform vec3 cameraPosition, lightPosition, lightIntensity, emission;
    uniform float exposure, fill; // fill: uniform incident radiance, an approximation
    uniform float range; // of the stored distances
    uniform bool hasShadows;
    // the asset's own lights (sources.py); numSources is 0 while they are off
    uniform int numSources;
    uniform vec3 sourcePosition[${VIEW.MAX_SOURCES}], sourceVector[${VIEW.MAX_SOURCES}], sourceRadiance[${VIEW.MAX_SOURCES}];
    uniform float sourceRest[${VIEW.MAX_SOURCES}];
    uniform int shown; // 0 lit, 1 D, 2 S, 3 R, 4 seen, 5 normal, 6 confidence
    uniform bool isLamp;
    in vec3 point, shadingNormal;
    in vec2 at;
    out vec4 color;
    const float PI = 3.14159265358979;

    // Abramowitz and Stegun 7.1.26 for x >= 0, off by at most 1.5e-7
    float erfPositive(float x) {
      float t = 1.0 / (1.0 + 0.3275911 * x);
      return 1.0 - ((((1.061405429 * t - 1.453152027) * t + 1.421413741) * t - 0.284496736) * t + 0.254829592) * t * exp(-x * x);
    }

    // G1 / cos: finite down to the horizon
    float smithOverCos(float cosine, float sine2, float alpha) {
      float sine = sqrt(max(sine2, 1e-12)); // avoids division by 0 at the pole
      float a = min(cosine / (alpha * sine), 1e4); // avoids overflow of its square
      return 2.0 / (cosine * (1.0 + erfPositive(a)) + alpha * sine * exp(-a * a) / sqrt(PI));
    }

    vec3 brdfCos(vec3 D, vec3 S, float R, vec3 n, vec3 o, vec3 i) {
      float cosO = dot(n, o), cosI = dot(n, i);
      if (cosO <= 0.0 || cosI <= 0.0) return vec3(0.0);
      float alpha = clamp(R * R, 1e-3, 1.0);
      vec3 tangentO = cross(n, o), tangentI = cross(n, i), tangentH = tangentO + tangentI;
      float cosH = cosO + cosI; // of i + o, not normalised
      float tan2 = dot(tangentH, tangentH) / max(cosH * cosH, 1e-12);
      float lobe = exp(-tan2 / (alpha * alpha) - log(PI) - 2.0 * log(alpha) + 2.0 * log(1.0 + tan2));
      lobe *= smithOverCos(cosO, dot(tangentO, tangentO), alpha) * smithOverCos(cosI, dot(tangentI, tangentI), alpha);
      float m = clamp(1.0 - 0.5 * length(i + o), 0.0, 1.0);
      vec3 F = S + (1.0 - S) * (m * m * m * m * m);
      return (1.0 - S) * D * (cosI / PI) + F * (lobe * 0.25 * cosI);
    }

    ${VIEW.shadowShader.visibility}

    vec3 fromLight(vec3 D, vec3 S, float R, vec3 n, vec3 o, vec3 plane) {
      vec3 toLight = lightPosition - point;
      float distance2 = max(dot(toLight, toLight), 1e-8); // avoids division by 0 for a light on the surface
      vec3 radiance = brdfCos(D, S, R, n, o, toLight * inversesqrt(distance2)) * lightIntensity / distance2;
      return hasShadows ? radiance * visibility(lightShadow, 0, lightPosition, point, plane, range) : radiance;
    }

    // A source as a point of intensity L (max(V w, 0) + rest). The term area / pi bounds the irradiance at contact, and
    // is exact on a disk's axis.
    vec3 fromSources(vec3 D, vec3 S, float R, vec3 n, vec3 o, vec3 plane) {
      vec3 radiance = vec3(0.0);
      for (int k = 0; k < numSources; k++) {
        vec3 toLight = sourcePosition[k] - point, i = normalize(toLight);
        float area = length(sourceVector[k]) + sourceRest[k];
        float projected = max(-dot(sourceVector[k], i), 0.0) + sourceRest[k];
        vec3 reflected = brdfCos(D, S, R, n, o, i) * sourceRadiance[k] * projected / (dot(toLight, toLight) + area / PI);
        if (reflected != vec3(0.0)) radiance += reflected * visibility(sourceShadow, k, sourcePosition[k], point, plane, range);
      }
      return radiance;
    }

    vec3 screen(vec3 linear) {
      linear = clamp(linear, 0.0, 1.0);
      return mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
    }

    vec3 scale(float value) { return texture(colorMap, vec2(value * 255.0 / 256.0 + 0.5 / 256.0, 0.5)).rgb; }

    void main() {
      if (isLamp && shown > 0) { color = vec4(vec3(0.2), 1.0); return; }
      if (isLamp && numSources > 0) { color = vec4(screen(emission * exposure), 1.0); return; } // grey if switched off
      vec3 plane = normalize(cross(dFdx(point), dFdy(point)));
      vec3 D = texture(diffuseMap, at).rgb, S = texture(specularMap, at).rgb;
      vec3 rough = texture(roughMap, at).rgb;
      vec3 o = normalize(cameraPosition - point), n = normalize(shadingNormal);
      if (dot(n, o) < 0.0) n = -n; // surfaces are two-sided
      if (shown == 0) {
        vec3 radiance = fromLight(D, S, rough.r, n, o, plane) + fromSources(D, S, rough.r, n, o, plane);
        radiance += fill * ((1.0 - S) * D + S);
        color = vec4(screen(radiance * exposure), 1.0);
      } else if (shown == 1) color = vec4(screen(D), 1.0);
      else if (shown == 2) color = vec4(screen(S), 1.0);
      else if (shown == 3) color = vec4(scale(rough.r), 1.0);
      else if (shown == 4) color = vec4(texture(colorMap, vec2(rough.g > 0.75 ? 0.95 : 0.15, 0.5)).rgb, 1.0);
      else if (shown == 5) color = vec4(0.5 + 0.5 * n, 1.0);
      else color = vec4(scale(rough.b), 1.0);
    }`,
};
