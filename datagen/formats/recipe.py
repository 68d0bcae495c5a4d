# SPDX-License-Identifier: MIT
"""Recipes: the description of a dataset. YAML in ``scenes/recipes/``; unknown keys are errors; flags override
files.

Ranges are [low, high], both ends included; draws are uniform unless the field says otherwise.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from datagen.formats.asset import DAYTIMES, Daytime, MaterialClass
from datagen.formats.base import NonNegative, Positive, Slug, StrictModel, Unit


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("expected [low, high] with low <= high")
    return value


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]
CountRange = Annotated[
    tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], AfterValidator(_ordered)
]


class AssetFilter(StrictModel):
    """Selection of assets: all of the library, only those in ``include``, never those in ``exclude``."""

    include: tuple[Slug, ...] | None = None
    exclude: tuple[Slug, ...] = ()


RoomKind = Literal[
    "bathroom", "bedroom", "bedsit", "cafe", "childs_room", "dining_room", "hallway", "kitchen", "laundry",
    "living_room", "meeting_room", "office", "reading_room", "study", "workshop",
]  # fmt: skip
"""Kinds of rooms that ``datagen.parametric`` makes."""


class ParametricRecipe(StrictModel):
    """Rooms made by rules, a new one for each configuration: ``share`` of the configurations have one.

    ``kinds`` are drawn alike; empty: all. The others take an environment of the library.
    """

    share: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    kinds: tuple[RoomKind, ...] = ()


class EnvironmentRecipe(AssetFilter):
    """Rooms: environments of the library, and with ``parametric`` rooms that are made for the dataset."""

    parametric: ParametricRecipe | None = Field(default=None, exclude_if=lambda value: value is None)

    @property
    def needs_library(self) -> bool:
        """True where configurations can use library environments."""
        return self.parametric is None or self.parametric.share < 1


class ObjectRecipe(AssetFilter):
    """Things to place. ``count`` a configuration; ``category_weights`` default to 1 a category.

    ``library_weights``: how often each folder of ``library``, as it is named there, gives the next thing (1
    for one that is not named), so that a few objects of one's own do not drown among many. Empty: all
    folders are one.
    """

    count: CountRange = (8, 20)
    category_weights: dict[Slug, NonNegative] = {}
    library_weights: dict[str, NonNegative] = {}
    min_gap_m: NonNegative = 0.005
    max_attempts: Annotated[int, Field(ge=1, le=10000)] = 60


class Variation(StrictModel):
    """Weights of two ways to dress a room, one of which is drawn for each configuration.

    ``likely``: materials and colours that such surfaces have in real rooms, in harmony with each other.
    ``wild``: any material of a class that suits the slot, in any colour that the class may have.
    """

    likely: NonNegative = 0.0
    wild: NonNegative = 0.0

    @model_validator(mode="after")
    def _has_weight(self) -> Variation:
        if self.likely + self.wild <= 0:
            raise ValueError("expected a positive weight of likely or wild")
        return self


class MaterialRecipe(AssetFilter):
    """Materials of slots: the probabilities that an asset's own material is replaced or varied.

    ``variation``: likely or wild; a recipe without it is wild, as all were before there was a choice.
    ``any_class_probability`` and ``class_weights`` are for wild configurations. ``any_class_probability`` of
    the replacements take no notice of the classes that suit a slot: a floor of steel, a sofa of marble.
    ``class_weights`` default to 1 a class; 0 leaves a class out.
    """

    variation: Variation = Variation(wild=1.0)
    replace_probability: Unit = 0.8
    any_class_probability: Unit = 0.0
    class_weights: dict[MaterialClass, NonNegative] = {}
    vary_probability: Unit = 0.7
    variation_strength: Unit = 1.0


class PanoramaWeights(StrictModel):
    """Weights of the times of day outside. A panorama of that time and its rotation are drawn.

    At dusk and at night the room's lamps are on, or others where it has none.
    """

    day: NonNegative = 0.0
    overcast: NonNegative = 0.0
    dusk: NonNegative = 0.0
    night: NonNegative = 0.0

    @model_validator(mode="after")
    def _has_weight(self) -> PanoramaWeights:
        if not self.wanted():
            raise ValueError(f"expected a positive weight of {', '.join(DAYTIMES)}")
        return self

    def wanted(self) -> dict[Daytime, float]:
        """The times of day that occur, with their weights."""
        return {time: getattr(self, time) for time in DAYTIMES if getattr(self, time) > 0}


class LightRecipe(StrictModel):
    """Lights of configurations. Probabilities are per kind; at least one light is always on.

    With ``panoramas`` every room that has openings and no sky of its own has the radiance of a panorama
    outside, whatever ``daylight_probability`` says; generated rooms then have no modelled outside.

    Intensities are drawn log-uniformly, then all are scaled by one factor so that a probe estimate of the
    mean irradiance in the camera region falls into ``mean_irradiance`` (W/m^2, in the renderer's units).
    """

    native_probability: Unit = 0.5
    area_probability: Unit = 0.8
    point_probability: Unit = 0.3
    daylight_probability: Unit = 0.7
    count_area: CountRange = (1, 3)
    count_point: CountRange = (1, 2)
    color_temperature_k: PositiveRange = (2700.0, 7500.0)
    mean_irradiance: PositiveRange = (0.5, 4.0)
    environment_images: tuple[Slug, ...] = ()
    panoramas: PanoramaWeights | None = Field(default=None, exclude_if=lambda value: value is None)


class CameraRecipe(StrictModel):
    """Positions of cameras and the conditions on their views.

    Heights are above the floor of the camera region. ``fov_x_deg`` is the horizontal field of view.
    ``min_distance_m``: no surface may be nearer in more than 2 % of the image; ``max_near_share``: largest
    share of the image nearer than twice that. ``min_content``: least number of distinct instances seen.
    ``min_overlap``: least share of a view's points that another view sees too. ``min_luminance`` is relative
    to the configuration's median view.

    ``subject``: ``things`` are looked at wherever they stand, floors and tables seen from above among them;
    ``room`` looks across the room, nearly level, and prefers views that show what others see too.
    """

    subject: Literal["things", "room"] = "things"
    height_m: PositiveRange = (0.8, 1.9)
    fov_x_deg: PositiveRange = (50.0, 75.0)
    min_distance_m: Positive = 0.3
    max_near_share: Unit = 0.35
    min_content: Annotated[int, Field(ge=1)] = 3
    min_overlap: Unit = 0.3
    min_luminance: NonNegative = 0.05
    max_attempts: Annotated[int, Field(ge=1, le=100000)] = 40


Quality = Literal["draft", "standard", "reference"]
QUALITIES: dict[Quality, dict[str, float | int | None]] = {
    "draft": {
        "max_rel_mse": 0.02,
        "max_path_samples": 32,
        "auxiliary_samples": 16,
        "firefly_clamp": 30.0,
        "irradiance_cache": True,
    },
    "standard": {
        "max_rel_mse": 0.005,
        "max_path_samples": 128,
        "auxiliary_samples": 64,
        "firefly_clamp": 30.0,
        "irradiance_cache": True,
    },
    "reference": {
        "max_rel_mse": 0.0005,
        "max_path_samples": 4096,
        "auxiliary_samples": 64,
        "firefly_clamp": None,
        "irradiance_cache": False,
    },
}
"""Values of the named qualities; measured, see docs/decisions/0070."""
DEFAULT_PATH_SAMPLES = 8
DEFAULT_MAX_PATH_SAMPLES = 1024
DEFAULT_MAX_DEPTH = 8

_RESOLVED = ("quality", "path_samples", "max_rel_mse", "max_path_samples", "max_depth", "max_energy_left")
PathSamples = Annotated[int, Field(ge=1, le=1 << 20)]


def _budget_contradictions(given: dict[str, Any]) -> list[str]:
    """Fields of ``given`` (those that are not None) that contradict each other about the sampling budget."""
    found = []
    quality = given.get("quality")
    if quality is not None:
        named = [name for name in ("max_rel_mse", "path_samples") if name in given]
        if named:
            found.append(f"either quality or {' and '.join(named)}: a quality stands for them")
        if quality == "reference" and given.get("firefly_clamp") is not None:
            found.append("no firefly_clamp with quality reference, which leaves nothing out")
        if quality == "reference" and given.get("irradiance_cache"):
            found.append("no irradiance_cache with quality reference, which traces all light")
    if "path_samples" in given:
        others = [name for name in ("max_rel_mse", "max_path_samples") if name in given]
        if others:
            found.append(f"either path_samples, a fixed number, or {' and '.join(others)}")
    elif "max_path_samples" in given and quality is None and "max_rel_mse" not in given:
        found.append("max_path_samples only beside max_rel_mse or quality: it is the ceiling of a target")
    if "max_depth" in given and "max_energy_left" in given:
        found.append("either max_depth or max_energy_left, from which a depth follows")
    return found


class RenderRecipe(StrictModel):
    """Sampling budget of a view: a fixed number of light paths, or an error to reach.

    Give one of

    * ``path_samples``: so many light paths a pixel (the default, 8);
    * ``max_rel_mse``: render until the estimated relMSE of the finished beauty image against convergence is
      at most this (exposed, see :mod:`datagen.rendering.error`), or ``max_path_samples`` are reached;
    * ``quality``: a name for such a target, :data:`QUALITIES`. ``max_path_samples``, ``auxiliary_samples``,
      ``firefly_clamp`` and ``irradiance_cache`` may be given beside it. Numbers take its place as soon as
      the recipe is read, so that a saved recipe means the same when a later version gives the name others.

    ``firefly_clamp``: the most that a light path may bring by two or more reflections, in multiples of what
    the image's exposure shows as white; None clamps nothing, direct light is never clamped.
    ``irradiance_cache``: paths may end behind their first broad reflection in irradiance that was gathered
    for all views beforehand: faster, and slightly wrong (docs/decisions/0075). ``auxiliary_samples`` clean
    buffers a pixel. ``max_depth`` segments a path at most (the default, 8), or, if ``max_energy_left`` is
    given instead, as many as the scene's albedo requires to truncate at most that share of the light; cached
    irradiance has had any number of reflections.
    """

    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb"] = "auto"
    quality: Quality | None = None
    path_samples: PathSamples | None = None
    max_rel_mse: Positive | None = None
    max_path_samples: Annotated[PathSamples, Field(ge=2)] | None = None
    firefly_clamp: Positive | None = None
    irradiance_cache: bool = False
    auxiliary_samples: Annotated[int, Field(ge=1, le=4096)] = 64
    max_depth: Annotated[int, Field(ge=1, le=1024)] | None = None
    max_energy_left: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    russian_roulette_depth: Annotated[int, Field(ge=1, le=1024)] = 5
    denoise: bool = True
    keep_noisy: bool = False

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, data: Any) -> Any:
        """Replace names and absences by numbers."""
        if not isinstance(data, dict):
            return data
        given = {k: v for k, v in data.items() if v is not None or k not in _RESOLVED}
        contradictions = _budget_contradictions(given)
        if contradictions:
            raise ValueError("expected " + "; ".join(contradictions))
        quality = given.get("quality")
        if isinstance(quality, str) and quality in QUALITIES:
            del given["quality"]
            given = {**QUALITIES[quality], **given}
        if quality is None and "max_rel_mse" not in given:
            given.setdefault("path_samples", DEFAULT_PATH_SAMPLES)
        elif "max_rel_mse" in given:
            given.setdefault("max_path_samples", DEFAULT_MAX_PATH_SAMPLES)
        if "max_energy_left" not in given:
            given.setdefault("max_depth", DEFAULT_MAX_DEPTH)
        return given


class StatisticsRecipe(StrictModel):
    """Multi-view statistics (method 2). ``light``: also the buffers of the light that the views record
    (:data:`~datagen.foundation.buffers.LIGHT_BUFFERS`), as inputs of networks."""

    best_views: Annotated[int, Field(ge=4, le=24)] = 12
    visibility: Literal["depth", "trace"] = "depth"
    include_self: bool = True
    light: bool = Field(default=False, exclude_if=lambda value: not value)


class SplitRecipe(StrictModel):
    """Shares of configurations. ``disjoint``: no asset or material of the test split appears in training."""

    train: Unit = 1.0
    validation: Unit = 0.0
    test: Unit = 0.0
    disjoint: bool = False

    @model_validator(mode="after")
    def _sums_to_one(self) -> SplitRecipe:
        total = self.train + self.validation + self.test
        if abs(total - 1) > 1e-6:
            raise ValueError(f"expected train + validation + test = 1, got {total:g}")
        return self


class OutputRecipe(StrictModel):
    """Storage of views. Lossless; ``zip`` is the smallest that every reader knows."""

    compression: Literal["none", "rle", "zips", "zip", "piz"] = "zip"


class Recipe(StrictModel):
    """A dataset to make. ``library``: folders, relative to the recipe; "bundled" is the project's own."""

    format: Literal["scene-materials/recipe"] = "scene-materials/recipe"
    version: Literal[1] = 1
    name: Slug
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    configurations: Annotated[int, Field(ge=1, le=10_000_000)]
    views: Annotated[int, Field(ge=1, le=4096)]
    resolution: tuple[Annotated[int, Field(ge=8, le=16384)], Annotated[int, Field(ge=8, le=16384)]] = (
        640,
        384,
    )
    library: tuple[str, ...] = ("bundled",)
    environments: EnvironmentRecipe = EnvironmentRecipe()
    objects: ObjectRecipe = ObjectRecipe()
    materials: MaterialRecipe = MaterialRecipe()
    lights: LightRecipe = LightRecipe()
    cameras: CameraRecipe = CameraRecipe()
    render: RenderRecipe = RenderRecipe()
    statistics: StatisticsRecipe = StatisticsRecipe()
    splits: SplitRecipe = SplitRecipe()
    output: OutputRecipe = OutputRecipe()

    @model_validator(mode="after")
    def _weighs_libraries_that_it_has(self) -> Recipe:
        unknown = [name for name in self.objects.library_weights if name not in self.library]
        if unknown:
            raise ValueError(
                f"expected objects.library_weights to name folders of library ({', '.join(self.library)}), "
                f"got {', '.join(unknown)}"
            )
        return self
