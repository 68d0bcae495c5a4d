# SPDX-License-Identifier: MIT
"""Settings that trade accuracy for time, in sweeps around a base point and in a factorial design.

Every field of :class:`Setting` affects time. The base point has the recipe's defaults and a fixed number of
samples. A sweep varies one field, and the factorial combines four fields that interact: auxiliary buffers
are used only by the denoiser, which reduces the number of samples needed, and the irradiance cache makes
samples cheaper and less noisy.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any, Literal, get_args

from pydantic import ValidationError

from datagen.formats.recipe import DEFAULT_MAX_DEPTH, QUALITIES, RenderRecipe
from datagen.foundation.errors import Problem, raise_problems
from datagen.foundation.exr import COMPRESSIONS
from datagen.rendering.denoiser import uses_optix

DenoiserMode = Literal["none", "fast", "balanced", "high", "unguided", "optix"]
"""No denoiser, three qualities of OIDN with guides, OIDN's ``high`` without guides, or OptiX."""


@dataclass(frozen=True)
class Setting:
    """Options for rendering, processing and storing a view; fields named as in a recipe mean the same.

    ``quality``, if not '', overrides the fields for samples, clamp, irradiance cache and auxiliary samples.
    ``firefly_clamp`` 0 clamps nothing. ``irradiance_cache`` 1 ends paths in cached irradiance.
    ``texture_shrink`` is the side in texels of the squares that are averaged to one texel. ``image_scale``
    multiplies width and height; images are enlarged for comparison. ``storage`` ``float`` stores every
    channel in single precision.
    """

    quality: str = ""
    path_samples: int = 8
    auxiliary_samples: int = 64
    denoiser: str = "high"
    max_depth: int = DEFAULT_MAX_DEPTH
    russian_roulette_depth: int = 5
    firefly_clamp: float = 0.0
    irradiance_cache: int = 0
    texture_shrink: int = 1
    image_scale: float = 1.0
    best_views: int = 12
    visibility: str = "depth"
    storage: str = "half"
    compression: str = "zip"
    variant: str = "llvm_ad_rgb"

    def recipe(self) -> RenderRecipe:
        """Convert the fields that concern the renderer to a recipe."""
        common = {
            "variant": self.variant,
            "max_depth": self.max_depth,
            "russian_roulette_depth": self.russian_roulette_depth,
            "denoise": self.denoiser != "none",
        }
        if self.quality:
            return RenderRecipe.model_validate({**common, "quality": self.quality})
        samples = {"path_samples": self.path_samples, "auxiliary_samples": self.auxiliary_samples}
        clamp = {"firefly_clamp": self.firefly_clamp} if self.firefly_clamp else {}
        cache = {"irradiance_cache": bool(self.irradiance_cache)}
        return RenderRecipe.model_validate({**common, **samples, **clamp, **cache})

    def differences(self, base: Setting) -> dict[str, Any]:
        """Fields, with values, in which the setting differs from ``base``."""
        theirs = asdict(base)
        return {name: value for name, value in asdict(self).items() if value != theirs[name]}

    def text(self, base: Setting) -> str:
        """Short description of the setting by its differences from ``base``, or "base"."""
        found = self.differences(base)
        return ", ".join(f"{name} {value}" for name, value in found.items()) or "base"


SWEEPS: dict[str, tuple[Any, ...]] = {
    "path_samples": (1, 2, 4, 8, 16, 32, 64),
    "auxiliary_samples": (4, 16, 64, 256),
    "denoiser": tuple(mode for mode in get_args(DenoiserMode) if mode != "optix"),
    "max_depth": (2, 3, 4, 6, 8, 12, 16),
    "russian_roulette_depth": (2, 3, 5, 8),
    "firefly_clamp": (0.0, 3.0, 10.0, 30.0, 100.0),
    "irradiance_cache": (0, 1),
    "texture_shrink": (1, 2, 4, 8),
    "image_scale": (1.0, 0.75, 0.5),
    "best_views": (4, 8, 12, 24),
    "visibility": ("depth", "trace"),
    "storage": ("half", "float"),
    "compression": tuple(COMPRESSIONS),
    "variant": ("llvm_ad_rgb", "cuda_ad_rgb"),
    "quality": tuple(QUALITIES),
}
"""Default values of each field in its sweep."""
FACTORIAL: dict[str, tuple[Any, ...]] = {
    "path_samples": (2, 4, 8, 16, 32),
    "auxiliary_samples": (16, 64),
    "denoiser": ("fast", "balanced", "high"),
    "irradiance_cache": (0, 1),
}
"""Values of the four fields of the factorial; all combinations are measured."""
_LIMITS: dict[str, tuple[float, float]] = {
    "firefly_clamp": (0.0, 1e6),
    "irradiance_cache": (0, 1),
    "image_scale": (0.05, 1.0),
    "best_views": (4, 24),
}


def base_setting(variant: str) -> Setting:
    """Base point of the sweeps, with the default denoiser of the Mitsuba ``variant``."""
    return Setting(variant=variant, denoiser="optix" if uses_optix(variant) else "high")


def planned_settings(base: Setting, sweeps: tuple[str, ...], with_factorial: bool) -> list[Setting]:
    """List ``base``, its sweeps and, if ``with_factorial`` and not on CUDA, the factorial design.

    Each of ``sweeps`` varies one field: ``NAME`` with the values of :data:`SWEEPS`, or ``NAME=VALUE,VALUE``.
    Duplicates are removed. Raises :class:`InputError` with all invalid sweeps.
    """
    settings, problems = [base], []
    for text in sweeps:
        name, _, listed = text.partition("=")
        if name not in SWEEPS:
            expected = f"one of {', '.join(SWEEPS)}"
            problems.append(Problem("--sweep", "", repr(text), expected, "write NAME, or NAME=VALUE,VALUE"))
            continue
        for value in SWEEPS[name] if not listed else listed.split(","):
            try:
                changed = replace(base, **{name: _checked(name, value)})
                if name == "variant":  # each variant has its own denoiser
                    changed = replace(changed, denoiser=base_setting(changed.variant).denoiser)
                changed.recipe()
            except ValueError as error:
                problems.append(Problem("--sweep", name, repr(value), _reason(error), "correct the value"))
                continue
            settings.append(changed)
    raise_problems(problems)
    if with_factorial and not base.variant.startswith("cuda"):
        for values in product(*FACTORIAL.values()):
            settings.append(replace(base, **dict(zip(FACTORIAL, values, strict=True))))
    return list(dict.fromkeys(settings))


def _checked(name: str, value: Any) -> Any:
    """Convert ``value`` to the type of field ``name``. Raises :class:`ValueError` if it is invalid."""
    kind = type(getattr(Setting(), name))
    if kind is str and value not in SWEEPS[name]:
        raise ValueError(f"one of {', '.join(SWEEPS[name])}")
    converted = kind(value)
    low, high = _LIMITS.get(name, (1, 1 << 20))
    if kind is not str and not low <= converted <= high:
        raise ValueError(f"{low} ... {high}")
    return converted


def _reason(error: ValueError) -> str:
    return str(error).splitlines()[0] if not isinstance(error, ValidationError) else error.errors()[0]["msg"]
