# SPDX-License-Identifier: MIT
"""Writes ``preview.html``, which shows the progress of ``datagen run --preview``.

The page opens from disk and shows the latest views, the rate, the time left and failures. It reloads every
few seconds until the run has ended.
"""

from __future__ import annotations

import html
import time
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from datagen.formats.base import read_json, write_bytes_atomically
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view
from datagen.foundation.images import data_url, encode_jpeg, shown_bytes
from datagen.foundation.progress import duration

PREVIEW_FILE = "preview.html"
_SECONDS, _SHOWN, _WIDTH_PX = 3.0, 24, 480


class Preview:
    """Preview page of a run with ``total`` views, of which earlier runs finished ``before``."""

    def __init__(self, root: Path, total: int, before: int = 0):
        self.root, self.total, self.before = root, total, before
        self.start = time.monotonic()
        self.path = root / PREVIEW_FILE
        self.said: list[str] = []
        self._pictures: dict[str, str] = {}  # data URIs, oldest first; kept since packing removes the files
        self._known = set(self._views())
        self._next = 0.0

    def say(self, sentence: str) -> None:
        """Add a message about a failure."""
        self.said.append(sentence)

    def update(self, done: int, is_over: bool = False) -> None:
        """Rewrite the page for ``done`` finished views if it is at least 3 s old or the run is over."""
        now = time.monotonic()
        if now < self._next and not is_over:
            return
        self._update_pictures()
        write_bytes_atomically(self.path, self._page(done, now - self.start, is_over).encode())
        self._next = time.monotonic() + _SECONDS

    def _views(self) -> list[Path]:
        """Paths of the view records of units in progress."""
        found: list[Path] = []
        for folder in (self.root / "work").glob("*/rendered"):
            with suppress(FileNotFoundError):  # the unit has been packed
                found += folder.glob("*.json")
        return found

    def _update_pictures(self) -> None:
        """Encode pictures of the newest views since the last call, and drop the oldest pictures."""
        found = []
        for path in self._views():
            if path not in self._known:
                try:
                    found.append((path.stat().st_mtime, path))
                except FileNotFoundError:
                    self._known.add(path)  # the unit has been packed
        for _, path in sorted(found)[-_SHOWN:]:
            try:
                record = read_json(ViewRecord, path)
                beauty = decode_view(path.with_suffix(".exr"), ["beauty"], num_threads=1)["beauty"]
            except InputError:  # the unit has been packed, or the view is damaged and is rendered again
                continue
            self._pictures[f"{record.configuration} / {record.name}"] = _picture(beauty, record.exposure)
        self._known |= {path for _, path in found}
        while len(self._pictures) > _SHOWN:
            del self._pictures[next(iter(self._pictures))]

    def _page(self, done: int, seconds: float, is_over: bool) -> str:
        made = done - self.before
        rate = made / seconds * 3600 if made > 0 and seconds > 0 else 0.0
        left = f"{duration((self.total - done) / rate * 3600)} left" if rate and not is_over else ""
        facts = [f"{done} of {self.total} views", f"{rate:,.0f} per hour" if rate else "", left]
        facts += ["the run has ended" if is_over else f"as of {time.strftime('%H:%M:%S')}"]
        state = "".join(f'<p class="bad">{html.escape(line)}</p>' for line in self.said[-20:])
        cards = "".join(
            f'<li><img alt="{html.escape(name)}" src="{uri}"><small>{html.escape(name)}</small></li>'
            for name, uri in reversed(self._pictures.items())
        )
        title = html.escape(self.root.resolve().name)
        again = "" if is_over else '<meta http-equiv="refresh" content="5">'
        template = (files("datagen.inspection.report") / "page" / "preview.html").read_text(encoding="utf-8")
        counts = {"total": self.total, "done": done, "facts": ", ".join(fact for fact in facts if fact)}
        return Template(template).substitute(counts, title=title, again=again, state=state, cards=cards)


def _picture(beauty: np.ndarray, exposure: float) -> str:
    """Encode radiance (H, W, 3) times ``exposure`` as a JPEG in a data URI."""
    from PIL import Image

    picture = Image.fromarray(shown_bytes(beauty, exposure))
    picture.thumbnail((_WIDTH_PX, _WIDTH_PX))
    return data_url(encode_jpeg(np.asarray(picture), 85), "jpeg")
