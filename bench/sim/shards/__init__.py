"""Worker processes that hold a part of the parallel environments each.

SAPIEN's step holds Python's global lock, so using more cores takes more processes. `processes`
starts them, `workers` is the caller's side (requests and their answers), `worker` runs in each of
them. `symsteer.bench.sim.parallel` makes one environment of them.
"""
