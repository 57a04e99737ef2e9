"""Continuous collision detection for very many moving meshes, as a PyTorch extension."""

from pgccd import broad, narrow, traverse
from pgccd._host import build_information as _build_information
from pgccd.bodies import MovingBodies
from pgccd.capacity import Capacity
from pgccd.contacts import Contacts, PaddedContacts, Stats
from pgccd.detect import detect
from pgccd.mesh import Mesh, MeshSet
from pgccd.motion import RigidMotion, VertexMotion
from pgccd.narrow import Kind, Status
from pgccd.scene import Scene
from pgccd.trajectory import Trajectory, TrajectoryContacts
from pgccd.within import CapacityError

__version__: str = _build_information()["version"]

# Plain integers: torch.compile takes a comparison of a tensor with an enum member for a constant.
FREE, TOUCH, UNRESOLVED = int(Status.FREE), int(Status.TOUCH), int(Status.UNRESOLVED)
VF_AB, VF_BA, EE = int(Kind.VF_AB), int(Kind.VF_BA), int(Kind.EE)

__all__ = [
    "EE",
    "FREE",
    "TOUCH",
    "UNRESOLVED",
    "VF_AB",
    "VF_BA",
    "Capacity",
    "CapacityError",
    "Contacts",
    "Kind",
    "Mesh",
    "MeshSet",
    "MovingBodies",
    "PaddedContacts",
    "RigidMotion",
    "Scene",
    "Stats",
    "Status",
    "Trajectory",
    "TrajectoryContacts",
    "VertexMotion",
    "broad",
    "detect",
    "narrow",
    "traverse",
]
