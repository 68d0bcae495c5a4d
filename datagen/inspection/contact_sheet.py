# SPDX-License-Identifier: MIT
"""Contact sheets: one picture per configuration that shows its views.

Rows are views, columns are buffers. Radiance is exposed per view so that few pixels clip, and sRGB-encoded;
the exposure is written below the view's name. Albedos are sRGB-encoded without exposure; normals are mapped
from [-1, 1]; roughness, depth and count use cividis, a colour map suitable for colour-blind readers, with a
scale at the bottom. Pixels without a value (background, emitters) are hatched.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from datagen.farm.folder import DatasetFolder
from datagen.formats.base import write_bytes_atomically
from datagen.formats.shard import INDEX_FILE, Dataset, ShardReader
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.color import photographic_exposure, srgb_from_linear
from datagen.foundation.errors import InputError, Problem, raise_problems
from datagen.foundation.exr import decode_view
from datagen.foundation.images import quantized_bytes
from datagen.foundation.progress import Advance, no_advance

if TYPE_CHECKING:
    from PIL import Image, ImageDraw, ImageFont

COLUMNS = (
    ("beauty", "beauty"),
    ("diffuse_albedo", "D  diffuse albedo"),
    ("specular_albedo", "S  specular albedo"),
    ("roughness", "R  roughness"),
    ("normal_world", "normal (world)"),
    ("depth_z_m", "depth"),
    ("color_min", "minimum"),
    ("color_median", "median"),
    ("color_max", "maximum"),
    ("observation_count", "count"),
)
MAX_ROWS = 6
_CELL_WIDTH_PX = 320
_MARGIN_PX = 8
_TITLE_PX, _LABEL_PX = 32, 20
_INK, _PAPER, _FAINT = (235, 235, 235), (24, 24, 26), (150, 150, 155)
_NEEDS_SURFACE = (*MATERIAL_MAPS, "normal_world")


@dataclass(frozen=True)
class Scales:
    """Exposure factor of radiance, and upper ends of the colour scales of depth and observation count."""

    exposure: float
    farthest_m: float
    max_views: int

    @property
    def ends(self) -> dict[str, tuple[float, str]]:
        """Value and label of the upper end of each colour scale, by buffer."""
        return {
            "roughness": (1.0, "1"),
            "depth_z_m": (self.farthest_m, f"{self.farthest_m:.2f} m"),
            "observation_count": (self.max_views, f"{self.max_views} views"),
        }


def choose_rows(num_views: int, max_rows: int = MAX_ROWS) -> list[int]:
    """Indices of at most ``max_rows`` of ``num_views`` views, evenly spaced from the first to the last."""
    if num_views <= max_rows:
        return list(range(num_views))
    return sorted({round(i * (num_views - 1) / (max_rows - 1)) for i in range(max_rows)})


def choose_scales(views: Sequence[Mapping[str, NDArray]]) -> Scales:
    """Choose display scales for ``views``: exposure, 98th percentile of depth, and largest count."""
    colors, depths, counts = [np.zeros((0, 3))], [np.zeros(0)], [1.0]
    for view in views:
        if "beauty" in view:
            beauty = view["beauty"].astype(np.float64)
            mask = view["surface_mask"][..., 0] > 0.5 if "surface_mask" in view else np.ones(beauty.shape[:2])
            colors.append(beauty[mask.astype(bool)])
        if "depth_z_m" in view:
            depth = view["depth_z_m"][..., 0].astype(np.float64)
            depths.append(depth[np.isfinite(depth) & (depth > 0)])
        if "observation_count" in view:
            counts.append(float(np.nan_to_num(view["observation_count"]).max(initial=0)))
    depth = np.concatenate(depths)
    farthest = float(np.percentile(depth, 98)) if depth.size else 1.0
    return Scales(photographic_exposure(np.concatenate(colors)), farthest, int(max(counts)))


def exposure_of(view: Mapping[str, NDArray]) -> float:
    """The factor by which a view's radiance is multiplied for display."""
    return choose_scales([view]).exposure


