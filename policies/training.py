"""Training of base policies from demonstrations."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import torch

from symsteer.errors import UserError
from symsteer.policies.base import ChunkPolicy, PolicyConfig
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.normalizer import Normalizer, clip_blocks

Episode = tuple[torch.Tensor, torch.Tensor]
Progress = Callable[[int, int, float], None]

RECORDED_POINTS = 100


def make_chunks(
    episodes: Sequence[Episode], act_layout: Layout, horizon: int, hold: Sequence[str] = ()
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cut episodes into (observation, action chunk) pairs, one for every step.

    A chunk that runs past its episode's end is filled with actions that do nothing: zero, except
    for the fields in ``hold``, which keep their last value (a gripper's absolute target). Names in
    ``hold`` that the layout lacks are passed over.

    Args:
        episodes: pairs of ``obs [T + 1, obs_dim]`` (or ``[T, obs_dim]``) and
            ``actions [T, act_dim]``.

    Returns:
        ``obs [M, obs_dim]`` and ``chunks [M, horizon, act_dim]``, float32.
    """
    held = torch.zeros(act_layout.dim)
    for field in act_layout.fields:
        if field.name in hold:
            held[act_layout.slice(field.name)] = 1.0
    observations, chunks = [], []
    for obs, actions in episodes:
        obs, actions = obs.float(), actions.float()
        steps = len(actions)
        padding = (actions[-1] * held).expand(horizon - 1, -1)
        padded = torch.cat([actions, padding])
        observations.append(obs[:steps])
        chunks.append(padded.unfold(0, horizon, 1).transpose(1, 2))
    return torch.cat(observations), torch.cat(chunks)


