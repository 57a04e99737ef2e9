"""Integration of orientations."""

import torch
from torch import Tensor

from pgccd import ops
from pgccd.arguments import real_rows
from pgccd.motion.validation import Validation, columns_checked, first_invalid_rows


def integrate_orientation(orientation: Tensor, rotation: Tensor) -> Tensor:
    """Rotated orientations, exp(rotation) orientation / |orientation|, by the same arithmetic as detection. Bits are
    equal on all devices. Lengths do not drift over many steps, because each step starts from a normalised orientation.

    Args:
        orientation: (N, 4) float32 or float64 unit quaternions (w, x, y, z), body to world.
        rotation: (N, 3) rotation vectors, radians, world frame: `motion.rotation` of a whole step, or a fraction of it.

    Returns:
        (N, 4), of the dtype and on the device of `orientation`.

    Raises:
        TypeError, ValueError: naming the argument; on a CPU also if a turn is longer than 1e6 radians, or an
            orientation has no direction. On a GPU the result is NaN there.

    Example:
        >>> motion = pgccd.RigidMotion.from_velocity(x, q, v, omega, dt=1e-3)
        >>> x, q = motion.position_t1, pgccd.integrate_orientation(q, motion.rotation)  # if nothing collides
    """
    start = real_rows(orientation, "orientation", None, 4, None)
    turn = real_rows(rotation, "rotation", len(start), 3, start.device)
    turned = rotated(start, turn)
    if start.device.type == "cpu" and not torch.compiler.is_compiling():
        _raise_invalid(start, turn, turned)
    return turned.to(orientation.dtype)


def rotated(orientation: Tensor, rotation: Tensor) -> Tensor:
    """As `integrate_orientation`, for float64 rows, without checks; NaN where a row is invalid."""
    nowhere, end = torch.zeros_like(rotation).contiguous(), torch.ones_like(rotation[:, 0])
    _, turned = ops.poses_at(nowhere, nowhere, orientation.contiguous(), rotation.contiguous(), end)
    return turned


def _raise_invalid(start: Tensor, turn: Tensor, turned: Tensor) -> None:
    columns = columns_checked({"rotation": turn}, "body")
    Validation(columns).raise_from(first_invalid_rows(columns).tolist())
    sound = turned.isfinite().all(dim=1)
    if not bool(sound.all()):
        row = int((~sound).long().argmax())
        raise ValueError(f"orientation: body {row}: expected a unit quaternion (w, x, y, z), got {start[row].tolist()}")
