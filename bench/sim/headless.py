"""State-only simulation on machines without Vulkan.

SAPIEN's loaders and ManiSkill's task code construct render materials even if nothing is rendered,
and without a Vulkan device SAPIEN raises ``failed to find a rendering device``. Only in that case
`prepare_headless` replaces them by objects that do nothing.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import Any

RENDERING_CURE = (
    "install your GPU's Vulkan driver, or (software rendering) apt install chromium and set "
    "VK_ICD_FILENAMES to /usr/lib/chromium/vk_swiftshader_icd.json"
)
"""How to get pictures and videos."""

# Warnings of SAPIEN and escnn at import.
_NOISE = (
    "Failed to find system libvulkan.*",
    "Failed to find Vulkan ICD file.*",
    "Failed to find glvnd ICD file.*",
    ".*py3nj.*",
    "invalid escape sequence.*",
)

# ManiSkill logs this about objects of its own tasks, which get their pose at the first reset.
_LOGGED_NOISE = "No initial pose set for actor builder"


class Inert:
    """Replaces SAPIEN's render materials and textures: takes any argument, stores any attribute."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.__dict__.update(kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set_"):
            return lambda *args, **kwargs: None
        raise AttributeError(name)


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
    """Make state-only simulation possible without a Vulkan device.

    Cheap after the first call; does nothing if rendering works. Otherwise render materials and
    textures become inert and the ``add_*_visual`` methods of SAPIEN's actor builder do nothing, in
    the whole process. Those calls would raise without this.

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
    """Hide harmless warnings that SAPIEN and escnn give at import."""
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

    modules: tuple[Any, ...] = (sapien.render, urdf_loader, mjcf_loader)
    for module in modules:
        module.RenderMaterial = module.RenderTexture2D = Inert
    shapes = ("plane", "box", "capsule", "cylinder", "sphere")
    for name in (*(f"add_{shape}_visual" for shape in shapes), "add_visual_from_file"):
        setattr(sapien.ActorBuilder, name, add_nothing)
    ActorBuilder.add_plane_repeated_visual = add_nothing
