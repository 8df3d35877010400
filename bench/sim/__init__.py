"""N parallel ManiSkill environments on any machine.

- `create(env_cls, num_envs, sim, workers=W)`: environments of any ManiSkill task class.
- `make_env_class(env_cls, sim)`: the class behind it, to subclass or register.
- `prepare_headless()`: lets state-only environments run without a Vulkan driver.

Names are imported on first use: `capabilities` must also work where importing ManiSkill fails.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symsteer.lazy import lazily

if TYPE_CHECKING:
    from symsteer.bench.sim.environment import make_env_class
    from symsteer.bench.sim.headless import prepare_headless, rendering_works
    from symsteer.bench.sim.parallel import create

__all__ = ["create", "make_env_class", "prepare_headless", "rendering_works"]

__getattr__ = lazily(
    __name__,
    {
        "create": "parallel",
        "make_env_class": "environment",
        "prepare_headless": "headless",
        "rendering_works": "headless",
    },
)
