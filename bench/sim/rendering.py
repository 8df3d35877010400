"""Cameras of batched CPU scenes, for ManiSkill's batched rendering code.

ManiSkill's GPU branch renders all scenes at once through SAPIEN's ``RenderSystemGroup`` and
``RenderCameraGroup``, which read poses from CUDA. The classes here have the same methods, but
render one scene after the other from the entities' poses, on any Vulkan device.
"""

from __future__ import annotations

from collections.abc import Sequence

import sapien
import sapien.render
import torch
from mani_skill.utils import common

from symsteer.bench.sim.contacts import Buffer
from symsteer.bench.sim.headless import RENDERING_CURE, rendering_works
from symsteer.bench.sim.physx import BatchedPhysx
from symsteer.errors import UserError


def find_device(name: str | None = None) -> sapien.Device:
    """The device to render on.

    Args:
        name: a name that SAPIEN understands ("cuda:1", "pci:0000:01:00.0"), or None for the
            first device that can render.

    Raises:
        UserError: there is no Vulkan device, or none with this name.
    """
    if not rendering_works():
        raise UserError(
            f"Rendering needs a Vulkan driver, and none was found: {RENDERING_CURE}; state-only "
            "runs need no driver."
        )
    if name in (None, "gpu", "cpu", "none"):
        return sapien.render.RenderSystem().device
    try:
        return sapien.Device(name)
    except RuntimeError as error:
        raise UserError(
            f'There is no render device "{name}": leave render_backend out to use the first one.'
        ) from error


class CameraGroup:
    """The same camera in every scene."""

    def __init__(self, cameras: Sequence[sapien.render.RenderCameraComponent]) -> None:
        self._cameras = cameras

    def take_picture(self) -> None:
        """Render every scene."""
        for camera in self._cameras:
            camera.take_picture()

    def get_picture_cuda(self, name: str) -> Buffer:
        """A texture of the last pictures, e.g. "Color", ``[N, height, width, channels]``."""
        pictures = [common.to_tensor(camera.get_picture(name)) for camera in self._cameras]
        return Buffer(torch.stack(pictures).numpy())


class RenderGroup:
    """The renderers of all scenes."""

    def __init__(self, scenes: Sequence[sapien.Scene], px: BatchedPhysx) -> None:
        self._scenes = scenes
        self._px = px

    def update_render(self) -> None:
        """Update the drawn poses from the simulation."""
        self._px.finish_substeps()
        for scene in self._scenes:
            scene.update_render()

    def create_camera_group(
        self, cameras: Sequence[sapien.render.RenderCameraComponent], names: Sequence[str]
    ) -> CameraGroup:
        """Group one camera of each scene; the names of textures are not used here."""
        return CameraGroup(cameras)
