"""Geometry, diffusion policies and their training."""
