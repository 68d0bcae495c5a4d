# SPDX-License-Identifier: MIT
"""Estimates exposure and white balance of each photograph, vignetting and response from shared surfaces.

A surfel i of radiance L_i is recorded in view v, at the squared image radius r2 (1 in the corners), as

    f(exp(ln L_i + g_v - vignetting r2)),    f(x) = linear(e - c sin(2 pi e)),  e = sRGB(x),

relative to the sensor's limit, where g_v is the view's ln gain by channel and c the deviation of the response
from sRGB; an exponent of the radiance cannot be determined from exposures and is assumed to be 1. Least
squares of logarithms with Cauchy weights and L_i eliminated are robust to highlights and errors of the
geometry. The common gain is undetermined and is chosen for a median gain of 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.geometry.views import TracedView
from datagen.light.surfels import Surfels

MAX_SURFELS, MIN_VIEWS, MIN_SAMPLES = 8_000, 2, 10
"""Maximum number of surfels, minimum number of views of each, and minimum mean number of samples per view."""
DARK, BRIGHT = 0.004, 0.9
"""Range of usable values relative to the clipping limit, which excludes noise and clipping."""
MIN_GAIN, MIN_VIGNETTING = 0.03, 0.05
"""Root mean square of ln gains, and absolute ln of the factor in the image corners, below which gains and
vignetting are ignored, since highlights alone can cause such values."""
MIN_EXPLAINED = 0.02
"""Minimum relative reduction of the cost for which a response curve is accepted."""
MIN_SPREAD = 0.1
"""Minimum standard deviation of ln gains for a response curve, which requires different exposures."""
_ROUNDS = 10
_SCALES = (0.5, 0.06)  # first and last scale of Cauchy's distribution, in ln L
_PRIOR_GAIN, _PRIOR_VIGNETTING, _PRIOR_CURVE = 1.0, 0.5, 0.05
_PRIOR_WEIGHT = 5.0  # weight of a prior at one standard deviation, in observations
_CURVE_WEIGHT = 2e-4  # of the curve's prior, per sample, since samples' errors have common causes
_MAX_CURVE = 0.15  # above 1 / 2 pi the curve is not monotonic
_STEP = 1e-3  # of numerical derivatives


@dataclass(frozen=True)
class Radiometry:
    """Radiometric calibration of V photographs.

    ``gain`` (V, 3): gain of each view by channel; ``vignetting``: -ln of the factor in the image corners;
    ``curve``: deviation c of the response from sRGB (see the module).
    """

    gain: NDArray[np.float64]
    vignetting: float = 0.0
    curve: float = 0.0

    @property
    def changes(self) -> bool:
        """True if the correction changes any photograph."""
        return bool((self.gain != 1).any()) or self.vignetting != 0 or self.curve != 0

    def undone(self, view: TracedView, index: int) -> TracedView:
        """Convert the colours of ``view``, which is number ``index``, to radiance at the common exposure."""
        color = view.color.astype(np.float64)
        if self.curve and view.limit is not None:
            color = view.limit * invert_response(color / view.limit, self.curve)
        fall_off = np.exp(self.vignetting * radius_squared(view))[..., None]
        limit = None if view.limit is None else view.limit / float(self.gain[index].mean())
        return replace(view, color=(color * fall_off / self.gain[index]).astype(np.float32), limit=limit)


def apply_response(value: NDArray, curve: float) -> NDArray[np.float64]:
    """Encode a linear ``value`` with the response, which deviates from sRGB by ``curve``, and decode the
    result as sRGB; ``value`` and result are relative to the clipping limit.
    """
    encoded = np.asarray(srgb_from_linear(np.clip(value, 1e-6, 1)), np.float64)
    return np.asarray(linear_from_srgb(encoded - curve * np.sin(2 * np.pi * encoded)), np.float64)


def invert_response(value: NDArray, curve: float) -> NDArray[np.float64]:
    """Invert :func:`apply_response`."""
    encoded = np.linspace(0, 1, 4096)
    bent = encoded - curve * np.sin(2 * np.pi * encoded)
    of_value = np.asarray(srgb_from_linear(np.clip(value, 0, 1)), np.float64)
    return np.asarray(linear_from_srgb(np.interp(of_value, bent, encoded)), np.float64)


def radius_squared(view: TracedView) -> NDArray[np.float64]:
    """Compute the squared distance (H, W) of pixels from the principal point, 1 in the farthest corner."""
    camera = view.camera
    x = np.arange(camera.width_px) + 0.5 - camera.cx_px
    y = np.arange(camera.height_px) + 0.5 - camera.cy_px
    r2 = x[None] ** 2 + y[:, None] ** 2
    return np.asarray(r2 / r2.max())


def find_radiometry(views: Sequence[TracedView], surfels: Surfels) -> Radiometry:
    """Estimate the radiometric calibration from ``surfels`` that several ``views`` show.

    The response is estimated only if the clipping limits of all photographs are known.
    """
    channels, num_samples = _channels(views, surfels)
    has_limit = all(view.limit is not None for view in views)
    num = len(views)
    if not channels:
        return Radiometry(np.ones((num, 3)))
    gain, vignetting, _, cost = _solved(channels, num_samples, num, has_curve=False)
    curve = 0.0
    if has_limit and gain.std(axis=0).mean() >= MIN_SPREAD:
        bent = _solved(channels, num_samples, num, has_curve=True)
        if bent[3] < (1 - MIN_EXPLAINED) * cost:
            gain, vignetting, curve, _ = bent
    gain -= np.median(gain, axis=0)
    if abs(vignetting) < MIN_VIGNETTING:
        vignetting = 0.0
    if np.sqrt((gain**2).mean()) < MIN_GAIN:
        gain[:] = 0.0
    return Radiometry(np.exp(gain), vignetting, curve)


def _channels(views: Sequence[TracedView], surfels: Surfels) -> tuple[list[_Channel], int]:
    """Choose usable observations of each channel ([] if too few); also return the number of candidates."""
    observations = surfels.observations
    common = float(np.quantile(surfels.radiance, 0.99))
    limit = np.array([common if view.limit is None else view.limit for view in views])
    most = np.array([np.inf if view.limit is None else BRIGHT for view in views])
    num = np.diff(observations.start)
    usable = np.flatnonzero(num >= MIN_VIEWS)
    chosen = np.random.default_rng(0).permutation(usable)[:MAX_SURFELS]
    is_chosen = np.zeros(len(surfels), dtype=bool)
    is_chosen[chosen] = True
    rows = np.flatnonzero(is_chosen[surfels.surfel_of_observation()] & (observations.weight >= 0.5))
    surfel, view = surfels.surfel_of_observation()[rows].astype(np.int64), observations.view[rows]
    r2 = np.zeros(len(rows))
    for index, of_view in enumerate(views):
        is_in_view = view == index
        r2[is_in_view] = _radius_at(of_view, surfels.position_m[surfel[is_in_view]])
    value = observations.radiance[rows].astype(np.float64) / limit[view][:, None]
    counts = (value > DARK) & (value < most[view][:, None])
    if counts.sum(axis=0).min() < MIN_SAMPLES * len(views):
        return [], len(rows)
    at = view.astype(np.int64), r2, np.log(limit[view])
    channels = [_Channel.of(surfel, *at, value[:, k], counts[:, k]) for k in range(3)]
    return channels, len(rows)


def _radius_at(view: TracedView, position_m: NDArray) -> NDArray[np.float64]:
    """Compute the squared image radius (N,) of positions (N, 3) in a view, as in :func:`radius_squared`."""
    camera = view.camera
    matrix = camera.world_from_camera
    local = (position_m - matrix[:3, 3]) @ matrix[:3, :3]
    x = local[:, 0] / np.maximum(local[:, 2], 1e-9) * camera.fx_px
    y = local[:, 1] / np.maximum(local[:, 2], 1e-9) * camera.fy_px
    far_x = max(camera.cx_px, camera.width_px - camera.cx_px) - 0.5
    far_y = max(camera.cy_px, camera.height_px - camera.cy_px) - 0.5
    return np.clip((x**2 + y**2) / (far_x**2 + far_y**2), 0, 1)


def _solved(
    channels: Sequence[_Channel], num_samples: int, num_views: int, *, has_curve: bool
) -> tuple[NDArray[np.float64], float, float, float]:
    """Estimate ln gains (V, 3), vignetting and curve by Gauss-Newton steps; return them and the cost.

    Residuals are those of recorded values, since a flat response would minimise residuals of radiance.
    """
    channels = [replace(channel, radiance=channel.radiance.copy()) for channel in channels]
    last = 3 * num_views
    spread = np.array([*[_PRIOR_GAIN] * last, _PRIOR_VIGNETTING, _PRIOR_CURVE if has_curve else 1e-9])
    weight = np.full(last + 2, _PRIOR_WEIGHT)
    weight[-1] = _CURVE_WEIGHT * num_samples
    state = np.zeros(last + 2)
    for number in range(_ROUNDS):
        scale = _SCALES[0] * (_SCALES[1] / _SCALES[0]) ** min(1.0, number / (_ROUNDS - 3))
        normal = np.diag(weight / spread**2)
        right = -weight * state / spread**2
        steps = []
        for index, channel in enumerate(channels):
            step = channel.step(state, index * num_views, last, scale)
            normal += step[0]
            right += step[1]
            steps.append(step[2:])
        change = np.linalg.solve(normal, right)
        for channel, (of_surfel, rest) in zip(channels, steps, strict=True):
            channel.radiance += np.clip(rest - of_surfel @ change, -1, 1)
        state = state + change
        state[-1] = np.clip(state[-1], -_MAX_CURVE, _MAX_CURVE)
    cost = sum(channel.cost(state, index * num_views, last) for index, channel in enumerate(channels))
    return state[:last].reshape(3, num_views).T.copy(), float(state[last]), float(state[last + 1]), cost


@dataclass
class _Channel:
    """M samples of a channel.

    ``surfel`` (from 0) and ``view``: indices; ``r2``: squared image radius; ``recorded`` and ``limit``: ln of
    the recorded value and of the clipping limit; all (M,). ``radiance``: ln radiance of each surfel.
    """

    surfel: NDArray[np.int64]
    view: NDArray[np.int64]
    r2: NDArray[np.float64]
    recorded: NDArray[np.float64]
    limit: NDArray[np.float64]
    radiance: NDArray[np.float64]

    @classmethod
    def of(
        cls, surfel: NDArray, view: NDArray, r2: NDArray, limit: NDArray, value: NDArray, counts: NDArray
    ) -> _Channel:
        """Select the samples in the mask ``counts`` (M,), without surfels that have fewer than MIN_VIEWS."""
        rows = np.flatnonzero(counts)
        rows = rows[np.bincount(surfel[rows])[surfel[rows]] >= MIN_VIEWS]
        surfel, recorded, limit = (
            np.unique(surfel[rows], return_inverse=True)[1],
            np.log(value[rows]),
            limit[rows],
        )
        return cls(surfel, view[rows], r2[rows], recorded, limit, _group_medians(recorded + limit, surfel))

    def predicted(self, state: NDArray, first: int, last: int) -> tuple[NDArray[np.float64], ...]:
        """Predict the ln values of the samples and their derivatives (:func:`_log_shown`) at ``state``, in
        which ``first`` is the index of the channel's first gain and ``last`` that of the vignetting.
        """
        fall_off = state[last] * self.r2
        arriving = self.radiance[self.surfel] + state[first + self.view] - fall_off - self.limit
        return _log_shown(arriving, state[last + 1])

    def cost(self, state: NDArray, first: int, last: int) -> float:
        """Compute the mean negative log likelihood of the residuals under a Cauchy distribution."""
        rest = self.recorded - self.predicted(state, first, last)[0]
        return float(np.log1p((rest / _SCALES[1]) ** 2).mean())

    def step(self, state: NDArray, first: int, last: int, scale: float) -> tuple[Any, ...]:
        """Compute the normal matrix and right-hand side for the cameras' unknowns, with the N surfels
        eliminated, and the matrix (N, unknowns) and vector (N,) for back-substitution of the surfels.
        """
        predicted, slope, by_curve = self.predicted(state, first, last)
        rest = self.recorded - predicted
        weight = 1 / (1 + (rest / scale) ** 2)
        rows, ones = np.arange(len(rest)), np.ones(len(rest), np.int64)
        columns = np.concatenate([first + self.view, last * ones, (last + 1) * ones])
        entries = np.concatenate([slope, -slope * self.r2, by_curve])
        design = sparse.csr_matrix((entries, (np.tile(rows, 3), columns)), (len(rest), last + 2))
        group = sparse.csr_matrix((weight * slope, (self.surfel, rows)))
        total = np.maximum(np.bincount(self.surfel, weight * slope**2), 1e-12)
        of_surfel = sparse.diags(1 / total) @ (group @ design)
        of_rest = (group @ rest) / total
        weighted = sparse.diags(weight) @ design
        normal = (design.T @ weighted).toarray() - (of_surfel.T @ (sparse.diags(total) @ of_surfel)).toarray()
        right = weighted.T @ rest - of_surfel.T @ (total * of_rest)
        return normal, right, of_surfel, of_rest


def _log_shown(arriving: NDArray, curve: float) -> tuple[NDArray[np.float64], ...]:
    """Compute the ln recorded value for the ln radiance ``arriving`` (M,), both relative to the limit, and
    its derivatives with respect to ``arriving`` and ``curve``, (M,) each.
    """
    if not curve:
        here, slope = arriving, np.ones_like(arriving)
    else:
        here = np.log(apply_response(np.exp(arriving), curve))
        slope = (np.log(apply_response(np.exp(arriving + _STEP), curve)) - here) / _STEP
    return here, slope, (np.log(apply_response(np.exp(arriving), curve + _STEP)) - here) / _STEP


def _group_medians(values: NDArray, group: NDArray) -> NDArray[np.float64]:
    """Compute the median (G,) of the ``values`` (N,) of each group; ``group`` (N,) is numbered from 0."""
    order = np.lexsort((values, group))
    num = np.bincount(group)
    first = np.cumsum(num) - num
    ordered = values[order]
    return 0.5 * (ordered[first + (num - 1) // 2] + ordered[first + num // 2])
