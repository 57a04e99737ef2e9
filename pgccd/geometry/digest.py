"""Digests of meshes, used to compare runs and ranks."""

import hashlib
from collections.abc import Sequence

import numpy as np

from pgccd.geometry.mesh import Mesh


def meshes_digest(meshes: Sequence[Mesh]) -> str:
    """Hexadecimal SHA-256 of the vertices and faces of meshes, in order. Vertices are relative to the origins; centre
    offsets are included where they are not zero, and solids and thickness where there are any.
    """
    digest = hashlib.sha256()
    for mesh in meshes:
        for table in (mesh.vertices, mesh.faces):
            digest.update(str(tuple(table.shape)).encode())
            digest.update(table.numpy().tobytes())
        if bool(mesh.centre_offset.any()):
            digest.update(b"centre" + mesh.centre_offset.numpy().tobytes())
        if mesh.solid:
            digest.update(b"solid")
        if mesh.thickness:
            digest.update(b"thickness" + np.float64(mesh.thickness).tobytes())
    return digest.hexdigest()
