"""Arithmetic with the same bits on every device."""

import numpy as np
import torch
from torch import Tensor


def square_root(values: Tensor) -> Tensor:
    """Correctly rounded roots of float64 values >= 0. On a CPU `Tensor.sqrt` may be wrong in the last digit."""
    if values.device.type != "cpu" or values.requires_grad or torch.compiler.is_compiling():
        return values.sqrt()
    return torch.from_numpy(np.asarray(np.sqrt(values.numpy())))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Products of vectors (..., n), added in order."""
    total, *others = (a * b).unbind(-1)
    for product in others:
        total = total + product
    return total


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Products of vectors (..., 3)."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(-1), b.unbind(-1)
    first = torch.stack([a1 * b2, a2 * b0, a0 * b1], -1)
    return first - torch.stack([a2 * b1, a0 * b2, a1 * b0], -1)


def norm(a: Tensor) -> Tensor:
    """Lengths of vectors (..., n)."""
    return square_root(dot(a, a))


def unit_or_zero(a: Tensor) -> Tensor:
    """Vectors (..., n) divided by their lengths; zero vectors stay."""
    length = norm(a)[..., None]
    return torch.where(length > 0.0, a / torch.where(length > 0.0, length, 1.0), 0.0)