def screen_image(name: str, view: Mapping[str, NDArray], scales: Scales) -> NDArray[np.uint8]:
    """sRGB picture (H, W, 3) of buffer ``name`` of a view, hatched where the buffer has no value."""
    array = view[name].astype(np.float64)
    is_valid = np.isfinite(array).all(axis=-1)
    array = np.where(np.isfinite(array), array, 0)
    if name in _NEEDS_SURFACE and "surface_mask" in view:
        is_valid &= view["surface_mask"][..., 0] > 0
    if name == "depth_z_m":
        is_valid &= array[..., 0] > 0
    if name in scales.ends:
        picture = _colored(array[..., 0] / scales.ends[name][0])
    elif name == "normal_world":
        picture = 0.5 + 0.5 * array
    else:
        exposure = 1.0 if name in ("diffuse_albedo", "specular_albedo") else scales.exposure
        picture = srgb_from_linear(array * exposure)
    picture = quantized_bytes(picture)
    rows, columns = np.indices(is_valid.shape)
    hatch = np.where(((rows + columns) // 4 % 2)[..., None] == 0, 58, 46).astype(np.uint8)
    return np.where(is_valid[..., None], picture, hatch)


def _colored(values: NDArray) -> NDArray:
    from matplotlib import colormaps

    return colormaps["cividis"](np.clip(values, 0, 1))[..., :3]


def make_contact_sheet(
    views: Sequence[Mapping[str, NDArray]], names: Sequence[str], title: str
) -> Image.Image:
    """Draw a row per view (arrays by buffer name), labelled by ``names``, under the heading ``title``.

    Buffers absent from all views get no column. Each view has its own exposure; the other scales are common
    to all views. Raises :class:`InputError` if there are no views or one lacks ``beauty``.
    """
    from PIL import Image, ImageDraw

    if not views or any("beauty" not in view for view in views):
        got = "no views" if not views else "a view without beauty"
        raise InputError(Problem("contact sheet", "views", got, "at least one view, each with beauty"))
    exposures = [exposure_of(view) for view in views]
    scales = choose_scales(views)
    columns = [(name, label) for name, label in COLUMNS if any(name in view for view in views)]
    heights = [_cell_size(view)[1] for view in views]
    column_width = max(_cell_size(view)[0] for view in views)
    notes = [f"exposure x {exposure:.3g}" for exposure in exposures]
    left = 2 * _MARGIN_PX + max(_label_width(text) for text in (*names, *notes))
    head = _TITLE_PX + _LABEL_PX + 5 * _MARGIN_PX
    width = left + len(columns) * (column_width + _MARGIN_PX)
    foot = 3 * _LABEL_PX + 2 * _MARGIN_PX
    height = head + sum(h + _MARGIN_PX for h in heights) + foot
    sheet = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((_MARGIN_PX, _MARGIN_PX), title, _INK, _font(_TITLE_PX))
    places = [left + index * (column_width + _MARGIN_PX) for index in range(len(columns))]
    for x, (_, label) in zip(places, columns, strict=True):
        draw.text((x, head - _LABEL_PX - 2 * _MARGIN_PX), label, _INK, _font(_LABEL_PX))
    y = head - _MARGIN_PX
    for view, name, note, exposure, cell_height in zip(views, names, notes, exposures, heights, strict=True):
        middle = y + cell_height // 2
        draw.text((_MARGIN_PX, middle - _LABEL_PX), name, _INK, _font(_LABEL_PX))
        draw.text((_MARGIN_PX, middle + 4), note, _FAINT, _font(_LABEL_PX))
        shown = replace(scales, exposure=exposure)
        for x, (buffer, _) in zip(places, columns, strict=True):
            if buffer in view:
                sheet.paste(_cell(screen_image(buffer, view, shown)), (x, y))
            else:
                draw.text((x, y), "not in this view", _FAINT, _font(_LABEL_PX))
        y += cell_height + _MARGIN_PX
    for x, (buffer, _) in zip(places, columns, strict=True):
        _draw_foot(sheet, draw, (x, y, column_width), buffer, scales)
    return sheet


def _cell_size(view: Mapping[str, NDArray]) -> tuple[int, int]:
    """Width and height of a view in the sheet in pixels; small images are enlarged by integer factors."""
    height, width = view["beauty"].shape[:2]
    if width < _CELL_WIDTH_PX:
        factor = max(1, round(_CELL_WIDTH_PX / width))
        return width * factor, height * factor
    return _CELL_WIDTH_PX, max(1, round(height * _CELL_WIDTH_PX / width))


def _cell(picture: NDArray[np.uint8]) -> Image.Image:
    from PIL import Image

    image = Image.fromarray(picture)
    size = _cell_size({"beauty": picture})
    resampling = Image.Resampling.NEAREST if size[0] >= image.width else Image.Resampling.BOX
    return image.resize(size, resampling)


def _draw_foot(
    sheet: Image.Image, draw: ImageDraw.ImageDraw, place: tuple[int, int, int], name: str, scales: Scales
) -> None:
    """Draw the legend of a column at ``place`` (x, y, width): a labelled colour scale, or a text."""
    from PIL import Image

    x, y, width = place
    font = _font(_LABEL_PX)
    if name not in scales.ends:
        texts = {"diffuse_albedo": "sRGB", "specular_albedo": "F0, sRGB", "normal_world": "x y z as R G B"}
        draw.text((x, y), texts.get(name, "exposed by view, sRGB"), _FAINT, font)
        return
    ramp = _colored(np.tile(np.linspace(0, 1, width), (_LABEL_PX, 1)))
    sheet.paste(Image.fromarray(quantized_bytes(ramp)), (x, y))
    high = scales.ends[name][1]
    draw.text((x, y + _LABEL_PX + 3), "0", _FAINT, font)
    draw.text((x + width - _label_width(high), y + _LABEL_PX + 3), high, _FAINT, font)


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _label_width(text: str) -> int:
    return int(np.ceil(_font(_LABEL_PX).getlength(text)))


def shard_sheet(shard: Path, max_rows: int = MAX_ROWS) -> Image.Image:
    """Draw up to ``max_rows`` views of a shard. Raises :class:`InputError` if damaged or without views."""
    reader = ShardReader(shard)
    records = list(reader.records())
    chosen = [records[index] for index in choose_rows(len(records), max_rows)]
    wanted = {record.name for record in chosen}
    buffers = {}
    for member, data in reader.members():
        stem, _, suffix = member.rpartition(".")
        view = stem.rpartition("/")[2]
        if suffix == "exr" and view in wanted:
            buffers[view] = decode_view(data)
    missing = [Problem(f"{shard}:{name}.exr", "", "missing", "a view") for name in wanted - buffers.keys()]
    raise_problems(missing)
    split = chosen[0].split if chosen else ""
    identity = chosen[0].configuration if chosen else shard.stem
    title = f"{identity}   {len(records)} views, {len(chosen)} shown   {split}"
    return make_contact_sheet([buffers[r.name] for r in chosen], [r.name for r in chosen], title)


def write_dataset_sheets(folder: Path, progress: Advance = no_advance) -> list[Path]:
    """Write the missing and outdated ``sheets/<configuration>.png`` of finished configurations.

    ``progress(done, total)`` counts configurations. Returns the paths of the new sheets. Raises
    :class:`InputError` if the folder has neither index nor plan.
    """
    sheets = folder / "sheets"
    written = []
    finished = _finished_shards(folder)
    for number, (identity, shard) in enumerate(finished, start=1):
        path = sheets / f"{identity}.png"
        if path.is_file() and path.stat().st_mtime >= shard.stat().st_mtime:
            continue
        progress(number - 1, len(finished))
        stream = io.BytesIO()
        shard_sheet(shard).save(stream, format="PNG", optimize=True)
        write_bytes_atomically(path, stream.getvalue(), parents=True)
        written.append(path)
        progress(number, len(finished))
    return written


def _finished_shards(folder: Path) -> list[tuple[str, Path]]:
    """Configuration and shard of each finished unit, from the plan if there is one, else from the index."""
    if not (folder / "plan.json").is_file():
        if not (folder / INDEX_FILE).is_file():
            remedy = "name a dataset folder, or run `datagen run` first"
            raise InputError(Problem(folder, "", "neither plan.json nor index.json", "a dataset", remedy))
        return [(shard.configuration, folder / shard.file) for shard in Dataset(folder).index.shards]
    dataset = DatasetFolder(folder)
    return [
        (unit.id, folder / manifest.shard)
        for unit in dataset.read_plan().units
        if (manifest := dataset.finished(unit)) is not None
    ]
