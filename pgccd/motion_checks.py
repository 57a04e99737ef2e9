"""What is looked for in the arguments of motions."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd import ops

# Quaternions further from unit length than this are taken for mistakes; nearer ones are normalised exactly.
UNIT_TOLERANCE = 1e-3
# Squares of larger coordinates overflow.
LARGEST_COORDINATE = 1e150
# Sine and cosine are proven up to here.
LARGEST_TURN = 1e6
# Checks of `ops.first_faults`, and their limits.
FINITE = (0, LARGEST_COORDINATE)
UNIT = (1, UNIT_TOLERANCE)
TURN = (2, LARGEST_TURN)


def broadcast_times(t: Tensor | float, count: int, device: torch.device) -> Tensor:
    """`t` as (..., count) float64."""
    time = t if isinstance(t, Tensor) else torch.tensor(t, dtype=torch.float64)
    if time.is_complex() or time.dtype == torch.bool:
        raise TypeError(f"t: expected times, got {time.dtype}")
    time = time.detach().to(device=device, dtype=torch.float64)
    try:
        shape = torch.broadcast_shapes(time.shape, (count,))
    except RuntimeError:
        shape = torch.Size()
    if shape[-1:] != (count,):
        expected = f"a number, ({count},), (T, 1) or (T, {count})"
        raise ValueError(f"t: expected {expected}, got {tuple(time.shape)}; for T times of all, pass t[:, None]")
    is_inside = ((time >= 0.0) & (time <= 1.0)).all()
    message = "t: expected times in [0, 1]"
    if time.device.type != "cpu":
        torch._assert_async(is_inside, message)
    elif not bool(is_inside):
        raise ValueError(message)
    return time.expand(shape)


class Faults:
    """What is wrong with columns of the input.

    On a CPU it raises at once. On a GPU reading the verdicts would stall the stream: they are read along with what
    `detect` waits for. A compiled graph reads nothing.
    """

    def __init__(
        self,
        columns: dict[str, tuple[Tensor, int, float]],
        row: str = "body",
        device: torch.device | None = None,
    ) -> None:
        self._names, self._row, self._count, self._are_none = list(columns), row, 0, not columns
        self._device = device
        if not columns:
            return
        values, checks, limits = zip(*columns.values(), strict=True)
        self._count = values[0].shape[0]
        self.first = ops.first_faults(values, checks, limits)
        if self.first.device.type == "cpu" and not torch.compiler.is_compiling():
            self.check()

    @functools.cached_property
    def first(self) -> Tensor:
        """(F + 1,) int64: the first faulty row of each column, or the number of rows; and whether there is any."""
        return torch.zeros(1, dtype=torch.int64, device=self._device)

    def check(self) -> None:
        if not self._are_none:
            self.raise_from(self.first.tolist())

    def raise_from(self, first: Sequence[int]) -> None:
        for name, index in zip(self._names, first, strict=False):
            if index < self._count:
                expected = f"finite numbers up to {LARGEST_COORDINATE:g}"
                if name.startswith("orientation"):
                    expected = "a unit quaternion (w, x, y, z)"
                if name in ("angular_velocity", "rotation"):
                    expected = f"a turn of at most {LARGEST_TURN:g} radians in the step"
                raise ValueError(f"{name}: {self._row} {index}: expected {expected}")
        self._are_none = True  # nobody need wait for that again
