"""Contacts of bodies on their paths, as the operators read them."""

from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion

_COLUMNS = ("kind", "features", "coordinates", "toi", "point", "normal")


def operands(
    scene: Scene, motion: RigidMotion | VertexMotion, bodies: Tensor, contacts: Contacts
) -> tuple[list[Tensor], list[Tensor], bool, list[Tensor], int, list[Tensor]]:
    """The first arguments of the operators of `pgccd.ops.contacts`.

    Args:
        scene, motion: of the bodies.
        bodies: (K, 2) int64, rows of the motion.
        contacts: K, of these bodies, on the scene's device.
    """
    columns = [bodies, *(getattr(contacts, name) for name in _COLUMNS)]
    paths = [scene.mesh_index, *(column.detach() for column in motion._values())]
    if isinstance(motion, VertexMotion):
        paths.append(scene.layout.vertex_begin)
    is_linear = isinstance(motion, RigidMotion) and motion.path == "linear"
    lists, most = scene.meshes._incidence
    return scene.meshes.tensors, paths, is_linear, lists, most, [column.detach().contiguous() for column in columns]
