"""Objects that a robot carries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.motion.validation import LARGEST_COORDINATE, UNIT_TOLERANCE
from pgccd.robots.kinematics import Joint
from pgccd.robots.shapes import ThickSurface

_PAIR = "a position (3,) and an orientation (4,), a unit quaternion (w, x, y, z), of the object in the link's frame"


@dataclass(frozen=True)
class Attached:
    """An object fixed to a link. It is a link of its own.

    Attributes:
        name: of the object.
        link: the name of the link that carries it.
        position, orientation: (3,) and (4,), unit quaternion (w, x, y, z): of the object's frame, that of its mesh, in
            the link's frame.
        surface: in the object's frame.
    """

    name: str
    link: str
    position: np.ndarray
    orientation: np.ndarray
    surface: ThickSurface

    @classmethod
    def of(cls, name: str, link: str, mesh: Mesh, pose: Any) -> Attached:
        """From the arguments of `Robot.attach`.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        arguments.instance(mesh, "mesh", Mesh)
        if not isinstance(pose, (tuple, list)) or len(pose) != 2:
            raise TypeError(f"pose: expected {_PAIR}, got {arguments.describe(pose)}")
        at, turn = (arguments.real_numbers(values, "pose", _PAIR).cpu().numpy() for values in pose)
        if at.shape != (3,) or turn.shape != (4,):
            raise ValueError(f"pose: expected {_PAIR}, got shapes {at.shape} and {turn.shape}")
        length = float(np.linalg.norm(turn))
        if not ((np.abs(at) <= LARGEST_COORDINATE).all() and abs(length - 1.0) <= UNIT_TOLERANCE):
            raise ValueError(f"pose: expected {_PAIR}, got {at.tolist()} and {turn.tolist()}")
        surface = ThickSurface(
            mesh.vertices.numpy(),
            mesh.faces.long().numpy(),
            mesh.thickness,
            solid=True if mesh.solid else "auto",
        )
        return cls(name, link, at.copy(), turn / length, surface)

    def joint(self, frame: int) -> Joint:
        """The joint that holds it, on the frame of the link that carries it."""
        return Joint(self.name, "fixed", frame, self.position, self.orientation, np.array([1.0, 0.0, 0.0]))
