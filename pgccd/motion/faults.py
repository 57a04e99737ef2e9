"""Invalid numbers in motions: `ops.first_faults` finds them; errors name the column and the row."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.geometry.mesh import LARGEST_RADIUS, SMALLEST_RADIUS

# Maximum deviation of a quaternion from unit length; smaller deviations are normalised.
UNIT_TOLERANCE = 1e-3
# Squares of larger coordinates overflow.
LARGEST_COORDINATE = 1e150
# Error bounds of sine and cosine are proven up to this angle.
_LARGEST_TURN = 1e6
# Checks of `ops.first_faults`, their limits, and the expected values.
_FINITE = (0, LARGEST_COORDINATE, f"finite numbers up to {LARGEST_COORDINATE:g}")
_UNIT = (1, UNIT_TOLERANCE, "a unit quaternion (w, x, y, z)")
_TURN = (2, _LARGEST_TURN, f"a turn of at most {_LARGEST_TURN:g} radians in the step")
_CHECKS = {
    "orientation": _UNIT,
    "orientation_t0": _UNIT,
    "orientation_t1": _UNIT,
    "rotation": _TURN,
    "angular_velocity": _TURN,
}


def first_faults(columns: Mapping[str, Tensor]) -> Tensor:
    """(F + 1,) int64 on the columns' device: the first faulty row of each of the F columns, or the number of rows; then
    1 if any row is faulty, else 0. Does not synchronise.
    """
    return ops.first_faults(list(columns.values()), *checks_of(columns))


def checks_of(names: Iterable[str]) -> tuple[list[int], list[float]]:
    """The `checks` and `limits` of `ops.first_faults` for columns of these names."""
    checks = [_CHECKS.get(name, _FINITE) for name in names]
    return [check[0] for check in checks], [check[1] for check in checks]


def expected(name: str) -> str:
    """The values that a column of this name should have."""
    return _CHECKS.get(name, _FINITE)[2]


def joined(first: Tensor | None, more: Tensor) -> Tensor:
    """The `first_faults` of two sets of columns, combined."""
    if first is None:
        return more
    return torch.cat([first[:-1], more[:-1], torch.maximum(first[-1:], more[-1:])])


@dataclass
class Faults:
    """The meaning of the values of `first_faults`.

    Args:
        names: of the columns.
        row: the meaning of a row, "body" or "vertex".
        count: number of rows.
        sources: by name of a column, the argument it is computed from.
        radius: (N,) SBV radii of deforming bodies, whose check then precedes those of the columns.
    """

    names: tuple[str, ...]
    row: str
    count: int
    sources: Mapping[str, str]
    radius: Tensor | None = None

    def raise_from(self, first: Sequence[int], later: bool = False) -> None:
        """Raises ValueError for the first fault, if there is one.

        Args:
            first: values of `first_faults`.
            later: whether columns may hold other values by now; the message then states none.
        """
        of_columns = first if self.radius is None else first[1:]
        for name, index in zip(self.names, of_columns, strict=False):
            if index < self.count:
                source = f" (it follows from {self.sources[name]})" if name in self.sources else ""
                raise ValueError(f"{name}: {self.row} {index}: expected {expected(name)}{source}")
        if self.radius is not None and first[0] < len(self.radius):
            radius = "an SBV radius" if later else f"SBV radius {float(self.radius[first[0]]):g}"
            limits = f"it must lie in [{SMALLEST_RADIUS:g}, {LARGEST_RADIUS:g}]"
            raise ValueError(f"motion: body {first[0]} has {radius} out of range; {limits}")


def first_faulty_radius(radius: Tensor) -> Tensor:
    """(2,) int64: the first radius (N,) that is out of range, or N; then 1 if there is one, else 0."""
    # A body may shrink to a point.
    sound = (radius == 0.0) | ((radius >= SMALLEST_RADIUS) & (radius <= LARGEST_RADIUS))
    row = torch.arange(len(sound), device=sound.device)
    body = torch.where(sound, len(sound), row).min().reshape(1) if len(sound) else row.sum().reshape(1)
    return torch.cat([body, (body < len(sound)).long()])
