"""Device memory."""

import torch


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error of torch or of our operators means that a device is out of memory."""
    return isinstance(error, torch.OutOfMemoryError) or "out of memory: no room for" in str(error)


def release_cache() -> None:
    """Returns cached memory of the current CUDA device unless twice as much is free. A graph allocates from its own
    pool, about as much as is cached after a step run eagerly.
    """
    cached = torch.cuda.memory_reserved() - torch.cuda.memory_allocated()
    if torch.cuda.mem_get_info()[0] < 2 * cached:
        torch.cuda.empty_cache()
