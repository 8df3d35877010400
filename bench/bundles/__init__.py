"""Demonstrations and base policies to take away: bundles, and datasets for LeRobot.

- `contents`: which files a run, or settings, stand for.
- `card`: what is measured of a base policy, and the text about it.
- `bundle`: one zip file with a manifest; `fetch` checks and unpacks it.
- `lerobot`: demonstrations as a LeRobot dataset.
"""
