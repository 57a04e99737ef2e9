"""Values between ranks, as JSON: a pickle from another process can execute code when it is read."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor

# Longer values are rejected: a rank reserves memory for what others announce.
_MOST_BYTES = 1 << 28


class Objects:
    """Exchange of small values with rank 0. This class is for one rank; every method must be called by all ranks, in
    the same order.

    Values are what JSON can represent; all ranks get equal copies, in which tuples are lists.
    """

    def gather(self, value: Any) -> list[Any]:
        """The values of all ranks on rank 0; an empty list on the others."""
        return [decode(encode(value))]

    def broadcast(self, value: Any) -> Any:
        """Rank 0's value."""
        return decode(encode(value))


def encode(value: Any) -> Tensor:
    """(bytes,) uint8: a value as JSON.

    Raises:
        TypeError, ValueError: JSON cannot represent it.
    """
    return torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)


def decode(received: Tensor) -> Any:
    """The value of `encode`.

    Raises:
        RuntimeError: this is no JSON.
    """
    try:
        return json.loads(received.cpu().numpy().tobytes())
    except (ValueError, RecursionError) as error:
        raise RuntimeError(f"a rank has sent what is no JSON: {error}") from error


def require_sizes(sizes: Tensor) -> list[int]:
    """The numbers of bytes that ranks announce.

    Raises:
        RuntimeError: one is not plausible.
    """
    announced: list[int] = sizes.tolist()
    for size in announced:
        if not 0 < size <= _MOST_BYTES:
            raise RuntimeError(f"a rank announces a value of {size} bytes; at most {_MOST_BYTES} can be sent")
    return announced
