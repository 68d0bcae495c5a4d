# SPDX-License-Identifier: GPL-3.0-or-later
"""Material slots that rooms share, with the material classes that may replace their materials."""

from __future__ import annotations

from functools import partial

from scenes.sources.materials import art
from scenes.sources.materials.graph import srgb
from scenes.sources.modelling import Slot

BOOKS = ("book_red", "book_blue", "book_green", "book_cream", "book_black", "book_ochre")


def shell(
    *, floor: str = "oak_planks", walls: str = "", wall_color: str = "d9d5ca", trim: str = "e6e4de"
) -> dict[str, Slot]:
    """Slots of floor, walls, ceiling and joinery."""
    return {
        "floor": Slot(("wood",), ("wood", "stone", "glazed", "rubber"), floor),
        "walls": Slot(("painted",), ("painted", "plaster", "paper"), walls, srgb(wall_color), 0.82),
        "ceiling": Slot(("painted",), ("painted", "plaster"), color=srgb("e9e8e4"), roughness=0.85),
        "trim": Slot(("painted",), ("painted", "wood"), color=srgb(trim), roughness=0.35),
        "door": Slot(("painted",), ("painted", "wood"), color=srgb(trim), roughness=0.32),
        "sill": Slot(("painted",), ("painted", "wood", "stone"), color=srgb("e3e1da"), roughness=0.3),
        "hardware": Slot(("metal",), ("metal",), color=(0.56, 0.55, 0.52), roughness=0.28, metallic=1.0),
        "radiator": Slot(("painted",), ("painted", "metal"), color=srgb("e4e3de"), roughness=0.3),
        "lawn": Slot(("organic",), (), color=srgb("5d6a3c"), roughness=0.95, ior=1.4),
        "hedge": Slot(("organic",), (), color=srgb("3d4f2a"), roughness=0.9, ior=1.4),
        "lamp_shade": Slot(
            ("fabric",), ("fabric", "paper", "painted", "metal"), color=srgb("dcd3c0"), roughness=0.8
        ),
    }


def books() -> dict[str, Slot]:
    """Slots of books: covers and pages."""
    tones = ("7a2a24", "2c4562", "3d5a43", "c8bda2", "26262a", "b5863c")
    slots = {
        name: Slot(("paper",), ("paper", "leather", "fabric"), color=srgb(tone), roughness=0.5)
        for name, tone in zip(BOOKS, tones, strict=True)
    }
    slots["pages"] = Slot(("paper",), (), color=srgb("d6cdb6"), roughness=0.92)
    return slots


def pictures() -> dict[str, Slot]:
    """Slots of pictures: frames, mounts and three artworks."""
    hills = (srgb("7f93a0"), srgb("5d7a6a"), srgb("3f5a3e"), srgb("2b3a2a"))
    return {
        "picture_frames": Slot(("wood",), ("wood", "painted", "metal"), color=srgb("2d241d"), roughness=0.35),
        "mounts": Slot(("paper",), (), color=srgb("e3dfd3"), roughness=0.9),
        "art_landscape": Slot(
            ("paper",),
            (),
            graph=partial(art.landscape, sky=(srgb("8fb0c8"), srgb("e8d4b4")), hills=hills, seed=3.0),
        ),
        "art_dusk": Slot(
            ("paper",),
            (),
            graph=partial(
                art.landscape,
                sky=(srgb("3a4668"), srgb("d88a5c")),
                hills=tuple(srgb(h) for h in ("6a4a58", "4a3448", "2c2434")),
                seed=8.0,
            ),
        ),
        "art_blocks": Slot(
            ("paper",),
            (),
            graph=partial(
                art.blocks,
                ground=srgb("e2dac8"),
                colors=tuple(srgb(h) for h in ("b5482f", "24435c", "d0a040", "4d6a58")),
                seed=4.0,
            ),
        ),
    }


def greenery() -> dict[str, Slot]:
    """Slots of a plant and its pot."""
    return {
        "pot": Slot(
            ("ceramic",), ("ceramic", "glazed", "painted", "metal"), color=srgb("b0735a"), roughness=0.75
        ),
        "leaves": Slot(("organic",), (), color=srgb("3f6a2c"), roughness=0.45),
        "stems": Slot(("organic",), (), color=srgb("54603a"), roughness=0.6),
        "soil": Slot(("organic",), (), "soil"),
    }
