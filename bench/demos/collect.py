"""Run the scripted experts and write their successful episodes as ManiSkill trajectories.

A base policy trained on clean demonstrations hardly depends on its noise and cannot be steered.
Diverse demonstrations have correlated action noise, whose strength is drawn per demonstration,
and an offset of the point that is grasped or pushed. Only successes are kept.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from symsteer.bench.demos.files import Episode, write
from symsteer.bench.sim.trees import map_trees
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError
from symsteer.files import prepare_folder
from symsteer.names import unknown


@dataclass(frozen=True)
class Diversity:
    """How demonstrations differ from one another beyond their initial states."""

    noise: float = 0.6
    """Standard deviation of the action noise, in normalized action units of the floating gripper
    (the Panda's larger steps take 0.6 of it, tasks their own ``noise_scale``)."""
    correlation: float = 0.8
    """Correlation of the noise from one step to the next (first-order autoregressive)."""
    scale: tuple[float, float] = (0.3, 1.7)
    """The noise of each demonstration is multiplied by a uniform draw from this range."""
    offset: float = 0.02
    """Radius of the disc from which the grasp or contact offset is drawn, metres."""


MODES = {"clean": Diversity(noise=0.0, scale=(1.0, 1.0), offset=0.0), "diverse": Diversity()}
"""Named kinds of demonstrations."""

ATTEMPTS_PER_DEMO = 20
"""Give up when the experts need more attempts than this for each demonstration."""


def collect(
    task: str,
    embodiment: str,
    count: int,
    mode: str,
    seed: int,
    out_path: str | os.PathLike[str],
    *,
    num_envs: int = 32,
    progress: Callable[[int, int], None] = lambda done, count: None,
) -> Path:
    """Write ``count`` successful expert episodes to ``out_path`` (``.h5``) and its ``.json``.

    Episodes end at their first success. On the CPU the same arguments give the same
    demonstrations. Initial states and disturbances depend only on each attempt's own seed, and
    attempts are kept in the order of their seeds. With another ``num_envs`` contacts may still
    differ in the last digits, because PhysX remembers earlier contacts.

    Args:
        task: name of a task.
        embodiment: ``floating`` or ``panda``.
        count: how many demonstrations.
        mode: ``clean`` or ``diverse``.
        seed: of the whole file.
        out_path: ends in ``.h5``.
        num_envs: attempts that run side by side.
        progress: called with (demonstrations so far, count).

    Returns:
        The path of the ``.h5`` file.

    Raises:
        UserError: for a bad argument, if the expert fails too often, or if the files cannot be
            written; earlier ones stay as they were.
    """
    path = Path(out_path)
    if path.suffix != ".h5":
        raise UserError(f"the file of demonstrations must end in .h5; it is {path.name!r}")
    if path.is_dir():
        raise UserError(f"{path} is a folder; name a file for the demonstrations")
    if count < 1:
        raise UserError(f"the number of demonstrations must be at least 1; it is {count}")
    if not 0 <= seed < 2**32:
        raise UserError(f"the seed must lie in [0, 2^32); it is {seed}")
    if mode not in MODES:
        raise unknown("mode", mode, MODES)
    prepare_folder(path.parent)
    env = make(task, num_envs=min(num_envs, 2 * count), embodiment=embodiment)
    seeds = np.random.RandomState(seed)
    episodes: list[Episode] = []
    tried = 0
    while len(episodes) < count:
        if tried >= ATTEMPTS_PER_DEMO * count:
            raise UserError(
                f"the expert of {task!r} ({embodiment}) succeeded only {len(episodes)} times in "
                f"{tried} attempts; collect clean demonstrations, or of another task"
            )
        batch = np.asarray(seeds.randint(2**31, size=env.num_envs)).tolist()
        episodes += _run(env, batch, MODES[mode])
        tried += len(batch)
        progress(min(len(episodes), count), count)
    origin = {"mode": mode, "diversity": asdict(MODES[mode]), "seed": seed, "attempts": tried}
    write(path, env, episodes[:count], origin)
    env.close()
    return path


def _run(env: SymmetricTask, seeds: list[int], settings: Diversity) -> list[Episode]:
    """Attempt one episode per seed side by side; return the successful ones in order."""
    obs, _ = env.reset(seed=seeds)
    expert = Expert(env)
    steps, count = env.max_episode_steps, env.num_envs
    noise, expert.offset = _disturbances(seeds, steps, settings, env)
    observations, states = [_numpy(obs)], [_numpy(env.get_state_dict())]
    actions: list[np.ndarray] = []
    rewards: list[np.ndarray] = []
    length = np.zeros(count, dtype=int)
    for step in range(steps):
        action = expert.act(noise[step])
        obs, reward, _, _, info = env.step(action)
        actions.append(_numpy(action))
        rewards.append(_numpy(reward).astype(np.float32))
        observations.append(_numpy(obs))
        states.append(_numpy(env.get_state_dict()))
        length[(length == 0) & _numpy(info["success"])] = step + 1
        if (length > 0).all():
            break
    return [
        Episode(
            seed=seeds[i],
            obs=np.stack([o[i] for o in observations[: end + 1]]),
            actions=np.stack([a[i] for a in actions[:end]]),
            rewards=np.stack([r[i] for r in rewards[:end]]),
            states=map_trees(lambda *x, i=i: np.stack([s[i] for s in x]), *states[: end + 1]),
        )
        for i, end in enumerate(length)
        if end > 0
    ]


def _disturbances(
    seeds: list[int], steps: int, settings: Diversity, env: SymmetricTask
) -> tuple[torch.Tensor, torch.Tensor]:
    """Action noise ``[steps, N, 7]`` and offsets ``[N, 3]``, one generator per seed."""
    dim = env.action_layout.dim
    noise = np.zeros((steps, len(seeds), dim))
    offsets = np.zeros((len(seeds), 3))
    innovation = np.sqrt(1 - settings.correlation**2)
    for i, seed in enumerate(seeds):
        # The second number keeps it apart from the environment's generator of the same seed.
        rng = np.random.default_rng([seed, 1])
        tolerance = env.body.noise_scale * env.noise_scale
        scale = settings.noise * tolerance * rng.uniform(*settings.scale)
        radius, bearing = settings.offset * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        offsets[i, :2] = radius * np.cos(bearing), radius * np.sin(bearing)
        draws = rng.standard_normal((steps, dim))
        level = draws[0]
        for step in range(steps):
            if step > 0:
                level = settings.correlation * level + innovation * draws[step]
            noise[step, i] = scale * level
    # Noise on the fingers would drop the object; noise on the tilt does not help steering.
    for name in ("gripper", "tilt"):
        noise[:, :, env.action_layout.slice(name)] = 0.0
    return (
        torch.as_tensor(noise, dtype=torch.float32, device=env.device),
        torch.as_tensor(offsets, dtype=torch.float32, device=env.device),
    )


def _numpy(tree: Any) -> Any:
    """A copy on the host: the simulation reuses its buffers."""
    return map_trees(lambda tensor: tensor.detach().cpu().numpy().copy(), tree)
