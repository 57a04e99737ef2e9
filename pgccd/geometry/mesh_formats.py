"""Mesh files that trimesh does not read, or not as a whole."""

from xml.etree import ElementTree

import numpy as np

# What a Collada file says of looks, beside the bindings of materials to geometries.
_LOOKS = ("library_images", "library_effects", "library_materials")


def collada_without_looks(data: bytes) -> bytes:
    """A Collada file without materials: trimesh drops a geometry whose material is missing.

    Raises:
        ValueError: it is no XML.
    """
    root = collada_root(data)
    for element in root.iter():
        for child in list(element):
            if child.tag.endswith("}bind_material") or (element is root and child.tag.endswith(_LOOKS)):
                element.remove(child)
    return ElementTree.tostring(root)


def collada_root(data: bytes) -> ElementTree.Element:
    """The root of a Collada file.

    Raises:
        ValueError: it is no XML.
    """
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise ValueError(f"a Collada file that is no XML: {error}") from error


def mujoco_mesh(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) int64 of a binary mesh of MuJoCo (msh): numbers of vertices, normals,
    texture coordinates and faces, int32, then their float32 coordinates, and int32 corners of faces.

    Raises:
        ValueError: it is something else.
    """
    header = np.frombuffer(data[:16], dtype="<i4").astype(np.int64).tolist() if len(data) >= 16 else []
    vertices, normals, coordinates, faces = header or (-1, 0, 0, 0)
    expected = 16 + 4 * (3 * vertices + 3 * normals + 2 * coordinates + 3 * faces)
    if min(header or [-1]) < 0 or expected != len(data):
        kind = "a mesh of Gmsh" if data.startswith(b"$MeshFormat") else "a file"
        declared = f"{vertices} vertices and {faces} faces make {expected} bytes, got {len(data)}"
        raise ValueError(
            f"{kind}: expected a binary mesh of MuJoCo" + (f", whose {declared}" if min(header or [-1]) >= 0 else "")
        )
    points = np.frombuffer(data, "<f4", 3 * vertices, 16).reshape(-1, 3)
    corners = np.frombuffer(data, "<i4", 3 * faces, expected - 12 * faces).reshape(-1, 3)
    return points.astype(np.float64), corners.astype(np.int64)
