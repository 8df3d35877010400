"""Time in which base policies decode noise, beside that of their matrix products alone.

The policies are untrained, which does not change the cost, and have their default sizes; some also
have others. All take turns. Action critics decode in every update, so this is a large part of a
run's time.
"""

from __future__ import annotations

import functools
import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from symsteer.bench.throughput import new_policy
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.networks.denoiser import parameter_count
from tools.speed.timing import clock_of, in_turns, products_of, time_on

CHUNKS = (64, 192)
"""Chunks that are decoded at once: those of 64 environments, those of a batch of an update."""

VARIATIONS: Sequence[tuple[str, Mapping[str, Any]]] = (
    ("edp", {"sampling_steps": 1}),
    ("edp", {"sampling_steps": 4}),
    ("edp", {"width": 32}),
    ("edp", {"channels": 32}),
    ("edp", {"width": 32, "channels": 32}),
    ("edp", {"group": "C4"}),
    ("edp", {"group": "D8"}),
    ("spherical", {"channels": 64, "width": 64, "depth": 3}),
)
"""Policies and options that change their cost; those of the suite `policies`."""


def measure(
    task: str,
    calls: int,
    repeats: int,
    report: Callable[[str], None],
    policies: Sequence[str] = tuple(POLICIES.builtin),
    devices: Sequence[str] = ("cpu",),
) -> list[dict[str, Any]]:
    """Time the decoders of policies.

    Args:
        task: gives the layouts.
        calls: in one measurement.
        repeats: measurements of each contender.
        report: receives a line for each round, and for each policy that cannot be built here.
        policies: names.
        devices: ``cpu``, ``cuda``.

    Returns:
        A row for each device, policy and number of ``chunks``: ``device``, ``policy``, ``options``
        (those that are not the default), ``parameters``, ``sampling_steps`` (None for policies
        without them), milliseconds of one call ``median``, ``min``, ``max``, ``products``, the
        median of the matrix products alone, and ``see``, that of encoding as many observations,
        once for each decision. They are of CPU time, with a GPU of wall-clock time.
    """
    rows: list[dict[str, Any]] = []
    contenders: list[Callable[[], Any]] = []
    timed: list[tuple[str, Mapping[str, Any]]] = [(name, {}) for name in policies]
    timed += [(name, options) for name, options in VARIATIONS if name in policies]
    for device, (name, options) in itertools.product(devices, timed):
        try:
            policy = new_policy(task, name, **options).to(device)
        except UserError as error:
            report(f"without {name}: {error}")
            continue
        for chunks in CHUNKS:
            seen, noise, shown = _inputs(policy, chunks)
            decode = functools.partial(policy.decode, seen, noise)
            rows.append(
                {
                    "device": device,
                    "policy": name,
                    "options": dict(options),
                    "parameters": parameter_count(policy),
                    "sampling_steps": getattr(policy.options, "sampling_steps", None),
                    "chunks": chunks,
                }
            )
            contenders += [decode, products_of(decode), functools.partial(policy.see, shown)]
    times = in_turns(contenders, calls, repeats, report, clock_of(devices))
    for row, found, products, see in zip(rows, times[::3], times[1::3], times[2::3], strict=True):
        row |= {"median": statistics.median(found), "min": min(found), "max": max(found)}
        row |= {"products": statistics.median(products), "see": statistics.median(see)}
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Text table of :func:`measure`; ratios to the first policy with as many chunks."""
    units = {row["chunks"]: row["median"] for row in reversed(rows)}
    lines = [
        f"{time_on([row['device'] for row in rows])} of one call of decode, one thread; "
        "median of the measurements (smallest to largest), of its products alone, and of see",
        "",
        f"{'device':6s} {'policy':30s} {'parameters':>10s} {'steps':>5s} {'chunks':>6s} "
        f"{'ms':>7s} {'':18s} {'ratio':>5s} {'products':>8s} {'share':>5s} "
        f"{'see':>6s}",
    ]
    for row in rows:
        spread = f"({row['min']:.1f} to {row['max']:.1f})"
        name = " ".join(
            [row["policy"], *(f"{key} {value}" for key, value in row["options"].items())]
        )
        lines.append(
            f"{row['device']:6s} {name:30s} {row['parameters']:10,d} "
            f"{row['sampling_steps'] or '':>5} {row['chunks']:6d} {row['median']:7.2f} "
            f"{spread:18s} {row['median'] / units[row['chunks']]:5.2f} {row['products']:8.2f} "
            f"{row['products'] / row['median']:5.0%} {row['see']:6.2f}"
        )
    return "\n".join(lines)


def _inputs(policy: ChunkPolicy, chunks: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    obs = 0.1 * torch.randn(chunks, policy.obs_layout.dim, generator=generator)
    noise = torch.randn(chunks, policy.horizon, policy.act_layout.dim, generator=generator)
    shown = 0.1 * torch.rand(chunks, policy.task_layout.dim, generator=generator)
    return obs.to(policy.device), noise.to(policy.device), shown.to(policy.device)
