"""State-only simulation on machines without Vulkan.

SAPIEN's loaders and ManiSkill's task code construct render materials even when nothing will be
rendered, and SAPIEN raises ``failed to find a rendering device`` where there is no Vulkan
device. Where that is so, and only there, `prepare_headless` puts inert stand-ins in their place.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import Any

# The noise that importing SAPIEN and escnn makes on a machine without Vulkan or Fortran.
_NOISE = (
    "Failed to find system libvulkan.*",
    "Failed to find Vulkan ICD file.*",
    "Failed to find glvnd ICD file.*",
    ".*py3nj.*",
)

# What ManiSkill logs about objects of its own tasks that get their pose at the first reset.
_LOGGED_NOISE = "No initial pose set for actor builder"

_VISUAL_METHODS = (
    "add_plane_visual",
    "add_box_visual",
    "add_capsule_visual",
    "add_cylinder_visual",
    "add_sphere_visual",
    "add_visual_from_file",
)


class InertMaterial:
    """Stands in for ``sapien.render.RenderMaterial``: takes any argument, keeps any attribute."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.__dict__.update(kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set_"):
            return lambda *args, **kwargs: None
        raise AttributeError(name)


class InertTexture:
    """Stands in for ``sapien.render.RenderTexture2D``, which would read an image for nothing."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass


@lru_cache(maxsize=1)
def rendering_works() -> bool:
    """Whether SAPIEN finds a Vulkan device in this process."""
    silence_import_noise()
    import sapien.render

    try:
        sapien.render.RenderMaterial()
    except RuntimeError:
        return False
    return True


def prepare_headless() -> bool:
    """Make state-only simulation possible where there is no Vulkan device.

    Idempotent, cheap after the first call, and without effect where rendering works. Where it
    does not, render materials and textures become inert and the ``add_*_visual`` methods of
    SAPIEN's actor builder do nothing, for every user of SAPIEN in this process: those calls
    would raise otherwise.

    Returns:
        Whether rendering works.
    """
    silence_import_noise()
    _silence_logged_noise()
    if rendering_works():
        return True
    _install_stand_ins()
    return False


def silence_import_noise() -> None:
    """Hide the warnings that importing SAPIEN and escnn causes and nobody needs to act on."""
    for message in _NOISE:
        warnings.filterwarnings("ignore", message=message)


@lru_cache(maxsize=1)
def _silence_logged_noise() -> None:
    from mani_skill import logger

    logger.addFilter(lambda record: not record.getMessage().startswith(_LOGGED_NOISE))


@lru_cache(maxsize=1)
def _install_stand_ins() -> None:
    import sapien
    import sapien.render
    import sapien.wrapper.urdf_loader as urdf_loader
    from mani_skill.utils.building import _mjcf_loader as mjcf_loader
    from mani_skill.utils.building.actor_builder import ActorBuilder

    def add_nothing(self: Any, *args: Any, **kwargs: Any) -> Any:
        return self

    sapien.render.RenderMaterial = InertMaterial
    sapien.render.RenderTexture2D = InertTexture
    urdf_loader.RenderMaterial = InertMaterial
    urdf_loader.RenderTexture2D = InertTexture
    mjcf_loader.RenderMaterial = InertMaterial
    mjcf_loader.RenderTexture2D = InertTexture
    for name in _VISUAL_METHODS:
        setattr(sapien.ActorBuilder, name, add_nothing)
    ActorBuilder.add_plane_repeated_visual = add_nothing
