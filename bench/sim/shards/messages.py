"""How requests and answers become bytes."""

from __future__ import annotations

import copyreg
import io
import pickle
from typing import Any

import torch

from symsteer.errors import UserError


class _Pickler(pickle.Pickler):
    """Stores tensors as arrays, which is faster than torch's own way."""

    dispatch_table = copyreg.dispatch_table.copy()
    dispatch_table[torch.Tensor] = lambda tensor: (
        torch.from_numpy,
        (tensor.detach().cpu().numpy(),),
    )


def dumps(message: Any) -> memoryview:
    """A message as bytes; `pickle.loads` reads them.

    Raises:
        UserError: something in it cannot be sent.
    """
    buffer = io.BytesIO()
    try:
        _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(message)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            f"an argument of the environment cannot be sent to a worker process ({error}): "
            "pass plain data, or use workers=1"
        ) from error
    return buffer.getbuffer()
