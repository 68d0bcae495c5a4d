# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the bundled panoramas from CC0 environment maps, reduced to 768 x 384 texels of half floats.

The maps are Radiance files (.hdr) of 1024 x 512 from Poly Haven, and those in Blender's
``datafiles/studiolights/world``. Radiances are not rescaled, and the sun's disc is not clipped. EXR's lossy
DWAB compression changes radiances by 3 % on average and results in files of 0.2 to 0.5 MB.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import Daytime, PanoramaAsset, Provenance
from datagen.formats.package import write_package
from datagen.foundation.errors import input_error
from datagen.foundation.images import read_image

SIZE_PX = (768, 384)
_LEVEL = 100.0  # DWAB compression level
_MAX_RADIANCE = 60000.0  # below the largest half float
_FLOOR = 1e-5  # initial minimum of radiances, doubled until none is negative after compression
_IMAGE = "panorama.exr"


@dataclass(frozen=True)
class Source:
    """A panorama; ``file`` is in the folder of Poly Haven's maps or, if ``is_blender``, of Blender's maps."""

    id: str
    title: str
    daytime: Daytime
    file: str
    is_blender: bool = False

    @property
    def provenance(self) -> Provenance:
        """Licence, author and origin of the map."""
        if self.is_blender:
            where = f"Blender, datafiles/studiolights/world/{self.file}; hdrihaven.com"
            return Provenance(license="CC0-1.0", author="Greg Zaal, HDRI Haven", source=where)
        name = self.file.removesuffix("_1k.hdr")
        return Provenance(license="CC0-1.0", author="Poly Haven", source=f"https://polyhaven.com/a/{name}")


PANORAMAS: Sequence[Source] = (
    Source("hills", "Green hills", "day", "hilly_terrain_01_1k.hdr"),
    Source("meadow", "Meadow at noon", "day", "noon_grass_1k.hdr"),
    Source("heath", "Heath under small clouds", "day", "kloppenheim_05_1k.hdr"),
    Source("office-yard", "Yard between modern buildings", "day", "modern_buildings_2_1k.hdr"),
    Source("water-garden", "Garden with a pond", "day", "chinese_garden_1k.hdr"),
    Source("high-street", "Square with high buildings", "overcast", "city.exr", is_blender=True),
    Source("park-path", "Path in a park", "overcast", "forest.exr", is_blender=True),
    Source("forest-trail", "Trail in a forest", "overcast", "rainforest_trail_1k.hdr"),
    Source("seafront", "Seafront at sunset", "dusk", "sunset.exr", is_blender=True),
    Source("misty-field", "Field in the low sun", "dusk", "sunrise.exr", is_blender=True),
    Source("night-square", "Lit square at night", "night", "st_peters_square_night_1k.hdr"),
    Source("night-field", "Field with lights at the horizon", "night", "night.exr", is_blender=True),
    Source("moonlit-road", "Road in the moonlight", "night", "narrow_moonlit_road_1k.hdr"),
)


def write_panoramas(folder: Path, blender: Path, out: Path) -> list[Path]:
    """Write panorama packages below ``out`` from the maps in ``folder`` (Poly Haven's) and ``blender``;
    return the packages' folders. Raises :class:`InputError` for a missing map."""
    written = []
    for source in PANORAMAS:
        path = (blender if source.is_blender else folder) / source.file
        if not path.is_file():
            raise input_error(
                path, got="no such file", expected="an environment map", remedy="name its folder"
            )
        target = out / "panoramas" / source.id
        asset = PanoramaAsset(
            id=source.id,
            title=source.title,
            provenance=source.provenance,
            image=_IMAGE,
            daytime=source.daytime,
        )
        write_package(target, asset, {_IMAGE: encoded(reduced(radiance_of(path)))}, overwrite=True)
        written.append(target)
    return written


def radiance_of(path: Path) -> NDArray[np.float32]:
    """Read the radiance (H, W, 3) from a Radiance (.hdr) or EXR file, clipped to [0, 60000]."""
    if path.suffix == ".exr":
        pixels = read_image(path)[..., :3]
    else:
        import cv2

        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    return np.clip(np.nan_to_num(pixels, posinf=_MAX_RADIANCE), 0.0, _MAX_RADIANCE).astype(np.float32)


def reduced(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Reduce an image (H, W, 3) to :data:`SIZE_PX` by averaging over areas."""
    import cv2

    return np.asarray(cv2.resize(pixels, SIZE_PX, interpolation=cv2.INTER_AREA), dtype=np.float32)


def encoded(pixels: NDArray[np.float32]) -> bytes:
    """Encode an image (H, W, 3) as half-float EXR, without the negative values that DWAB causes near 0."""
    floor = _FLOOR
    while True:
        data, least = _encoded(np.maximum(pixels, floor))
        if least >= 0:
            return data
        floor *= 2


def _encoded(pixels: NDArray[np.float32]) -> tuple[bytes, float]:
    """Encode an image (H, W, 3) as EXR; return the bytes and the minimum of the decoded values."""
    import OpenEXR

    header = {
        "compression": OpenEXR.DWAB_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "dwaCompressionLevel": _LEVEL,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / _IMAGE
        OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels.astype(np.float16))}).write(str(path))
        return path.read_bytes(), float(read_image(path).min())
