"""Device memory."""

import torch


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error of torch or of our operators means that a device is out of memory."""
    return isinstance(error, torch.OutOfMemoryError) or "out of memory: no room for" in str(error)


def cached_bytes() -> int:
    """Memory of the current CUDA device that torch holds for later allocations."""
    return torch.cuda.memory_reserved() - torch.cuda.memory_allocated() if torch.cuda.is_initialized() else 0


def release_cache() -> None:
    """Returns cached memory of the current CUDA device unless twice as much is free. A graph allocates from its own
    pool, about as much as is cached after a step run eagerly.
    """
    if torch.cuda.is_initialized() and torch.cuda.mem_get_info()[0] < 2 * cached_bytes():
        torch.cuda.empty_cache()


def has_room(bytes: int) -> bool:
    """Whether so much memory of the current CUDA device is free, after its cache has been returned if need be."""
    if not torch.cuda.is_initialized():
        return True
    if torch.cuda.mem_get_info()[0] < bytes:
        torch.cuda.empty_cache()
    return torch.cuda.mem_get_info()[0] >= bytes
