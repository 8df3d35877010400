"""Captions on pictures."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

HEIGHT = 26
"""Height of a caption, pixels."""


def captioned(
    picture: np.ndarray, text: str, colour: str = "black", ground: str = "white"
) -> np.ndarray:
    """A picture ``[height, width, 3]`` below a line of text, ``[HEIGHT + height, width, 3]``."""
    bar = Image.new("RGB", (picture.shape[1], HEIGHT), ground)
    font = ImageFont.load_default(15)
    ImageDraw.Draw(bar).text((8, HEIGHT / 2), text, fill=colour, font=font, anchor="lm")
    return np.concatenate([np.asarray(bar), picture])
