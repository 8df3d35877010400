"""Parallel environments spread over processes, indistinguishable from one process to their user.

SAPIEN's step holds Python's global lock, so more cores mean more processes. `ShardedEnv` is the
user's side; `worker` what runs in each process; `block` the memory that they share; `server`
how processes are started.
"""

from symsteer.bench.sim.shards.env import ShardedEnv

__all__ = ["ShardedEnv"]
