"""Work of a GPU beside that which the current stream has been given."""

from __future__ import annotations

import functools
from contextlib import AbstractContextManager, nullcontext

import torch


class SideStream:
    """A second stream of a GPU, which first does what may hold up others. Elsewhere, and unless wanted, it is none:
    everything is done in order.

    It starts after work already enqueued on the current stream when it is made. Memory allocated on it goes back to it:
    as every use of that by the current stream comes before the next side stream is made, nothing is overwritten. What
    the current stream has allocated and this one reads must stay until `join`.

    Args:
        device: of the tensors worked on.
        wanted: whether there should be one.

    Example:
        >>> side = SideStream(device)
        >>> with side:
        ...     ghosts = halo.wait()
        >>> side.join()
    """

    def __init__(self, device: torch.device, wanted: bool = True) -> None:
        self._stream: torch.cuda.Stream | None = None
        self._entered: AbstractContextManager[object] = nullcontext()
        if wanted and device.type == "cuda":
            self._stream = _of_device(torch.cuda.current_device() if device.index is None else device.index)
            self._stream.wait_stream(torch.cuda.current_stream(device))

    @property
    def is_apart(self) -> bool:
        """Whether there is one."""
        return self._stream is not None

    def __enter__(self) -> None:
        self._entered = nullcontext() if self._stream is None else torch.cuda.stream(self._stream)
        self._entered.__enter__()

    def __exit__(self, *error: object) -> None:
        self._entered.__exit__(None, None, None)

    def join(self) -> None:
        """Lets the current stream go on after all that this one has been given."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


@functools.cache
def _of_device(index: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(index, priority=-1)
