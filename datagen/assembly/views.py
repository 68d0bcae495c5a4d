# SPDX-License-Identifier: MIT
"""Places cameras as a person would to photograph a room.

Candidates are drawn in free space, aimed at objects or across the room, and ray-traced at low resolution.
Those that are too close, show too little, are too dark or overlap too little with other views are rejected
and counted. Views are then chosen greedily among the candidates that overlap enough with those chosen so
far: the most different in pose or, if the recipe's ``subject`` is ``room``, the one with the most overlap.
Shapes: C candidates, H x W pixels of the low-resolution image, P points.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.coverage import Shell, preview_of, visible_mask
from datagen.assembly.free_space import FreeSpace
from datagen.assembly.geometry import Floats, RayScene, WorldScene, direction_of
from datagen.assembly.light_levels import Lighting
from datagen.assembly.light_probe import Rectangle
from datagen.assembly.placement import Shortfall
from datagen.formats.base import quantized
from datagen.formats.recipe import CameraRecipe
from datagen.foundation.axes import rotation
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import Problem
from datagen.foundation.random import Draws

MAX_NEAR_PIXELS = 0.02  # largest share of the image nearer than min_distance_m
MAX_OPEN_PIXELS = 0.4  # largest share of the image that shows no surface or an emitter
MIN_CONTENT_PIXELS = 0.04  # minimum share of the image covered by objects and furniture
# largest share of surface pixels on the three largest planes; rejects views of bare corners and cupboards
MAX_THREE_PLANES_PIXELS = 0.92
MAX_PLANE_PIXELS = 0.72  # largest share of the image covered by a single plane, such as a bare wall
_MIN_INSTANCE_PIXELS = 0.0015  # smallest share of the image for an instance to count as visible
_BATCH = 16
_LUMINANCE_GRID = (18, 10)
_LUMINANCE_SAMPLES = 4
_MAX_PITCH_RAD = math.radians(38.0)
_ROLL_RAD = math.radians(1.2)  # handheld cameras are not exactly level
_SHELL_SPAN = 0.7  # a part that spans this share of the room in x or y counts as wall, floor or ceiling
_OVERLAP_POINTS = 400
_NUM_COMPARED = 12  # number of random eligible candidates, of which the most different one is chosen
_MIN_NOVELTY = 0.04  # minimum difference (:func:`_difference_matrix`) between two chosen views
_NUM_HEADINGS = 24
_FARTHEST_M = 8.0
_WINDOW_DEPTH_M = 1.0  # depth assumed at windows; small, so that views of only a window are rare
_DEPTH_POWER = 3  # a heading is drawn with a probability proportional to its mean depth to this power
_ROOM_PITCH_RAD, _ROOM_PITCH_SPREAD_RAD = math.radians(-7.0), math.radians(5.0)
# overlap above this value does not raise the score of a view, which favours different views
_ENOUGH_OVERLAP = 0.42
_NOVELTY_WORTH, _ENOUGH_NOVELTY = 0.5, 0.6  # weight and cap of a view's difference in its score
_ROOM_SHARE = 0.75  # share of the chosen views that show the room itself, if there are enough


@dataclass
class Candidate:
    """A camera that passed the single-view checks; ``preview`` is the same camera at low resolution.

    ``distance_m`` (H, W) is along the ray, inf for misses; ``points`` (P, 3) are on visible surfaces;
    ``luminance`` is the view's mean in W/(m² sr). ``is_room`` is true if the view shows two walls, or a wall
    and the ceiling.
    """

    camera: Camera
    preview: Camera
    distance_m: Floats
    points: Floats
    luminance: float = 0.0
    is_room: bool = False


@dataclass(frozen=True)
class Subject:
    """Targets of cameras in a scene.

    ``object_centers`` (K, 3) are the centres of the objects' bounding boxes, ``furniture_faces`` the triangle
    indices of each piece of furniture; ``content_mask`` is true for instances that are objects or furniture.
    """

    scene: WorldScene
    object_centers: Floats
    furniture_faces: list[NDArray[np.int64]]
    content_mask: NDArray[np.bool_]

    @classmethod
    def of(cls, scene: WorldScene) -> Subject:
        """Find the objects and furniture of a scene: all but the parts that span most of the room."""
        order = np.argsort(scene.instance_of_face, kind="stable")
        instances, starts = np.unique(scene.instance_of_face[order], return_index=True)
        corners = scene.rays.corners[order]
        lows = np.minimum.reduceat(corners.min(axis=1), starts, axis=0)
        highs = np.maximum.reduceat(corners.max(axis=1), starts, axis=0)
        in_room = instances < scene.num_environment_parts
        size = np.maximum(highs[in_room].max(axis=0) - lows[in_room].min(axis=0), 1e-6)
        is_shell = in_room & (((highs - lows) / size)[:, :2].max(axis=1) >= _SHELL_SPAN)
        is_thing = np.zeros(scene.num_instances, dtype=bool)
        is_thing[instances] = ~is_shell
        centers = 0.5 * (lows + highs)[~in_room]
        faces = np.split(order, starts[1:])
        furniture = [faces[k] for k in np.flatnonzero(in_room & ~is_shell).tolist()]
        return cls(scene, centers, furniture, is_thing)

    def draw(self, draws: Draws) -> Floats:
        """Draw a target (3,): the centre of an object or furniture triangle; without any, of a triangle."""
        pick, u = draws.unit(), draws.units(3)
        if len(self.object_centers) and (pick < 0.65 or not self.furniture_faces):
            return self.object_centers[int(u[0] * len(self.object_centers))]
        faces = np.arange(len(self.scene.rays.faces))
        if self.furniture_faces:
            faces = self.furniture_faces[int(u[0] * len(self.furniture_faces))]
        area = np.cumsum(self.scene.rays.areas[faces])
        chosen = min(int(np.searchsorted(area, u[1] * area[-1], side="right")), len(faces) - 1)
        return self.scene.rays.corners[faces[chosen]].mean(axis=0)


@dataclass
class ViewFinder:
    """Finds the cameras of a configuration; ``key`` seeds draws, ``rejections`` counts rejects by reason."""

    scene: WorldScene
    shell: Shell
    space: FreeSpace
    lighting: Lighting
    recipe: CameraRecipe
    resolution: tuple[int, int]
    key: tuple[int | str, ...]
    rejections: Counter[str]
    num_drawn: int = field(default=0, init=False)

    def find(self, count: int) -> list[Camera]:
        """Find ``count`` cameras. Raises :class:`Shortfall`, with rejection counts, if it finds fewer."""
        self.space.check()
        subject = Subject.of(self.scene)
        limit = count * self.recipe.max_attempts
        pool: list[Candidate] = []
        overlap = np.zeros((0, 0))
        wanted = count + max(8, count // 2)
        if self.recipe.subject == "room":
            wanted = 2 * count + 8  # candidates to choose from
        while True:
            pool += self._extend(subject, wanted, limit)
            overlap = overlap_matrix(pool, self.scene.rays, overlap)
            lit = self._bright_enough(pool)
            among = overlap[np.ix_(lit, lit)]
            least = self.recipe.min_overlap
            bright = [pool[k] for k in lit]
            draws = Draws(*self.key, "choose")
            if self.recipe.subject == "room":
                chosen, num_lonely = choose_overlapping(bright, among, count, least)
            else:
                chosen, num_lonely = choose_views(bright, among, count, least, draws)
            if len(chosen) == count or self.num_drawn >= limit:
                self.rejections["camera.too_dark"] += len(pool) - len(lit)
            if len(chosen) == count:
                return [bright[k].camera for k in chosen]
            if self.num_drawn >= limit:
                self.rejections["camera.too_little_overlap"] += num_lonely
                self.rejections["camera.too_similar"] += len(lit) - len(chosen) - num_lonely
                self._raise_shortfall(len(chosen), count)
            wanted = max(8, 2 * (count - len(chosen)))

    def _raise_shortfall(self, found: int, count: int) -> None:
        reasons = {k: v for k, v in sorted(self.rejections.items()) if k.startswith("camera.") and v}
        worst = max(reasons, key=lambda k: (reasons[k], k), default="")
        advice = {
            "camera.inside_solid": "move the room's camera_regions out of solid geometry",
            "camera.outside": "move the room's camera_regions into the room",
            "camera.no_floor": "add camera_regions to the room: there is no floor below its cameras",
            "camera.too_close": "lower cameras.min_distance_m or enlarge the camera region",
            "camera.too_near": "lower cameras.min_distance_m, raise max_near_share or place fewer objects",
            "camera.faces_outside": "keep the camera region away from open sides",
            "camera.faces_light": "keep the camera region away from large luminous surfaces",
            "camera.too_little_content": "lower cameras.min_content, widen fov_x_deg or place more objects",
            "camera.too_plain": "place more objects or keep the camera region away from bare walls",
            "camera.too_dark": "lower cameras.min_luminance or add lights",
            "camera.too_little_overlap": "lower cameras.min_overlap or widen cameras.fov_x_deg",
            "camera.too_similar": "lower views or enlarge the camera region",
        }.get(worst, "raise cameras.max_attempts")
        listed = ", ".join(f"{k.removeprefix('camera.')} {v}" for k, v in reasons.items())
        problem = Problem(
            f"environment {self.space.environment.id}",
            "views",
            f"{found} of {self.num_drawn} candidates ({listed})",
            f"{count} cameras",
            f"{advice}; or raise cameras.max_attempts (now {self.recipe.max_attempts})",
        )
        raise Shortfall(problem)

    def _extend(self, subject: Subject, wanted: int, limit: int) -> list[Candidate]:
        """Draw candidates in batches until ``wanted`` pass the checks or ``limit`` have been drawn."""
        fresh: list[Candidate] = []
        while len(fresh) < wanted and self.num_drawn < limit:
            size = min(_BATCH, limit - self.num_drawn)
            for number in range(self.num_drawn, self.num_drawn + size):
                outcome = self._draw_candidate(subject, Draws(*self.key, "camera", number))
                if isinstance(outcome, Candidate):
                    fresh.append(outcome)
                else:
                    self.rejections[f"camera.{outcome}"] += 1
            self.num_drawn += size
        self._measure(fresh)
        return fresh

    def _draw_candidate(self, subject: Subject, draws: Draws) -> Candidate | str:
        """Draw one candidate; return it or the reason for its rejection."""
        position = self.space.draw(draws)
        if position is None:
            return "no_floor"
        position = np.round(position, 6)
        fault = self.space.fault(position, 0.5 * self.recipe.min_distance_m)
        if fault:
            return fault
        if self.recipe.subject == "room":
            camera = self._aim_across(position, draws)
        else:
            camera = self._aim(position, subject.draw(draws), draws)
        preview = preview_of(camera)
        directions = preview.ray_directions().reshape(-1, 3)
        hits = self.scene.rays.cast(position, directions)
        near = self.recipe.min_distance_m
        if (hits.distance_m < near).mean() > MAX_NEAR_PIXELS:
            return "too_close"
        if (hits.distance_m < 2 * near).mean() > self.recipe.max_near_share:
            return "too_near"
        if (~hits.hit_mask).mean() > MAX_OPEN_PIXELS:
            return "faces_outside"
        luminous = self.lighting.shows_light(position, directions, hits)
        if (luminous | ~hits.hit_mask).mean() > MAX_OPEN_PIXELS:
            return "faces_light"
        if not self._shows_enough(hits.face[hits.hit_mask], len(directions), subject):
            return "too_little_content"
        planes = self._planes(hits.face[hits.hit_mask])
        if planes[:1].sum() > MAX_PLANE_PIXELS * len(directions):
            return "too_plain"
        if planes[:3].sum() > MAX_THREE_PLANES_PIXELS * planes.sum():
            return "too_plain"
        seen = np.flatnonzero(hits.hit_mask)
        seen = seen[:: max(1, len(seen) // _OVERLAP_POINTS)]
        points = position + hits.distance_m[seen, None] * directions[seen]
        shape = (preview.height_px, preview.width_px)
        is_room = self.shell.is_room(hits.face[hits.hit_mask], len(directions))
        return Candidate(camera, preview, hits.distance_m.reshape(shape), points, is_room=is_room)

    def _shows_enough(self, faces: NDArray[np.int64], num_pixels: int, subject: Subject) -> bool:
        """Return whether a view whose rays hit the triangles ``faces`` shows enough objects and furniture."""
        pixels = np.bincount(self.scene.instance_of_face[faces], minlength=self.scene.num_instances)
        num_seen = int((pixels >= max(2.0, _MIN_INSTANCE_PIXELS * num_pixels)).sum())
        if num_seen < self.recipe.min_content:
            return False
        if not subject.content_mask.any():
            return True
        return int(pixels[subject.content_mask].sum()) >= MIN_CONTENT_PIXELS * num_pixels

    def _planes(self, faces: NDArray[np.int64]) -> NDArray[np.int64]:
        """Pixel counts of planes (equal normals and offsets [m], rounded to 0.1), in descending order."""
        normals = self.scene.rays.normals[faces]
        offsets = (normals * self.scene.rays.corners[faces, 0]).sum(axis=1)
        planes = np.round(np.column_stack([normals, offsets]) * 10).astype(np.int64) + 1000
        keys = (planes * [1, 1 << 14, 1 << 28, 1 << 42]).sum(axis=1)
        return np.sort(np.unique(keys, return_counts=True)[1])[::-1]

    def _aim(self, position: Floats, target: Floats, draws: Draws) -> Camera:
        """Return a camera at ``position`` with the target near the middle of its image."""
        width, height = self.resolution
        fov = math.radians(draws.uniform(*self.recipe.fov_x_deg))
        offset = target - position
        azimuth = math.atan2(offset[1], offset[0]) + draws.uniform(-0.28, 0.28) * fov
        pitch = math.atan2(offset[2], math.hypot(offset[0], offset[1]))
        pitch += draws.uniform(-0.22, 0.22) * fov * height / width
        pitch = min(max(pitch, -_MAX_PITCH_RAD), _MAX_PITCH_RAD)
        return self._hand_held(position, fov, azimuth, pitch, draws)

    def _aim_across(self, position: Floats, draws: Draws) -> Camera:
        """Return a camera pitched slightly down, preferably aimed where the room is deep."""
        fov = math.radians(draws.uniform(*self.recipe.fov_x_deg))
        headings = draws.unit() * 2 * math.pi + np.arange(_NUM_HEADINGS) * 2 * math.pi / _NUM_HEADINGS
        level = np.stack([np.cos(headings), np.sin(headings), np.zeros(_NUM_HEADINGS)], axis=1)
        reach = np.minimum(self.scene.rays.cast(position, level).distance_m, _FARTHEST_M)
        # surfaces behind a window do not count as depth of the room
        for opening in self.space.environment.openings:
            origins = np.broadcast_to(position, level.shape)
            reach[Rectangle.of(opening).is_crossed(origins, level, reach)] = _WINDOW_DEPTH_M
        window = np.cos(np.subtract.outer(headings, headings)) >= math.cos(0.5 * fov)
        depth = (window * reach).sum(axis=1) / window.sum(axis=1)
        azimuth = float(headings[draws.weighted(range(_NUM_HEADINGS), (depth**_DEPTH_POWER).tolist())])
        pitch = _ROOM_PITCH_RAD + min(max(draws.normal(), -2.0), 2.0) * _ROOM_PITCH_SPREAD_RAD
        return self._hand_held(position, fov, azimuth, pitch, draws)

    def _hand_held(self, position: Floats, fov: float, azimuth: float, pitch: float, draws: Draws) -> Camera:
        """Return a camera with these angles [rad] and, as if hand-held, a random roll of up to 3 degrees."""
        width, height = self.resolution
        focal = quantized(0.5 * width / math.tan(0.5 * fov), 9)
        roll = min(max(draws.normal(), -2.5), 2.5) * _ROLL_RAD
        pose = look_at(position, position + direction_of(azimuth, pitch))
        pose[:3, :3] = pose[:3, :3] @ rotation("z", roll)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, np.round(pose, 9))

    def _measure(self, candidates: list[Candidate]) -> None:
        """Set the mean luminance of each candidate."""
        if not candidates:
            return
        columns, rows = _LUMINANCE_GRID
        directions = np.stack([c.camera.scaled(columns, rows).ray_directions() for c in candidates])
        directions = np.repeat(directions.reshape(-1, 3), _LUMINANCE_SAMPLES, axis=0)
        origins = np.repeat(
            [c.camera.position_m for c in candidates], columns * rows * _LUMINANCE_SAMPLES, axis=0
        )
        draws = Draws(*self.key, "luminance", self.num_drawn)
        luminance = self.lighting.luminance(origins, directions, draws).reshape(len(candidates), -1)
        for candidate, value in zip(candidates, luminance.mean(axis=1).tolist(), strict=True):
            candidate.luminance = value

    def _bright_enough(self, pool: list[Candidate]) -> list[int]:
        """Return the indices of candidates with at least ``min_luminance`` times the median luminance."""
        if not pool:
            return []
        luminance = np.array([c.luminance for c in pool])
        least = self.recipe.min_luminance * float(np.median(luminance))
        return np.flatnonzero(luminance >= least).tolist()


def overlap_matrix(pool: list[Candidate], rays: RayScene, known: Floats | None = None) -> Floats:
    """Compute the share (C, C) of the points of view i (row) visible in view j (column); 0 on the diagonal.

    ``known`` (K, K) is the matrix of the first K views, if already computed.
    """
    count = len(pool)
    start = 0 if known is None else len(known)
    overlap = np.zeros((count, count))
    if known is not None:
        overlap[:start, :start] = known
    for j, target in enumerate(pool):
        sources = [i for i in range(count) if i != j and (i >= start or j >= start)]
        if not sources:
            continue
        seen = visible_mask(target.preview, np.concatenate([pool[i].points for i in sources]), rays)
        sizes = [len(pool[i].points) for i in sources]
        for i, end, size in zip(sources, np.cumsum(sizes).tolist(), sizes, strict=True):
            overlap[i, j] = float(seen[end - size : end].mean()) if size else 0.0
    return overlap


def choose_views(
    pool: list[Candidate], overlap: Floats, count: int, min_overlap: float, draws: Draws
) -> tuple[list[int], int]:
    """Choose up to ``count`` views; return their indices and the number of views that overlap too little.

    ``overlap`` is the pool's :func:`overlap_matrix`. At least ``min_overlap`` of the points of every chosen
    view are visible in an earlier chosen view (for the first view: in the second). Nearly identical views are
    skipped. The number returned is 0 if ``count`` views are found.
    """
    if count == 1:
        return ([0] if pool else []), 0
    if len(pool) < 2:
        return [], len(pool)
    novelty = _difference_matrix(pool)
    both = np.minimum(overlap, overlap.T)
    pairs = [k for k in range(len(pool)) if both[k].max() >= min_overlap]
    if not pairs:
        return [], len(pool)
    first = draws.choice(pairs)
    partners = np.flatnonzero(both[first] >= min_overlap).tolist()
    chosen = [first, max(partners, key=lambda k: (novelty[first, k], -k))]
    while len(chosen) < count:
        rest = [k for k in range(len(pool)) if k not in chosen and novelty[k, chosen].min() >= _MIN_NOVELTY]
        eligible = [k for k in rest if overlap[k, chosen].max() >= min_overlap]
        if not eligible:
            lonely = [
                k for k in range(len(pool)) if overlap[k, chosen].max() < min_overlap and k not in chosen
            ]
            return chosen, len(lonely)
        compared = draws.shuffled(eligible)[:_NUM_COMPARED]
        chosen.append(max(compared, key=lambda k: (float(novelty[k, chosen].min()), -k)))
    return chosen, 0


def choose_overlapping(
    pool: list[Candidate], overlap: Floats, count: int, min_overlap: float
) -> tuple[list[int], int]:
    """Choose views as :func:`choose_views` does, but in order of a score that rewards overlap.

    The score of a view is its mean overlap with the chosen views in both directions, up to
    :data:`_ENOUGH_OVERLAP`, plus a bonus for difference. Views that show the room (``is_room``) come first
    while they are fewer than :data:`_ROOM_SHARE` of the chosen views.
    """
    if count == 1 or len(pool) < 2:
        return choose_views(pool, overlap, count, min_overlap, Draws("one"))
    novelty = _difference_matrix(pool)
    both = 0.5 * (overlap + overlap.T)
    is_room = np.array([candidate.is_room for candidate in pool])
    chosen = [int(np.argmax(both.mean(axis=1) + is_room))]
    while len(chosen) < count:
        fresh = novelty[:, chosen].min(axis=1)
        eligible = (fresh >= _MIN_NOVELTY) & (overlap[:, chosen].max(axis=1) >= min_overlap)
        eligible[chosen] = False
        if len(chosen) == 1:
            eligible &= overlap[chosen[0]] >= min_overlap
        if not eligible.any():
            lonely = (overlap[:, chosen].max(axis=1) < min_overlap) & ~np.isin(np.arange(len(pool)), chosen)
            return chosen, int(lonely.sum())
        wants_room = is_room[chosen].sum() < _ROOM_SHARE * (len(chosen) + 1)
        shared = np.minimum(both[:, chosen].mean(axis=1), _ENOUGH_OVERLAP)
        worth = shared + _NOVELTY_WORTH * np.minimum(fresh, _ENOUGH_NOVELTY)
        worth = np.where(eligible, worth + (is_room & wants_room), -1.0)
        chosen.append(int(np.argmax(worth)))
    return chosen, 0


def _difference_matrix(pool: list[Candidate]) -> Floats:
    """Compute the differences (C, C) of views: distance / extent of all positions + angle / π."""
    positions = np.array([c.camera.position_m for c in pool])
    forwards = np.array([c.camera.forward for c in pool])
    extent = max(float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0))), 1e-6)
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2) / extent
    angle = np.arccos(np.clip(forwards @ forwards.T, -1.0, 1.0)) / math.pi
    return apart + angle