class Augmentation:
    """Random planar symmetries, one per row, applied to several vectors alike.

    Args:
        group: a finite group (its elements are drawn) or SO(2) (any angle).
    """

    def __init__(self, group: Group):
        self.group = group

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """``[count]`` element indices, or angles for SO(2)."""
        device = generator.device
        if self.group.rotations == 0:
            return 2 * math.pi * torch.rand(count, generator=generator, device=device)
        return torch.randint(self.group.order, (count,), generator=generator, device=device)

    def apply(self, drawn: torch.Tensor, x: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Turn row i of ``x [count, ..., dim]`` by ``drawn[i]``."""
        if self.group.rotations == 0:
            # A quarter turn of each block, and how fast it turns: x cos(k a) + J x sin(k a).
            rates = torch.cat([torch.full((f.dim,), float(f.frequency)) for f in layout.fields]).to(
                x
            )
            quarter = _quarter_turn(layout).to(x)
            phase = drawn.to(x).view(-1, *(1,) * (x.dim() - 1)) * rates
            return x * phase.cos() + (x @ quarter.T) * phase.sin()
        rho = self.group.representation(layout, x.dtype, x.device)[drawn]
        return torch.einsum("bij,b...j->b...i", rho, x)


def _quarter_turn(layout: Layout) -> torch.Tensor:
    blocks = [
        torch.zeros(1, 1) if f.frequency == 0 else torch.tensor([[0.0, -1.0], [1.0, 0.0]])
        for f in layout.fields
        for _ in range(f.multiplicity)
    ]
    return torch.block_diag(*blocks)


def train_policy(
    config: PolicyConfig,
    episodes: Sequence[Episode],
    obs_layout: Layout,
    act_layout: Layout,
    seed: int = 0,
    progress: Progress | None = None,
    device: torch.device | str = "cpu",
) -> ChunkPolicy:
    """Train a base policy on demonstrations.

    AdamW with linear warm-up and cosine decay, batches of chunks drawn with replacement, the
    denoising loss at uniformly drawn noise levels, an exponential average of the weights. On the
    CPU the result is a function of arguments and number of threads alone.

    Args:
        config: see :class:`PolicyConfig`.
        episodes: pairs ``(obs [T + 1, obs_dim], actions [T, act_dim])``, environment units.
        obs_layout: geometry of an observation.
        act_layout: geometry of an action.
        seed: of initialisation, batches and noise.
        progress: called about 100 times as ``progress(step, steps, loss)``.
        device: where to train; the policy stays there.

    Returns:
        The frozen policy; its ``training_record`` holds losses, seconds and sizes.

    Raises:
        UserError: if there are no episodes or their shapes do not fit the layouts.
    """
    _check_episodes(episodes, obs_layout, act_layout)
    start = time.perf_counter()
    config = config.resolved(obs_layout, act_layout)
    obs, chunks = make_chunks(episodes, act_layout, config.horizon, config.hold)
    # The environment bounds actions block by block: train on what it executes.
    chunks = clip_blocks(chunks, act_layout, 1.0)
    # CPU draws, so that a seed means the same on every device.
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = ChunkPolicy(
            config,
            obs_layout,
            act_layout,
            Normalizer.fit(obs_layout, obs),
            Normalizer.fit(act_layout, chunks),
        )
    policy.to(device)
    obs, chunks = obs.to(device), policy.act_normalizer.normalize(chunks.to(device))

    network = policy.denoiser
    average = [p.detach().clone() for p in network.parameters()]
    network.requires_grad_(True).train()
    parameters: list[torch.Tensor] = list(network.parameters())
    optimizer = torch.optim.AdamW(
        parameters,
        lr=config.learning_rate,
        betas=(0.95, 0.999),
        weight_decay=config.weight_decay,
        fused=True,
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step, config))
    augmentation = (
        Augmentation(Group.parse(config.augmentation)) if config.name == "plain-augmented" else None
    )
    every = max(1, config.steps // RECORDED_POINTS)
    losses: list[tuple[int, float]] = []
    running = torch.zeros((), device=device)
    for step in range(1, config.steps + 1):
        rows = torch.randint(len(obs), (config.batch_size,), generator=generator)
        levels = torch.randint(
            config.diffusion_steps, (config.batch_size,), generator=generator
        ).to(device)
        noise = torch.randn(
            config.batch_size, config.horizon, act_layout.dim, generator=generator
        ).to(device)
        batch_obs, batch_chunks = obs[rows.to(device)], chunks[rows.to(device)]
        if augmentation is not None:
            turns = augmentation.draw(config.batch_size, generator).to(device)
            batch_obs = augmentation.apply(turns, batch_obs, obs_layout)
            batch_chunks = augmentation.apply(turns, batch_chunks, act_layout)
        noisy = policy.diffusion.add_noise(batch_chunks, noise, levels)
        condition = network.encode(policy.normalized_observation(batch_obs))
        output = network(noisy, condition + network.encode_time(levels))
        loss = policy.diffusion.loss(output, batch_chunks, noise, levels)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        decay = min(config.ema_decay, (1 + step) / (10 + step))
        with torch.no_grad():
            torch._foreach_lerp_(average, parameters, 1 - decay)
            running += loss
        if step % every == 0 or step == config.steps:
            count = step - (losses[-1][0] if losses else 0)
            losses.append((step, float(running) / count))
            running.zero_()
            if progress is not None:
                progress(step, config.steps, losses[-1][1])
    with torch.no_grad():
        for parameter, value in zip(parameters, average, strict=True):
            parameter.copy_(value)
    policy.training_record = {
        "seed": seed,
        "episodes": len(episodes),
        "chunks": len(obs),
        "steps": config.steps,
        "losses": losses,
        "seconds": time.perf_counter() - start,
        "threads": torch.get_num_threads(),
        "device": str(device),
        "parameters": policy.parameter_count(),
    }
    return policy.freeze()


def _rate(step: int, config: PolicyConfig) -> float:
    """Learning-rate factor at a step: linear warm-up, then half a cosine to zero."""
    if step < config.warmup_steps:
        return (step + 1) / config.warmup_steps
    done = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))


def _check_episodes(episodes: Sequence[Episode], obs_layout: Layout, act_layout: Layout) -> None:
    if not episodes:
        raise UserError("no demonstrations to train on; record some first")
    for number, (obs, actions) in enumerate(episodes):
        if (
            obs.dim() != 2
            or actions.dim() != 2
            or obs.shape[1] != obs_layout.dim
            or actions.shape[1] != act_layout.dim
            or not 1 <= len(actions) <= len(obs)
        ):
            raise UserError(
                f"demonstration {number} has observations {tuple(obs.shape)} and actions "
                f"{tuple(actions.shape)}; needed are [T + 1, {obs_layout.dim}] and "
                f"[T, {act_layout.dim}] with T >= 1"
            )
