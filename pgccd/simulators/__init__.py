"""Scenes and frames of other simulators, for `pgccd.audit` and `pgccd.detect`.

A class for each simulator makes a `Scene` of its collision shapes, one body per shape. Its `frame` gives the present
poses of these bodies: positions (N, 3) and orientations (N, 4). Its `save` writes scene and frames to files. Spheres
and capsules are exact, as points and segments with a margin; cylinders and ellipsoids are polyhedra around them, at
most 0.13 % and 0.8 % larger. Meshes are taken as they are, also where a simulator takes their convex hulls. An infinite
plane becomes a square that reaches four times as far as all other bodies when the scene is made, and at least 10,000
length units. A frame in which a body is beside the square is an error.
"""

from pgccd.simulators.mujoco_frames import MuJoCo
from pgccd.simulators.newton_frames import Newton
from pgccd.simulators.pybullet_frames import PyBullet

__all__ = ["MuJoCo", "Newton", "PyBullet"]


def __dir__() -> list[str]:
    return sorted(__all__)
