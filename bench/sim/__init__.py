"""N parallel ManiSkill environments on any machine.

- `create(env_cls, num_envs, sim)`: environments of any ManiSkill task class.
- `make_env_class(env_cls, sim)`: the class behind it, to subclass or register.
- `BatchedCpuMixin`: what makes a task class run on batched CPU physics.
- `prepare_headless()`: lets state-only environments run without a Vulkan driver.
"""

from bench.sim.headless import prepare_headless, rendering_works, silence_import_noise

silence_import_noise()

from bench.sim.environment import BatchedCpuMixin, create, make_env_class  # noqa: E402

__all__ = [
    "BatchedCpuMixin",
    "create",
    "make_env_class",
    "prepare_headless",
    "rendering_works",
]
