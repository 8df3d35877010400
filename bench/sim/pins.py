"""The simulator releases that the batched CPU physics was written against."""

PINNED = {"mani-skill": "3.0.1", "sapien": "3.0.3"}
