"""Continuous collision detection for very many moving meshes, as a PyTorch extension."""

import importlib as _importlib
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from pgccd import _requirements as _requirements  # first: its errors say what is missing
from pgccd.auditing.audit import audit
from pgccd.auditing.results import Audit, Passages, Touching
from pgccd.contacts.approach import approach_rates
from pgccd.contacts.contacts import CollidingPairs, Contacts, Stats
from pgccd.contacts.kinds import Kind, Status
from pgccd.contacts.padded import PaddedCollidingPairs, PaddedContacts
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.rotation import integrate_orientation
from pgccd.motion.splines import Spline
from pgccd.motion.trajectory import Trajectory
from pgccd.ops import build_information as _build_information
from pgccd.resolution.resolve import resolve
from pgccd.resolution.results import PaddedResolution, Resolution
from pgccd.resolution.trajectories import TrajectoryResolution
from pgccd.runtime.sizes import Capacity, CapacityError
from pgccd.search import broad, narrow, traverse
from pgccd.search.approaching import approaching
from pgccd.search.bodies import MovingBodies
from pgccd.search.captured import CapturedCollision, CapturedDetection
from pgccd.search.detect import collide, detect
from pgccd.search.distance import Distances, distance
from pgccd.search.enclosed import enclosed
from pgccd.search.exit_distance import ExitDistances, exit_distance
from pgccd.search.narrow import Report

if _TYPE_CHECKING:
    from pgccd import about, baselines, distributed, files, robots, sim, simulators, viz
    from pgccd.viz import show

# Imported on first use: they load more modules than detection needs.
_LATER = ("about", "baselines", "distributed", "files", "robots", "sim", "simulators", "viz")

__version__: str = _build_information()["version"]

__all__ = [
    "Audit",
    "Capacity",
    "CapacityError",
    "CapturedCollision",
    "CapturedDetection",
    "CollidingPairs",
    "Contacts",
    "Distances",
    "ExitDistances",
    "Kind",
    "Mesh",
    "MeshSet",
    "MovingBodies",
    "PaddedCollidingPairs",
    "PaddedContacts",
    "PaddedResolution",
    "Passages",
    "Report",
    "Resolution",
    "RigidMotion",
    "Scene",
    "Spline",
    "Stats",
    "Status",
    "Touching",
    "Trajectory",
    "TrajectoryContacts",
    "TrajectoryResolution",
    "VertexMotion",
    "about",
    "approach_rates",
    "approaching",
    "audit",
    "baselines",
    "broad",
    "collide",
    "detect",
    "distance",
    "distributed",
    "enclosed",
    "exit_distance",
    "files",
    "integrate_orientation",
    "narrow",
    "resolve",
    "robots",
    "show",
    "sim",
    "simulators",
    "traverse",
    "viz",
]


def __getattr__(name: str) -> _Any:
    if name in _LATER:
        return _importlib.import_module(f"pgccd.{name}")
    if name == "show":
        return _importlib.import_module("pgccd.viz").show
    raise AttributeError(f"module 'pgccd' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
