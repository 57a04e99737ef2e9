"""Integration of orientations."""

import torch
from torch import Tensor

from pgccd import ops
from pgccd.arguments import real_rows


def integrate_orientation(orientation: Tensor, rotation: Tensor) -> Tensor:
    """Rotated orientations, exp(rotation) orientation / |orientation|, by the same arithmetic as detection. Bits are
    equal on all devices. Lengths do not drift over many steps, since each starts from a normalised orientation.

    Args:
        orientation: (N, 4) float32 or float64 unit quaternions (w, x, y, z), body to world.
        rotation: (N, 3) rotation vectors, radians, world frame: `motion.rotation` of a whole step, or a fraction of it.

    Returns:
        (N, 4), of the dtype and on the device of `orientation`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> motion = pgccd.RigidMotion.from_velocity(x, q, v, omega, dt=1e-3)
        >>> x, q = motion.position_t1, pgccd.integrate_orientation(q, motion.rotation)  # if nothing collides
    """
    start = real_rows(orientation, "orientation", None, 4, None)
    turn = real_rows(rotation, "rotation", len(start), 3, start.device)
    nowhere, end = torch.zeros_like(turn), torch.ones_like(turn[:, 0])
    _, turned = ops.poses_at(nowhere, nowhere, start, turn, end)
    return turned.to(orientation.dtype)
