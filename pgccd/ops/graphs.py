"""Parts of a CUDA graph that a replay runs only if a value is nonzero; on GPUs only.

value: (1,) int64. body: address of a stream. See `pgccd.runtime.graph.conditional`.
"""

from torch import Tensor

from pgccd.ops.library import operator


@operator
def has_conditional_nodes(value: Tensor) -> bool:
    """Whether driver and build support conditional parts."""
    return False


@operator
def begin_conditional(value: Tensor, body: int) -> None:
    """Begins a part: work on the stream `body` is captured into it. The current stream is being captured."""
    return None


@operator
def end_conditional(value: Tensor, body: int) -> None:
    """Ends the part captured on the stream `body`."""
    return None
