"""Numbers of a GPU on their way to the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pgccd.runtime.events import record_event


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
        self._made = record_event() if tensor.is_cuda else None

    def numpy(self) -> NDArray[np.int64]:
        """Its values."""
        if self._made is not None:
            self._made.synchronize()
        return self._copy.numpy()
