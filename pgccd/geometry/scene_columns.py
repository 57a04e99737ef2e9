"""Columns of a scene from user input: checked, converted to the operators' dtypes, and moved to the scene's device."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments


def mesh_expected(count: int) -> str:
    """The values of `mesh_index` in words."""
    return f"a mesh from 0 to {count - 1} (of {count} meshes)"


def require_meshes(mesh_index: Tensor, count: int) -> None:
    """Raises ValueError unless every value (N,) is in [0, count)."""
    _require((mesh_index >= 0) & (mesh_index < count), mesh_index, "mesh_index", mesh_expected(count))


def require_worlds(world: Tensor) -> None:
    """Raises ValueError unless every value (N,) is a world."""
    _require((world >= 0) & (world <= 2**31 - 1), world, "world", "an id in [0, 2^31)")


def require_margins(margin: Tensor) -> None:
    """Raises ValueError unless every value (N,) is a length."""
    _require((margin >= 0.0) & (margin <= arguments.LONGEST), margin, "margin", arguments.LENGTH)


def _require(sound: Tensor, values: Tensor, name: str, expected: str) -> None:
    if not bool(sound.all()):
        body = int((~sound).long().argmax())
        raise ValueError(f"{name}: body {body}: expected {expected}, got {values[body].item()}")


def _column(values: Any, name: str, expected: str) -> Tensor:
    """The values as a tensor of one dimension."""
    try:
        column = torch.as_tensor(arguments.as_tensor(values, name))
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
    require_worlds(column)
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
    column = arguments.real_numbers(values, "margin", "a length, or one per body", with_gradient=True).to(device)
    if column.dim() == 0:
        column = column.expand(count)
    if column.shape != (count,):
        raise ValueError(f"margin: expected a number or shape ({count},), got {tuple(column.shape)}")
    require_margins(column)
    return column.contiguous()


def pairs_never_tested(values: Tensor | Sequence[Sequence[int]], count: int | None, device: torch.device) -> Tensor:
    """Pairs of different bodies, in any order, as (E, 2) int64 on the device: i < j, sorted, each once.

    Args:
        count: number of bodies; None: bodies are named by ids >= 0.
    """
    expected = "pairs of different bodies, shape (E, 2)"
    try:
        pairs = torch.as_tensor(arguments.as_tensor(values, "exclude"))
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(f"exclude: expected {expected}, got {arguments.describe(values)}: {error}") from error
    arguments.refuse_meta(pairs, "exclude")
    if pairs.layout != torch.strided:
        raise TypeError(f"exclude: expected a dense tensor, got {pairs.layout}")
    if pairs.numel() == 0:
        pairs = pairs.to(torch.int64).reshape(-1, 2)
    if pairs.dtype.is_floating_point or pairs.dtype.is_complex or pairs.dtype == torch.bool:
        raise TypeError(f"exclude: expected integers, {expected}, got {pairs.dtype}")
    if pairs.dim() != 2 or pairs.shape[1] != 2:
        raise ValueError(f"exclude: expected {expected}, got shape {tuple(pairs.shape)}")
    pairs = pairs.to(device=device, dtype=torch.int64)
    among = f"bodies from 0 to {count - 1}" if count is not None else "ids >= 0"
    sound = (pairs >= 0).all(dim=1) & (pairs[:, 0] != pairs[:, 1])
    sound &= (pairs < (2**63 - 1 if count is None else count)).all(dim=1)
    if not bool(sound.all()):
        row = int((~sound).long().argmax())
        hint = "; a body is tested against itself only with self_collision" if pairs[row].unique().numel() == 1 else ""
        raise ValueError(f"exclude: pair {row}: expected two different {among}, got {pairs[row].tolist()}{hint}")
    return torch.unique(pairs.sort(dim=1).values, dim=0)


def self_column(values: Tensor | Sequence[bool] | bool, count: int, device: torch.device) -> Tensor | None:
    """Flags, a single one or one per body, as (count,) bool on the device; None for False."""
    if isinstance(values, bool):
        return torch.ones(count, dtype=torch.bool, device=device) if values else None
    return bool_column(values, "self_collision", count, device).to(torch.bool)


def sum_of_margins(own: Tensor, of_scene: Tensor | None) -> Tensor:
    """(N,): sums of margins (N,) and of those of the scene, if any, rounded up."""
    if of_scene is None:
        return own.contiguous()
    total = own + of_scene
    is_exact = (own == 0.0) | (of_scene == 0.0)
    plain = total.detach()
    rounded = torch.where(is_exact, plain, torch.nextafter(plain, torch.full_like(plain, torch.inf)))
    return total + (rounded - plain)  # exact, with the gradient of the sum
