"""A second stream for work concurrent with the current stream."""

import functools
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch

from pgccd import ops

# A search on the second stream takes a quarter of a GPU's blocks. With as many blocks as the first stream, few of which
# would have work, it would keep the first stream waiting.
_SHARE = 4


class SideStream:
    """A second, high-priority stream of a GPU, for work that other ranks may wait for and that is less than the work of
    the current stream. On a CPU, or unless wanted, everything runs in order.

    It starts after work already enqueued on the current stream. Memory allocated on it is reused by it: every use by
    the current stream precedes the next side stream, so nothing is overwritten. Memory allocated on the current stream
    and read on this one must be kept until `join`. `wait` makes it wait for later work of the current stream, marked by
    `mark`.

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
        self._entered: list[ExitStack] = []
        if wanted and device.type == "cuda":
            self._stream = _of_device(torch.cuda.current_device() if device.index is None else device.index)
            self._stream.wait_stream(torch.cuda.current_stream(device))

    @property
    def is_apart(self) -> bool:
        """Whether there is a second stream."""
        return self._stream is not None

    def __enter__(self) -> None:
        entered = ExitStack()
        if self._stream is not None:
            entered.enter_context(torch.cuda.stream(self._stream))
        self._entered.append(entered)

    def __exit__(self, *error: object) -> None:
        self._entered.pop().close()

    @contextmanager
    def sharing(self) -> Iterator[None]:
        """As the stream itself, for work that takes long: it leaves most of the GPU to the current stream."""
        with self:
            former = ops.set_device_share(_SHARE if self.is_apart else 1)
            try:
                yield
            finally:
                ops.set_device_share(former)

    def mark(self) -> torch.cuda.Event | None:
        """Marks the work enqueued on the current stream so far, for `wait`."""
        return None if self._stream is None else torch.cuda.current_stream(self._stream.device).record_event()

    def wait(self, mark: torch.cuda.Event | None) -> None:
        """Makes this stream wait for the work before a mark."""
        if self._stream is not None and mark is not None:
            self._stream.wait_event(mark)

    def join(self) -> None:
        """Makes the current stream wait for this one."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


@functools.cache
def _of_device(index: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(index, priority=-1)
