"""Device memory."""

import torch


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error of torch or of our operators means that a device is out of memory."""
    return isinstance(error, torch.OutOfMemoryError) or "out of memory: no room for" in str(error)
