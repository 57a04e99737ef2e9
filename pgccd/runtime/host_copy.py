"""Numbers of a GPU on their way to the host."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd.runtime.events import record_event


class HostCopy:
    """A copy of a tensor that the host reads later: then it waits for what the current stream has been given so far,
    not for what it is given meanwhile.

    Example:
        >>> copy = HostCopy.start(counts)
        >>> search = start_search(...)
        >>> copy.numpy()
    """

    def __init__(self, copy: Tensor, made: torch.cuda.Event | None) -> None:
        self._copy, self._made = copy, made

    @classmethod
    def start(cls, tensor: Tensor) -> HostCopy:
        """Starts to copy a tensor, int64 on any device."""
        return cls(tensor.to("cpu", non_blocking=True), record_event() if tensor.is_cuda else None)

    def numpy(self) -> NDArray[np.int64]:
        """Its values."""
        if self._made is not None:
            self._made.synchronize()
        return self._copy.numpy()
