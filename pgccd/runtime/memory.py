"""Memory of devices."""

from __future__ import annotations

import torch


def is_out_of_memory(error: Exception) -> bool:
    """Whether a device had too little memory, by the error of torch or of our operators."""
    return isinstance(error, torch.OutOfMemoryError) or "out of memory: no room for" in str(error)
