# SPDX-License-Identifier: MIT
"""The project's Mitsuba plugins: the BSDF ``cook_torrance`` and the integrator ``material_buffers``.

Select the variant first, then register::

    from mitsuba_plugins import register, select_variant

    select_variant()
    register()
"""

from __future__ import annotations

from typing import Any

from mitsuba_plugins.variant import select_variant

__all__ = ["load_dict", "register", "select_variant"]

_registered_variants: set[str] = set()


def register() -> None:
    """Register the project's plugins with Mitsuba for the active variant. Repeated calls do nothing.

    Raises ``RuntimeError`` if no variant is active.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        raise RuntimeError("no Mitsuba variant is active; call mitsuba_plugins.select_variant() first")
    if variant in _registered_variants:
        return
    from mitsuba_plugins.cook_torrance import CookTorrance
    from mitsuba_plugins.material_buffers import MaterialBuffers

    mi.register_bsdf("cook_torrance", CookTorrance)
    mi.register_integrator("material_buffers", MaterialBuffers)
    _registered_variants.add(variant)


def load_dict(scene: dict[str, Any], **options: Any) -> Any:
    """Load ``scene`` by ``mitsuba.load_dict``, and raise one :class:`InputError` for all faulty materials.

    ``mitsuba.load_dict`` alone would raise a ``RuntimeError`` at the first fault; ``options`` (``parallel``,
    ``optimize``) are passed on.
    """
    import mitsuba as mi

    from mitsuba_plugins.texture_checks import gathering_problems

    with gathering_problems():
        return mi.load_dict(scene, **options)
