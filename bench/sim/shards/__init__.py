"""Parallel environments divided among processes, with the interface of one process.

SAPIEN's step holds Python's global lock, so using more cores takes more processes. `env` is the
caller's side, `worker` runs in each process, `messages` is what they send to each other, `block`
the memory that they share, and `processes` starts the workers.
"""

from symsteer.bench.sim.shards.env import ShardedEnv

__all__ = ["ShardedEnv"]
