"""Simulation, tasks, symmetry breaking, runs and the command line."""

from symsteer.bench.sim.headless import silence_import_noise

# Before anything imports SAPIEN or escnn, which warn about drivers that state-only runs lack.
silence_import_noise()
