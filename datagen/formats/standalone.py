# SPDX-License-Identifier: MIT
"""Configuration made of a single environment package, with its materials, lights and cameras."""

from __future__ import annotations

from pathlib import Path

from datagen.formats.asset import EnvironmentAsset
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.lights import located_light
from datagen.formats.package import open_package
from datagen.foundation.errors import input_error


def configuration_of(package_path: Path, content_hash: str, seed: int = 0) -> Configuration:
    """Configuration made of a single environment package; its cameras are named ``view_000``, ``view_001``...

    ``content_hash``: the package's SHA-256. Raises :class:`InputError` if it has no camera.
    """
    asset = open_package(package_path).asset
    if not isinstance(asset, EnvironmentAsset) or not asset.cameras:
        expected = "an environment with at least one camera"
        raise input_error(package_path, "kind", asset.kind, expected, "add a camera and export again")
    return Configuration(
        id=asset.id,
        index=0,
        seed=seed,
        environment=PlacedAsset(name="environment", asset=asset.id),
        lights=tuple(located_light(light, asset.id) for light in asset.lights),
        cameras=tuple(
            ViewCamera.from_camera(f"view_{index:03d}", camera.camera())
            for index, camera in enumerate(asset.cameras)
        ),
        assets={asset.id: content_hash},
    )
