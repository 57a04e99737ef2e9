"""Asynchronous copies to the host."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd.runtime.events import record_event


class HostCopy:
    """An asynchronous copy of a tensor to the host. Reading it waits for work enqueued on the current stream before the
    copy, not for later work.

    Example:
        >>> copy = HostCopy.start(counts)
        >>> search = start_search(...)
        >>> copy.numpy()
    """

    def __init__(self, copy: Tensor, made: torch.cuda.Event | None) -> None:
        self._copy, self._made = copy, made

    @classmethod
    def start(cls, tensor: Tensor) -> HostCopy:
        """Starts the copy of an int64 tensor on any device."""
        return cls(tensor.to("cpu", non_blocking=True), record_event() if tensor.is_cuda else None)

    def numpy(self) -> NDArray[np.int64]:
        """The values. Waits for the copy."""
        if self._made is not None:
            self._made.synchronize()
        return self._copy.numpy()
