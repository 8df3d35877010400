"""Demonstrations as ManiSkill trajectory files (`.h5` with `.json`).

- `collect(...)` runs the scripted experts and writes their successes.
- `load(...)` reads them, and ManiSkill's published ones.
"""

from symsteer.bench.demos.collect import MODES, Diversity, collect
from symsteer.bench.demos.files import FORMAT
from symsteer.bench.demos.load import Demonstrations, load

__all__ = ["FORMAT", "MODES", "Demonstrations", "Diversity", "collect", "load"]
