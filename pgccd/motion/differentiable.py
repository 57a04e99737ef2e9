"""Paths as expressions of torch, for gradients. Values come from the operators, derivatives from the expressions."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

# Squares of angles below which sine and cosine are replaced by series, whose next terms are below rounding.
_SMALL_SQUARE = 1e-8


class _Valued(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, expression: Tensor, name: str) -> Tensor:
        ctx.name = name
        return value.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        if torch.is_grad_enabled():
            raise NotImplementedError(
                f"{ctx.name}: has first derivatives only, but second derivatives were requested (create_graph=True)"
            )
        return None, gradient, None


def with_gradient_of(value: Tensor, expression: Tensor, name: str) -> Tensor:
    """`value`, bit by bit, with the gradient of `expression`, of the same shape. The error for second derivatives names
    `name`.
    """
    return _Valued.apply(value.detach(), expression.to(value.dtype), name)


class _Rows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.count = len(values)
        return values[index]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Any:
        (index,) = ctx.saved_tensors
        return sum_by_row(gradient.flatten(0, index.dim() - 1), index.reshape(-1), ctx.count), None


def rows_of(values: Tensor, index: Tensor) -> Tensor:
    """`values[index]`, of (N, ...) values; the gradient is summed in the order of `index`, also on a GPU."""
    return _Rows.apply(values, index) if values.requires_grad else values[index]


def sum_by_row(terms: Tensor, row: Tensor, count: int) -> Tensor:
    """(count, ...): for each row the sum of the terms (M, ...) that belong to it, by `row` (M,), in their order."""
    if terms.device.type == "cpu":  # one after the other
        return terms.new_zeros((count, *terms.shape[1:])).index_add_(0, row, terms)
    return sum_sorted(terms, row, count)  # there, index_add_ adds in any order


def sum_sorted(terms: Tensor, row: Tensor, count: int) -> Tensor:
    """As `sum_by_row`, by sorting."""
    if len(terms) == 0:
        return terms.new_zeros((count, *terms.shape[1:]))
    ordered, order = torch.sort(row, stable=True)
    begin = torch.searchsorted(ordered, torch.arange(count + 1, device=row.device))
    return torch.segment_reduce(terms[order], "sum", offsets=begin, axis=0, unsafe=True, initial=0.0)


def turned(vectors: Tensor, rotation: Tensor) -> Tensor:
    """Vectors (..., 3) turned by rotation vectors (..., 3), radians. Differentiable at zero too."""
    square = (rotation * rotation).sum(-1, keepdim=True)
    is_small = square < _SMALL_SQUARE
    angle = torch.where(is_small, 1.0, square).sqrt()
    sine = torch.where(is_small, 1.0 - square / 6.0, angle.sin() / angle)
    # (1 - cos) / angle^2, without cancellation
    half = (0.5 * angle).sin() / angle
    cosine = torch.where(is_small, 0.5 - square / 24.0, 2.0 * half * half)
    once = torch.linalg.cross(rotation, vectors)
    return vectors + sine * once + cosine * torch.linalg.cross(rotation, once)


def oriented(vectors: Tensor, orientation: Tensor) -> Tensor:
    """Vectors (..., 3) from body to world, by quaternions (..., 4), which are normalised."""
    scalar, vector = (orientation / orientation.norm(dim=-1, keepdim=True)).split((1, 3), dim=-1)
    twice = 2.0 * torch.linalg.cross(vector.expand_as(vectors), vectors)
    return vectors + scalar * twice + torch.linalg.cross(vector.expand_as(vectors), twice)


def product(one: Tensor, other: Tensor) -> Tensor:
    """Products of quaternions (..., 4): the other one is applied first."""
    a, u = one.split((1, 3), dim=-1)
    b, v = other.split((1, 3), dim=-1)
    scalar = a * b - (u * v).sum(-1, keepdim=True)
    return torch.cat([scalar, a * v + b * u + torch.linalg.cross(u, v)], dim=-1)


def quaternion_of(rotation: Tensor) -> Tensor:
    """Quaternions (..., 4) of rotation vectors (..., 3). Differentiable at zero too."""
    square = (rotation * rotation).sum(-1, keepdim=True)
    is_small = square < _SMALL_SQUARE
    angle = torch.where(is_small, 1.0, square).sqrt()
    sine = torch.where(is_small, 0.5 - square / 48.0, (0.5 * angle).sin() / angle)
    cosine = torch.where(is_small, 1.0 - square / 8.0, (0.5 * angle).cos())
    return torch.cat([cosine, sine * rotation], dim=-1)


def rotation_between(orientation_t0: Tensor, orientation_t1: Tensor) -> Tensor:
    """Rotation vectors (N, 3) from one orientation (N, 4) to the other, the shorter way."""
    start, end = (q / q.norm(dim=-1, keepdim=True) for q in (orientation_t0, orientation_t1))
    between = product(end, torch.cat([start[:, :1], -start[:, 1:]], dim=1))
    between = torch.where(between[:, :1] < 0.0, -between, between)
    cosine, vector = between.split((1, 3), dim=1)
    square = (vector * vector).sum(-1, keepdim=True)
    is_small = square < _SMALL_SQUARE
    sine = torch.where(is_small, 1.0, square).sqrt()
    # A half turn has the cosine 0. No term may be infinite, even one that is not chosen.
    long = torch.where(is_small, cosine, 1.0)
    factor = torch.where(
        is_small, (2.0 - 2.0 * square / (3.0 * long * long)) / long, 2.0 * torch.atan2(sine, cosine) / sine
    )
    return factor * vector


def pose_at(
    position_t0: Tensor, position_t1: Tensor, orientation_t0: Tensor, rotation: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions (..., 3) and orientations (..., 4) at times (...), of columns (..., width)."""
    fraction = time[..., None]
    start = orientation_t0 / orientation_t0.norm(dim=-1, keepdim=True)
    return position_t0 + fraction * (position_t1 - position_t0), product(quaternion_of(fraction * rotation), start)


def any_differentiated(*values: Tensor | float | None) -> bool:
    """Whether any of the values requires grad while gradients are enabled."""
    for value in values:
        if isinstance(value, Tensor) and value.requires_grad:
            return torch.is_grad_enabled()
    return False
