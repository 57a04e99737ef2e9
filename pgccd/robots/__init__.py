"""Robot arms: scenes from URDF and MJCF files, and certificates that their paths are free of contact, also between
waypoints.

Files are read by yourdfpy and MuJoCo (`pip install 'pgccd[robots]'`).
"""

from pgccd.robots.certificate import Certificate, Verdict
from pgccd.robots.mjcf import load_mjcf
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.path_clearance import Clearance, clearance
from pgccd.robots.path_search import certify
from pgccd.robots.robot import Robot
from pgccd.robots.urdf import load_urdf
from pgccd.robots.validator import Motion, MotionValidator

__all__ = [
    "Certificate",
    "Clearance",
    "Motion",
    "MotionValidator",
    "Obstacles",
    "Robot",
    "Verdict",
    "certify",
    "clearance",
    "load_mjcf",
    "load_urdf",
]


def __dir__() -> list[str]:
    return sorted(__all__)
