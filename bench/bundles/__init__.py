"""Demonstrations and base policies to take away: bundles, and datasets for LeRobot.

- `bundle`: one zip file with a manifest and a card, which says what the policy can do.
- `fetch`: the manifest; checking and unpacking such a file.
- `lerobot`: demonstrations as a LeRobot dataset; `film`: its video.
"""
