"""Columns of a scene from user input: checked, converted to the operators' dtypes, and moved to the scene's device."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments


def require_meshes(mesh_index: Tensor, count: int) -> None:
    """Raises ValueError unless every value (N,) is in [0, count)."""
    if len(mesh_index):
        low, high = (int(x) for x in torch.aminmax(mesh_index))
        if low < 0 or high >= count:
            raise ValueError(f"mesh_index: values in [{low}, {high}], but there are {count} meshes")


def _column(values: Any, name: str, expected: str) -> Tensor:
    """The values as a tensor of one dimension."""
    try:
        column = torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(
            f"{name}: expected {expected}, one per body, got {arguments.describe(values)}: {error}"
        ) from error
    if column.dim() != 1:
        raise ValueError(f"{name}: expected {expected}, shape (N,), got {arguments.describe(column)}")
    return column


def integer_column(values: Tensor | Sequence[int], name: str, count: int | None, device: torch.device) -> Tensor:
    """Integers, one per body, as (N,) int64 on the device; `count` of them, if given."""
    column = _column(values, name, "integers")
    if column.numel() == 0:
        column = column.to(torch.int64)
    if column.dtype.is_floating_point or column.dtype.is_complex or column.dtype == torch.bool:
        raise TypeError(f"{name}: expected integers, got {column.dtype}")
    if count is not None and len(column) != count:
        raise ValueError(f"{name}: expected {count} values, one per body, got {len(column)}")
    return column.to(device=device, dtype=torch.int64).contiguous()


def world_column(values: Tensor | Sequence[int], count: int, device: torch.device) -> Tensor:
    """Worlds as (count,) int32 on the device."""
    column = integer_column(values, "world", count, device)
    if count and (int(column.min()) < 0 or int(column.max()) >= 2**31):
        raise ValueError("world: ids must lie in [0, 2^31)")
    return column.to(torch.int32)


def bool_column(values: Tensor | Sequence[bool], name: str, count: int, device: torch.device) -> Tensor:
    """Flags as (count,) uint8 on the device."""
    column = _column(values, name, "bool")
    if column.numel() and column.dtype != torch.bool:
        raise TypeError(f"{name}: expected bool, got {column.dtype}")
    if column.shape != (count,):
        raise ValueError(f"{name}: expected shape ({count},), got {tuple(column.shape)}")
    return column.to(device=device, dtype=torch.uint8).contiguous()


def margin_column(values: Tensor | Sequence[float] | float, count: int, device: torch.device) -> Tensor:
    """Lengths >= 0, a single one or one per body, as (count,) float64 on the device."""
    try:
        column = torch.as_tensor(values)
        is_meta = column.is_meta
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(f"margin: expected lengths, got {arguments.describe(values)}") from error
    if is_meta or column.is_complex() or column.dtype in (torch.bool, torch.float16, torch.bfloat16):
        raise TypeError(f"margin: expected lengths, got {column.dtype}")
    arguments.refuse_gradient(column, "margin")
    column = column.detach().to(device=device, dtype=torch.float64)
    if column.dim() == 0:
        column = column.expand(count)
    if column.shape != (count,):
        raise ValueError(f"margin: expected a number or shape ({count},), got {tuple(column.shape)}")
    if count:
        faulty = ~((column >= 0.0) & (column < torch.inf))
        if bool(faulty.any()):
            body = int(faulty.long().argmax())
            raise ValueError(f"margin: body {body}: expected a finite length >= 0, got {float(column[body])}")
    return column.contiguous()


def self_column(values: Tensor | Sequence[bool] | bool, count: int, device: torch.device) -> Tensor | None:
    """Flags, a single one or one per body, as (count,) bool on the device; None for False."""
    if isinstance(values, bool):
        return torch.ones(count, dtype=torch.bool, device=device) if values else None
    return bool_column(values, "self_collision", count, device).to(torch.bool)
