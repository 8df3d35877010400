"""Simulation, tasks, symmetry breaking, runs and the command line."""
