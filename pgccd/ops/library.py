"""The compiled operators; no other module uses torch.ops."""

import torch

import pgccd._C as _C  # importing it registers the operators
import pgccd.ops.fake  # noqa: F401  (and this their fake kernels)

operators = torch.ops.pgccd


def take_scratch_peak() -> int:
    """Peak scratch memory in bytes of one GPU operator on this thread since the last call."""
    return _C.take_scratch_peak()
