"""Suites of runs: grids as data, executed by a pool of processes or a cluster."""
