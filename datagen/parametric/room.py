# SPDX-License-Identifier: MIT
"""Generates a furnished room of a kind from a seed: shell, furniture and checks.

A room with faults is generated again from another seed, derived from the given one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from datagen.formats.base import quantized
from datagen.foundation.errors import input_error
from datagen.foundation.random import Draws
from datagen.parametric.checks import Furnished, faults_of
from datagen.parametric.furnish import dress_windows, wire
from datagen.parametric.items import Placed, Style
from datagen.parametric.kinds import KINDS, Kind, furnish
from datagen.parametric.layout import Furnisher, Unfit
from datagen.parametric.shell import CASING_M, WALLS, Door, Shell, Wall, Window, outside, shell_items

MAX_TRIES = 40
_HINGES: tuple[Literal[-1], Literal[1]] = (-1, 1)


@dataclass(frozen=True)
class MadeRoom:
    """A room without faults, made at attempt number ``tries``; ``rejected``: the faults of earlier attempts.

    Without ``has_scenery``, nothing is modelled outside the windows, so that a panorama is visible.
    """

    kind: str
    seed: str
    furnished: Furnished
    scenery: tuple[Placed, ...]
    tries: int
    rejected: tuple[str, ...]
    has_scenery: bool = True


def make_room(kind: str, seed: str, has_scenery: bool = True) -> MadeRoom:
    """Make a furnished room. Raises :class:`InputError` if all :data:`MAX_TRIES` attempts have faults."""
    rejected: list[str] = []
    for attempt in range(MAX_TRIES):
        key = ("parametric room", kind, seed, attempt)
        spec = KINDS[kind]
        shell = draw_shell(spec, Draws(*key, "shell"))
        room = Furnisher(shell, Style.draw(Draws(*key, "style")), Draws(*key, "furniture"))
        built = shell_items(shell, Draws(*key, "built"))
        if shell.has_beams:
            beams = next(p for p in built if p.name == "beams")
            room.zones += [("beams", box) for box in beams.boxes()]
        try:
            dress_windows(room, spec.curtains, spec.blinds, spec.radiators)
            furnish(kind, room)
            wire(room, Draws(*key, "electrics"))
        except Unfit as why:
            rejected.append(str(why))
            continue
        furnished = Furnished(shell, tuple(built), tuple(room.placed))
        if faults := faults_of(furnished):
            rejected.append("; ".join(map(str, faults)))
            continue
        scenery = tuple(outside(shell, Draws(*key, "outside"))) if shell.windows and has_scenery else ()
        return MadeRoom(kind, seed, furnished, scenery, attempt + 1, tuple(rejected), has_scenery)
    raise input_error(
        f"room of kind {kind}",
        "seed",
        f"{seed!r}: {MAX_TRIES} rooms drawn, all with faults (last: {rejected[-1]})",
        "a room without faults",
        "use another seed, or exclude this kind",
    )


def draw_shell(kind: Kind, draws: Draws) -> Shell:
    """Draw a room's size, doors, windows, and tiled and accent walls."""
    width, depth = draws.uniform(*kind.width), draws.uniform(*kind.depth)
    if draws.chance(0.5):
        width, depth = depth, width
    width, depth, height = (quantized(x, 3) for x in (width, depth, draws.uniform(*kind.height)))
    base = Shell(width, depth, height, (), ())
    doors = _doors(kind, base, draws)
    windows = _windows(kind, base, doors, draws)
    tiled = tuple(draws.shuffled(WALLS)[: draws.integer(*kind.tiled)])
    plain = [w for w in WALLS if w not in tiled]
    accent = draws.choice(plain) if plain and draws.chance(0.3) else None
    return Shell(
        width, depth, height, windows, doors, accent, tiled,
        storey_m=draws.choice((0.35, 0.35, 3.2, 6.2)), has_beams=height > 2.55 and draws.chance(kind.beams),
    )  # fmt: skip


def _doors(kind: Kind, shell: Shell, draws: Draws) -> tuple[Door, ...]:
    doors: list[Door] = []
    for wall in draws.shuffled(WALLS)[: draws.integer(*kind.doors)]:
        width = draws.choice((0.76, 0.82, 0.86, 0.92))
        reach = shell.length(wall) / 2 - width / 2 - CASING_M - 0.02
        if draws.chance(0.75):  # most doors are near a corner
            s = reach * draws.choice((-1.0, 1.0)) * (1 - 0.35 * draws.unit() ** 2)
        else:
            s = reach * draws.uniform(-1, 1)
        doors.append(Door(wall, quantized(s, 3), width, draws.choice(_HINGES)))
    return tuple(doors)


def _windows(kind: Kind, shell: Shell, doors: Sequence[Door], draws: Draws) -> tuple[Window, ...]:
    """Draw equal windows, preferably on one wall, clear of doors."""
    count = draws.integer(*kind.windows)
    sill = draws.uniform(*kind.sill)
    top = min(shell.height - draws.uniform(0.18, 0.35), sill + draws.uniform(1.1, 1.7))
    wide = draws.uniform(0.75, 1.75)
    panes = (1 if wide < 0.85 else 2 if wide < 1.5 else 3, draws.choice((1, 1, 2, 3)))
    found: list[Window] = []
    main = draws.choice(WALLS)
    order: list[Wall] = [main, main, *draws.shuffled(WALLS)]
    for wall in order:
        if len(found) == count:
            break
        length = shell.length(wall)
        width = min(wide, length - 0.8)
        if width < 0.55:
            continue
        for _ in range(8):
            reach = length / 2 - width / 2 - 0.3
            s = draws.uniform(-reach, reach)
            openings: list[Door | Window] = [*doors, *found]
            others = [(other.s, other.width) for other in openings if other.wall == wall]
            if all(abs(s - t) > (width + w) / 2 + 2 * CASING_M + 0.12 for t, w in others):
                s, width, low, height = (quantized(x, 3) for x in (s, width, sill, top - sill))
                found.append(Window(wall, s, width, low, height, panes))
                break
    return tuple(found)
