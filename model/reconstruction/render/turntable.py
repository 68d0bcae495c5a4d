# SPDX-License-Identifier: MIT
"""Renders an animation of an asset from cameras on a path through it, as a GIF or a video.

The path ``orbit`` is an ellipse about the middle of the asset's cameras, at their mean height; cameras on it
look across the room if most of the asset's cameras do, else outwards. The path ``cameras`` passes through the
asset's cameras in order and returns. Both paths are closed, so the animation can loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import photographic_exposure
from datagen.foundation.durable import publish
from datagen.foundation.errors import input_error
from datagen.foundation.images import shown_bytes
from datagen.foundation.progress import Progress
from model.reconstruction.render.options import FILM_SUFFIXES, FilmOptions
from model.reconstruction.render.relight import RelightOptions, environment_of, lit_images

MIN_RADIUS_M = 0.15  # minimum radius of the orbit, for captures from one position
_GIF_COLORS = 255


@dataclass(frozen=True)
class TurntableOptions(FilmOptions):
    """Options of an animation along a path; ``render.views`` and ``render.cameras`` are ignored."""

    render: RelightOptions = field(default_factory=RelightOptions)


def write_turntable(
    path: Path,
    out: Path,
    options: TurntableOptions | None = None,
    progress: Progress | None = None,
    warn: Callable[[str], None] = lambda text: None,
) -> list[Camera]:
    """Render an environment package along a path to the file ``out`` (.gif or .mp4); return the cameras.

    MP4 files contain VP9, which browsers and common players support. All frames have the exposure of the
    first one. Raises :class:`InputError` for other suffixes, invalid packages and missing lights.
    """
    options = options or TurntableOptions()
    if out.suffix.lower() not in FILM_SUFFIXES:
        raise input_error(out, "", out.suffix or "no suffix", "a file .gif or .mp4", "rename it")
    made = way_cameras([c.camera() for c in environment_of(path).cameras], options)
    frames: list[NDArray[np.uint8]] = []
    exposure = 0.0
    for image in lit_images(path, replace(options.render, views=(), cameras=tuple(made)), warn):
        exposure = exposure or options.render.compensation * photographic_exposure(image.color)
        frames.append(shown_bytes(image.color, exposure))
        if progress is not None:
            progress("render", len(frames), len(made))
    out.parent.mkdir(parents=True, exist_ok=True)
    # absolute, since FFmpeg takes "a:" of "a:b.mp4" for a protocol
    partial = out.absolute().with_name(f".partial-{out.name}")
    try:
        write = _write_gif if out.suffix.lower() == ".gif" else _write_video
        write(partial, frames, options.frames_per_second)
        publish(partial, out)
    finally:
        partial.unlink(missing_ok=True)
    return made


def way_cameras(cameras: Sequence[Camera], options: TurntableOptions) -> list[Camera]:
    """Make the cameras of the frames on the path ``options.way``, with the median field of view of
    ``cameras``.

    Width and height are even, as video requires; the aspect ratio is about that of the first camera.
    """
    lens = cameras[0]
    scale = min(1.0, options.max_width_px / max(lens.width_px, lens.height_px))
    most = options.max_width_px // 2 * 2
    width, height = (
        min(max(16, 2 * round(0.5 * scale * side)), most) for side in (lens.width_px, lens.height_px)
    )
    focal = float(np.median([c.fx_px / c.width_px for c in cameras])) * width
    poses = _orbit(cameras, options.frames) if options.way == "orbit" else _through(cameras, options.frames)
    return [Camera(width, height, focal, focal, width / 2, height / 2, pose) for pose in poses]


def _orbit(cameras: Sequence[Camera], num: int) -> list[NDArray[np.float64]]:
    eyes = np.array([camera.position_m for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    center = 0.5 * (eyes.min(axis=0) + eyes.max(axis=0))
    center[2] = eyes[:, 2].mean()
    # an ellipse of the cameras' spread avoids the corners of their bounding box, which may be empty
    radii = np.maximum(np.sqrt(2) * eyes[:, :2].std(axis=0), MIN_RADIUS_M)
    is_across = float(((center - eyes)[:, :2] * forward[:, :2]).sum()) >= 0
    slope = float(np.mean(forward[:, 2] / np.maximum(np.linalg.norm(forward[:, :2], axis=1), 0.2)))
    poses = []
    for k in range(num):
        angle = 2 * np.pi * k / num
        outward = np.array([np.cos(angle), np.sin(angle)])
        eye = center.copy()
        eye[:2] += radii * outward
        ahead = np.append(-outward if is_across else outward, np.clip(slope, -1.0, 0.5))
        poses.append(look_at(eye, eye + ahead))
    return poses


def _through(cameras: Sequence[Camera], num: int) -> list[NDArray[np.float64]]:
    """Compute poses on a closed spline through the cameras' poses, at equal steps of the spline parameter."""
    from scipy.interpolate import CubicSpline

    keys = np.array([np.concatenate([c.position_m, c.forward]) for c in cameras])
    closed = np.concatenate([keys, keys[:1]])
    at = np.linspace(0, len(keys), num, endpoint=False)
    spline = CubicSpline(np.arange(len(closed)), closed, bc_type="periodic") if len(keys) > 2 else None
    poses = []
    for t in at:
        before = int(t) % len(keys)
        share = t - int(t)
        straight = (1 - share) * closed[before] + share * closed[before + 1]
        found = straight if spline is None else spline(t)
        forward = found[3:] if np.linalg.norm(found[3:]) > 1e-3 else keys[before, 3:]
        poses.append(look_at(found[:3], found[:3] + forward))
    return poses


def _write_gif(path: Path, frames: Sequence[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write a GIF with one palette for all frames, since separate palettes would make colours flicker."""
    from PIL import Image

    step = max(1, len(frames) // 16)
    sample = np.concatenate([frame[::2, ::2] for frame in frames[::step]])
    palette = Image.fromarray(sample).quantize(_GIF_COLORS, method=Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(frame).quantize(palette=palette) for frame in frames]
    # GIF delays are in hundredths of a second
    duration_ms = max(20, round(1000 / frames_per_second / 10) * 10)
    images[0].save(path, "GIF", save_all=True, append_images=images[1:], duration=duration_ms, loop=0)


def _write_video(path: Path, frames: Sequence[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write VP9 in MP4, since OpenCV's wheels cannot encode H.264."""
    import cv2

    height, width = frames[0].shape[:2]
    code = cv2.VideoWriter_fourcc(*"vp09")  # type: ignore[attr-defined]
    writer = cv2.VideoWriter(str(path), code, frames_per_second, (width, height))
    if not writer.isOpened():
        remedy = "write a .gif, or install an OpenCV whose FFmpeg has VP9"
        raise input_error(path, "", "this OpenCV cannot encode VP9", "an encoder for VP9", remedy)
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    written = int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT))
    if written != len(frames):  # OpenCV does not report a full disk
        raise OSError(f"{path}: {written} of {len(frames)} frames were written; is the disk full?")
