# SPDX-License-Identifier: MIT
"""Runs xatlas in a separate process, since it may crash on large or broken meshes.

``python -m model.reconstruction.unwrap.xatlas_process IN.npz OUT.npz``: IN contains ``positions`` (N, 3) and
``faces`` (M, 3); OUT contains ``corners`` (M, 3, 2), the triangle corners on a sheet in metres, the sheet's
size ``size_m`` (2,), and ``is_placed`` (M,), the mask of triangles that were unwrapped.

xatlas discards edges shorter than 1e-4 and triangles smaller than 1.2e-7 in its units; in metres, finely
tessellated objects would vanish. The mesh is therefore passed in units of the median edge length.
"""

from __future__ import annotations

import sys

import numpy as np

PACK_RESOLUTION, PADDING = 1024, 2


def main(source: str, target: str) -> None:
    """Unwrap the mesh in the file ``source`` and write the result to the file ``target``."""
    import xatlas

    with np.load(source) as data:
        positions, faces = data["positions"], data["faces"]
    unit_m = _median_edge_m(positions.astype(np.float64), faces)
    atlas = xatlas.Atlas()
    atlas.add_mesh((positions / unit_m).astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = PACK_RESOLUTION, PADDING, True
    options.create_image = False
    atlas.generate(xatlas.ChartOptions(), options)
    sheet, _ = atlas.get_mesh_vertex_assignment(0)
    vertex, indices, uv = atlas.get_mesh(0)
    indices = indices.reshape(-1, 3)
    if len(indices) != len(faces) or not np.array_equal(vertex[indices], faces):
        raise SystemExit("xatlas changed the order of the triangles")
    used = sheet[indices.ravel()]
    is_placed = used < atlas.atlas_count
    shift = np.where(is_placed, used, 0)[:, None] * [float(atlas.width), 0.0]  # sheets are side by side
    texels = uv[indices.ravel()] * [float(atlas.width), float(atlas.height)] + shift
    texel_m = unit_m / atlas.texels_per_unit
    corners = (texels * texel_m).reshape(-1, 3, 2)
    size = np.array([atlas.width * atlas.atlas_count, atlas.height]) * texel_m
    np.savez(target, corners=corners, size_m=size, is_placed=is_placed.reshape(-1, 3).all(axis=1))


def _median_edge_m(positions: np.ndarray, faces: np.ndarray) -> float:
    """Compute the median length of the triangles' edges in metres; 1 if it is 0."""
    corners = positions[faces]
    median = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    return median if median > 0 else 1.0


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
