"""Integration of orientations."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import arguments, ops


def integrate_orientation(orientation: Tensor, rotation: Tensor) -> Tensor:
    """Rotated orientations: exp(rotation) orientation, normalised, by the same arithmetic as detection.

    Args:
        orientation: (N, 4) float32 or float64 unit quaternions (w, x, y, z), body to world.
        rotation: (N, 3) rotation vectors, radians, world frame: `motion.rotation` of a whole step, or a fraction of it.

    Returns:
        (N, 4), of the dtype and on the device of `orientation`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> motion = pgccd.RigidMotion.from_velocity(x, q, v, omega, dt=1e-3)
        >>> x, q = motion.position_t1, pgccd.integrate_orientation(q, motion.rotation)
    """
    for name, values, width in (("orientation", orientation, 4), ("rotation", rotation, 3)):
        arguments.real_tensor(values, name)
        if values.dim() != 2 or values.shape[1] != width or values.shape[0] != orientation.shape[0]:
            expected = "N" if name == "orientation" else orientation.shape[0]
            raise ValueError(f"{name}: expected shape ({expected}, {width}), got {tuple(values.shape)}")
        if values.device != orientation.device:
            raise ValueError(f"{name}: expected device {orientation.device}, got {values.device}")
    start, turn = orientation.double().contiguous(), rotation.double().contiguous()
    nowhere, end = torch.zeros_like(turn), torch.ones_like(turn[:, 0])
    _, turned = ops.poses_at(nowhere, nowhere, start, turn, end)
    return torch.nn.functional.normalize(turned, dim=1).to(orientation.dtype)
