"""The checksum of a demonstration file: it joins our .h5 to its .json, bit by bit."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import h5py
import numpy as np

SEAL = "sha256"
"""Attribute of the .h5 file that holds the checksum."""


def checksum(file: h5py.File, description: dict[str, Any]) -> str:
    """SHA-256 over every array of the file and the content of its .json."""
    found = hashlib.sha256(json.dumps(description, sort_keys=True).encode())

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            array = np.asarray(item)
            found.update(f"{name} {array.dtype} {array.shape}".encode())
            found.update(array.tobytes())

    file.visititems(add)
    return found.hexdigest()
