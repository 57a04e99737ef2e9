"""Scenes and frames of other simulators, for `pgccd.audit` and `pgccd.detect`.

A class for each simulator makes a `Scene` of its collision shapes, one body a shape, and gives the poses of these
bodies as a frame: positions (N, 3) and orientations (N, 4), whenever asked; `save` writes both to files. Spheres and
capsules are exact, as points and segments with a margin; cylinders and ellipsoids are polyhedra around them, at most
0.13 % and 0.8 % larger. Meshes are taken as they are, where a simulator may take their convex hulls. In place of an
infinite plane is a square that reaches four times as far as all else does when the scene is made, and 10,000 length
units at least; the frame of a body beside it is an error.
"""

from pgccd.simulators.mujoco_frames import MuJoCo
from pgccd.simulators.newton_frames import Newton
from pgccd.simulators.pybullet_frames import PyBullet

__all__ = ["MuJoCo", "Newton", "PyBullet"]


def __dir__() -> list[str]:
    return sorted(__all__)
