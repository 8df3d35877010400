"""Updates of SBX's SAC (JAX) with given sizes, run by ``tools.speed learner`` in SBX's Python.

It reads a number of updates from each line of its input, makes them one a call, and prints the CPU
seconds that they took.
"""

from __future__ import annotations

import json
import sys
import time

import gymnasium
import jax
import numpy as np
from sbx import SAC
from stable_baselines3.common.logger import Logger


def main(sizes: dict[str, int]) -> None:
    """Answer the lines of the input until it ends."""
    box = gymnasium.spaces.Box

    class Spaces(gymnasium.Env):
        observation_space = box(-np.inf, np.inf, (sizes["obs"],), np.float32)
        action_space = box(-1, 1, (sizes["noise"],), np.float32)

        def reset(self, **kwargs: object) -> tuple[np.ndarray, dict]:
            return np.zeros(sizes["obs"], np.float32), {}

    model = SAC(
        "MlpPolicy",
        Spaces(),
        batch_size=sizes["batch"],
        policy_kwargs={
            "net_arch": [sizes["width"]] * sizes["depth"],
            "n_critics": sizes["critics"],
            "layer_norm": True,
        },
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    draw = np.random.default_rng(0)
    zero = np.zeros(1, np.float32)
    for _ in range(sizes["decisions"]):
        shapes = (sizes["obs"], sizes["obs"], sizes["noise"])
        obs, following, noise = (draw.standard_normal((1, n)).astype(np.float32) for n in shapes)
        model.replay_buffer.add(obs, following, noise.clip(-1, 1), zero, zero, [{}])
    for line in sys.stdin:
        begin = time.process_time()
        for _ in range(int(line)):
            model.train(1, sizes["batch"])
        jax.block_until_ready(model.policy.qf_state.params)
        print(time.process_time() - begin, flush=True)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
