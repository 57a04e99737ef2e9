"""The compiled operators: the only place that names them."""

import torch

import pgccd._C as _C  # (importing it registers the operators)
import pgccd.ops.fake  # noqa: F401  (and this their fake kernels)

operators = torch.ops.pgccd


def take_scratch_peak() -> int:
    """Most bytes of scratch memory that one operator on a GPU has held for this thread since the last call."""
    return _C.take_scratch_peak()
