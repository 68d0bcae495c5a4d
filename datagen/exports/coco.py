# SPDX-License-Identifier: MIT
"""Writes boxes and masks in COCO's layout: ``images/<split>/*.png``, ``annotations/instances_<split>.json``.

Masks are in COCO's compressed run-length encoding: the lengths of runs in column-major order, starting with
background. From the fourth run on, each length is replaced by its difference from the length two runs before.
The numbers are written in groups of five bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.exports.rooms import Export, Room, RoomView, pixel_box
from datagen.formats.asset import ObjectAsset


class CocoFiles:
    """Writer of a dataset in COCO's layout; :meth:`finish` writes the annotations of all rooms."""

    def __init__(self, export: Export):
        self.export = export
        self.images: dict[str, list[dict[str, Any]]] = {}
        self.annotations: dict[str, list[dict[str, Any]]] = {}
        names = {self.category(p.asset) for room in export.rooms for p in room.objects().values()}
        self.ids = {name: number for number, name in enumerate(sorted(names), start=1)}

    def category(self, asset_id: str) -> str:
        """Return the category of an asset if it is an object of the library, else its id."""
        library = self.export.library
        if library is not None and asset_id in library:
            asset = library.package(asset_id).asset
            if isinstance(asset, ObjectAsset):
                return asset.category
        return asset_id

    def add(self, room: Room) -> None:
        """Write the images of a room's views, and collect their annotations."""
        images = self.images.setdefault(room.split, [])
        annotations = self.annotations.setdefault(room.split, [])
        for view in room.views:
            file = f"{room.configuration.id}_{view.record.name}.png"
            buffers = view.read("beauty", "instance_id")
            self.export.write_picture(f"images/{room.split}/{file}", buffers["beauty"], view.record.exposure)
            camera = view.camera
            image_id = len(images) + 1
            images.append(
                {"id": image_id, "file_name": file, "width": camera.width_px, "height": camera.height_px}
            )
            for entry in self.annotations_of(room, view, buffers["instance_id"][..., 0]):
                annotations.append({"id": len(annotations) + 1, "image_id": image_id, **entry})

    def annotations_of(self, room: Room, view: RoomView, ids: NDArray) -> list[dict[str, Any]]:
        """Return annotations of the objects whose instance ids occur in ``ids`` (H, W), ordered by id."""
        objects, found = room.objects(), []
        for number in np.unique(ids[ids > 0]):
            name = view.record.instances[str(number)]
            if name not in objects:
                continue  # a part of the environment
            mask = ids == number
            asset = objects[name].asset
            found.append(
                {
                    "category_id": self.ids[self.category(asset)],
                    "bbox": pixel_box(mask),
                    "area": int(mask.sum()),
                    "segmentation": run_lengths(mask),
                    "iscrowd": 0,
                    "instance": name,
                    "asset": asset,
                }
            )
        return found

    def finish(self) -> None:
        """Write an annotation file for each split."""
        categories = [{"id": k, "name": name, "supercategory": "object"} for name, k in self.ids.items()]
        for split, images in self.images.items():
            content = {"images": images, "annotations": self.annotations[split], "categories": categories}
            self.export.write_json(f"annotations/instances_{split}.json", content)


def run_lengths(mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Encode a mask (H, W) as COCO's compressed run lengths."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff(np.concatenate([[0], changes, [flat.size]])).tolist()
    if flat[0]:
        counts.insert(0, 0)
    text = []
    for index, count in enumerate(counts):
        rest = count - counts[index - 2] if index > 2 else count
        more = True
        while more:
            group, rest = rest & 0x1F, rest >> 5
            more = rest != -1 if group & 0x10 else rest != 0
            text.append(chr(48 + (group | 0x20 if more else group)))
    return {"size": list(mask.shape), "counts": "".join(text)}
