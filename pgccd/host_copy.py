"""Numbers of a GPU on their way to the host."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class HostCopy:
    """A copy of a tensor that the host reads later: then it waits for what the current stream has been given so far,
    not for what it is given meanwhile.

    Args:
        tensor: int64, on any device.

    Example:
        >>> copy = HostCopy(counts)
        >>> search = start_search(...)
        >>> copy.numpy()
    """

    def __init__(self, tensor: Tensor) -> None:
        self._copy = tensor.to("cpu", non_blocking=True)
        self._made: torch.cuda.Event | None = None
        if tensor.is_cuda:
            self._made = torch.cuda.Event()
            self._made.record()

    def numpy(self) -> NDArray[np.int64]:
        """Its values."""
        if self._made is not None:
            self._made.synchronize()
        return self._copy.numpy()
