"""Suites of runs: grids as data, worked off by a pool of processes."""
