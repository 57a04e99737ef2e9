"""A second stream for work concurrent with the current stream."""

import functools
from contextlib import AbstractContextManager, nullcontext

import torch


class SideStream:
    """A second, high-priority stream of a GPU, for work that other ranks may wait for. On a CPU, or unless wanted,
    everything runs in order.

    It starts after work already enqueued on the current stream. Memory allocated on it is reused by it: every use by
    the current stream precedes the next side stream, so nothing is overwritten. Memory allocated on the current stream
    and read on this one must be kept until `join`.

    Args:
        device: of the tensors worked on.
        wanted: whether to use a second stream.

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
        """Whether there is a second stream."""
        return self._stream is not None

    def __enter__(self) -> None:
        self._entered = nullcontext() if self._stream is None else torch.cuda.stream(self._stream)
        self._entered.__enter__()

    def __exit__(self, *error: object) -> None:
        self._entered.__exit__(None, None, None)

    def join(self) -> None:
        """Makes the current stream wait for this one."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


@functools.cache
def _of_device(index: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(index, priority=-1)
