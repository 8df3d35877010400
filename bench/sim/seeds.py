"""Which environments a reset is for, and their seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils import common

from symsteer.errors import UserError


def reset_order(
    seed: Any, env_idx: Any, num_envs: int
) -> tuple[torch.Tensor | None, list[int] | None]:
    """The environments to reset in ascending order, as ManiSkill writes them, and a seed of each.

    Args:
        seed: None, one for each in the order of ``env_idx``, or one integer, which is expanded
            as ManiSkill does.
        env_idx: the environments; None for all of them.
        num_envs: how many there are.

    Raises:
        UserError: ``env_idx`` names environments that are not there, or one of them twice, or the
            number of seeds is neither 1 nor that of the environments.
    """
    index = order = None
    if env_idx is not None:
        rows = np.atleast_1d(common.to_numpy(env_idx))
        if (
            rows.dtype == bool
            or not np.isin(rows, range(num_envs)).all()
            or len({*rows.tolist()}) < len(rows)
        ):
            raise UserError(
                f"env_idx lists environments by number, each once, from 0 to {num_envs - 1}; it "
                f"is {rows.tolist()}"
            )
        index, order = torch.as_tensor(rows, dtype=torch.long).sort()
    if seed is None:
        return index, None
    seeds = [int(s) for s in np.atleast_1d(common.to_numpy(seed))]
    count = num_envs if index is None else len(index)
    if len(seeds) not in (1, count):
        raise UserError(f"{len(seeds)} seeds were given for {count} environments; give one each")
    if order is not None and len(seeds) == count:
        return index, [seeds[i] for i in order.tolist()]
    return index, seeds + np.random.RandomState(seeds[0]).randint(
        2**31, size=count - len(seeds)
    ).tolist()
