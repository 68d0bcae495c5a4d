# SPDX-License-Identifier: MIT
"""Comparison of renderings of an imported scene and its original from the same camera.

Images are (H, W, 3) float32, scene-linear. The Mitsuba variant must have been selected before rendering.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import AssetCamera, EnvironmentAsset
from datagen.formats.configuration import Configuration, ViewCamera, configuration_of
from datagen.formats.mitsuba.scene import parse_scene
from datagen.formats.mitsuba.sensors import camera_of
from datagen.formats.package import Package
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera
from datagen.foundation.color import luminance
from datagen.foundation.errors import input_error
from datagen.foundation.findings import Findings
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from mitsuba_plugins.variant import select_variant

BLUR_SHARE = 0.01  # standard deviation of the blur, as a share of the image's width
_DARK_SHARE = 0.01  # pixels below this share of the mean are too dark for a ratio


def camera_at(camera: AssetCamera, width_px: int, height_px: int | None) -> Camera:
    """Return an asset's camera for an image of another width, by default of the same aspect ratio.

    With ``height_px``, the image is cropped or extended vertically about its centre, and the horizontal field
    of view is unchanged, since some reference images are square although the scene's camera is not.
    """
    if height_px is not None:
        scale = width_px / camera.width_px
        middle = 0.5 * height_px + (camera.cy_px - 0.5 * camera.height_px) * scale
        return replace(
            camera.camera(),
            width_px=width_px,
            height_px=height_px,
            fx_px=camera.fx_px * scale,
            fy_px=camera.fy_px * scale,
            cx_px=camera.cx_px * scale,
            cy_px=middle,
        )
    return camera.camera().scaled(width_px, round(width_px * camera.height_px / camera.width_px))


def render_original(
    path: Path, width_px: int, num_samples: int, max_depth: int, height_px: int | None = None
) -> NDArray[np.float32]:
    """Render the original scene (H, W, 3) from its first camera by Mitsuba's path tracer, with a box filter.

    Raises :class:`InputError` if it has no camera.
    """
    import mitsuba as mi

    file = path / "scene.xml" if path.is_dir() else path
    scene = mi.load_file(str(file), optimize=True)
    sensors = parse_scene(file).all_of("sensor")
    if not sensors:
        raise input_error(file, "sensor", "none", "a camera to render from")
    camera = camera_at(camera_of(sensors[0], 0, np.eye(4), Findings()), width_px, height_px)
    to_world = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(camera.fov_x_rad)),
            "fov_axis": "x",
            "principal_point_offset_x": camera.cx_px / camera.width_px - 0.5,
            "principal_point_offset_y": camera.cy_px / camera.height_px - 0.5,
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "film": {
                "type": "hdrfilm",
                "width": camera.width_px,
                "height": camera.height_px,
                "rfilter": {"type": "box"},
            },
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
    pixels = mi.render(scene, sensor=sensor, integrator=integrator, spp=num_samples, seed=mi.UInt32(0))
    return np.array(pixels)[..., :3].astype(np.float32)


def native_configuration(package: Package, width_px: int, height_px: int | None = None) -> Configuration:
    """Return a configuration of an environment alone, with its own lights, and its cameras at ``width_px``.

    Raises :class:`InputError` if it has no camera; ``height_px`` is as in :func:`camera_at`.
    """
    alone = configuration_of(package)
    assert isinstance(package.asset, EnvironmentAsset)
    cameras = tuple(
        ViewCamera.from_camera(f"view_{k:03d}", camera_at(camera, width_px, height_px))
        for k, camera in enumerate(package.asset.cameras)
    )
    return alone.model_copy(update={"id": f"{alone.id}-native", "cameras": cameras})


def render_converted(
    library: Library,
    asset_id: str,
    width_px: int,
    num_samples: int,
    max_depth: int,
    height_px: int | None = None,
) -> NDArray[np.float32]:
    """Render the imported environment (H, W, 3) from its first camera with this project, not denoised."""
    configuration = native_configuration(library.package(asset_id), width_px, height_px)
    recipe = RenderRecipe(
        variant=select_variant(),  # type: ignore[arg-type]
        path_samples=num_samples,
        auxiliary_samples=min(num_samples, 64),
        max_depth=max_depth,
        denoise=False,
    )
    renderer = SceneRenderer(configuration, library, recipe)
    return np.asarray(renderer.render_view(0).buffers["beauty"], dtype=np.float32)


@dataclass(frozen=True)
class Agreement:
    """Agreement of an image with its reference, computed from blurred luminance.

    ``correlation``: Pearson correlation. ``median_ratio``: median over pixels of the ratio to the reference,
    without dark pixels. ``mean_ratio``: ratio of the means. ``rel_l1``: sum of absolute differences, divided
    by the sum of the reference.
    """

    correlation: float
    median_ratio: float
    mean_ratio: float
    rel_l1: float


def agreement(image: NDArray, reference: NDArray) -> Agreement:
    """Compare two images of the same aspect ratio; the reference is resampled by area to the image's size.

    The luminances are blurred with a Gaussian of standard deviation ``BLUR_SHARE`` x width, then clipped at
    the 99th percentile of the reference, so that the few pixels of a visible lamp do not dominate.
    """
    import cv2
    from scipy.ndimage import gaussian_filter

    height, width = image.shape[:2]
    reference = cv2.resize(
        np.ascontiguousarray(reference[..., :3], dtype=np.float32),
        (width, height),
        interpolation=cv2.INTER_AREA,
    )
    image_y, reference_y = (luminance(np.asarray(i[..., :3], dtype=np.float64)) for i in (image, reference))
    image_y, reference_y = (gaussian_filter(i, BLUR_SHARE * width) for i in (image_y, reference_y))
    limit = np.percentile(reference_y, 99)
    image_y, reference_y = np.minimum(image_y, limit), np.minimum(reference_y, limit)
    lit = reference_y > _DARK_SHARE * reference_y.mean()
    return Agreement(
        correlation=float(np.corrcoef(image_y.ravel(), reference_y.ravel())[0, 1]),
        median_ratio=float(np.median(image_y[lit] / reference_y[lit])),
        mean_ratio=float(image_y.mean() / reference_y.mean()),
        rel_l1=float(np.abs(image_y - reference_y).sum() / reference_y.sum()),
    )
