# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders contact sheets of all assets, one per kind of asset, for docs/library.md."""

from __future__ import annotations

import tempfile
from pathlib import Path

from scenes.sources.build import sources
from scenes.sources.preview import render_preview

_COLUMNS = {"environment": 2, "object": 8, "material": 10}
_WIDTH = {"environment": 560, "object": 200, "material": 150}
_SAMPLES = {"environment": 24, "object": 8, "material": 8}
_VIEWS = {
    "bathroom": (0.6, -1.15, 1.6, -0.4, 0.9, 0.9),
    "dining_room": (-2.1, -1.5, 1.65, 0.9, 0.9, 0.9),
    "kitchen": (1.6, -1.5, 1.6, -0.8, 0.9, 0.8),
    "living_room": (2.3, 1.3, 1.6, -1.2, -0.9, 0.7),
    "study": (1.2, -1.4, 1.6, -0.9, 0.8, 0.9),
}
_CAPTION = 14


def write_gallery(out: Path, kinds: tuple[str, ...]) -> list[Path]:
    """Render a contact sheet ``out``/``<kind>s.jpg`` of each kind's assets with Cycles; return the paths."""
    from PIL import Image, ImageDraw

    from blender_addon.command import quiet_stdout

    out.mkdir(parents=True, exist_ok=True)
    written = []
    for kind in kinds:
        names = [name for name, of in sources().items() if of == kind]
        width, columns = _WIDTH[kind], _COLUMNS[kind]
        height = width * 3 // 5
        rows = -(-len(names) // columns)
        sheet = Image.new("RGB", (columns * width, rows * (height + _CAPTION)), (24, 24, 24))
        draw = ImageDraw.Draw(sheet)
        with tempfile.TemporaryDirectory() as folder:
            for index, name in enumerate(names):
                picture = Path(folder) / f"{name}.png"
                with quiet_stdout():
                    render_preview(name, picture, _SAMPLES[kind], width, _VIEWS.get(name))
                x, y = index % columns * width, index // columns * (height + _CAPTION)
                sheet.paste(Image.open(picture).convert("RGB"), (x, y))
                draw.text((x + 3, y + height + 1), name, fill=(220, 220, 220))
        path = out / f"{kind}s.jpg"
        sheet.save(path, quality=82, optimize=True)
        written.append(path)
    return written
