"""Mesh files that trimesh does not read, or reads only in part."""

from __future__ import annotations

import base64
import json
import re
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

# Elements of a Collada file about looks, in addition to the bindings of materials to geometries.
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


_COMMENT_OF_OBJ = re.compile(rb"(?m)^([ \t]*(?:v|vt|vn|vp|f|l|p)[ \t][^\r\n#]*)#[^\r\n]*")


def plain_obj(data: bytes) -> bytes | None:
    """An OBJ file without comments behind its numbers, which trimesh does not read; None if it has none of them."""
    plain, count = _COMMENT_OF_OBJ.subn(rb"\1", data)
    return plain if count else None


# Modes of glTF primitives.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}


def gltf_of_triangles(path: Path) -> bytes | None:
    """A glTF file as GLB, with strips and fans as triangles, and without the points and lines of meshes that have
    triangles, which only draw their edges. None if the file has none of these.

    Raises:
        ValueError, OSError: a buffer is missing.
    """
    content, buffers = _gltf_parts(path)
    is_changed = False
    for mesh in content.get("meshes", []):
        surfaces = [each for each in mesh["primitives"] if each.get("mode", _TRIANGLES) >= _TRIANGLES]
        if surfaces and len(surfaces) < len(mesh["primitives"]):
            mesh["primitives"], is_changed = surfaces, True
        for primitive in surfaces:
            mode = primitive.get("mode", _TRIANGLES)
            if mode != _TRIANGLES:
                rows = _gltf_indices(content, buffers, primitive)
                primitive |= {"mode": _TRIANGLES, "indices": len(content["accessors"])}
                _add_indices(content, buffers, _fan(rows) if mode == _FAN else _strip(rows))
                is_changed = True
    if not is_changed:
        return None
    return _glb(content, buffers)


def _gltf_parts(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    data, binary = path.read_bytes(), None
    if data.startswith(b"glTF"):
        length = int.from_bytes(data[12:16], "little")
        text, rest = data[20 : 20 + length], data[20 + length :]
        binary = rest[8 : 8 + int.from_bytes(rest[:4], "little")] if len(rest) >= 8 else b""
    else:
        text = data
    content = json.loads(text)
    buffers = []
    for number, buffer in enumerate(content.get("buffers", [])):
        uri = buffer.get("uri")
        if uri is None:
            if binary is None:
                raise ValueError(f"a glTF file whose buffer {number} is missing")
            buffers.append(binary)
        elif uri.startswith("data:"):
            buffers.append(base64.b64decode(uri.partition(",")[2]))
        else:
            buffers.append((path.parent / unquote(uri)).read_bytes())
    return content, buffers


def _gltf_indices(content: dict[str, Any], buffers: list[bytes], primitive: dict[str, Any]) -> np.ndarray:
    """The vertices (n,) of a primitive in their order."""
    accessors = content["accessors"]
    if "indices" not in primitive:
        return np.arange(accessors[primitive["attributes"]["POSITION"]]["count"])
    accessor = accessors[primitive["indices"]]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError("a glTF file with sparse indices, which cannot be read")
    view = content["bufferViews"][accessor["bufferView"]]
    begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    kind = np.dtype(_INDEX_TYPES[accessor["componentType"]])
    return np.frombuffer(buffers[view["buffer"]], kind, accessor["count"], begin).astype(np.int64)


def _fan(rows: np.ndarray) -> np.ndarray:
    return np.stack([np.full(max(len(rows) - 2, 0), rows[0]), rows[1:-1], rows[2:]], axis=1)


def _strip(rows: np.ndarray) -> np.ndarray:
    """Every second triangle is turned; those that repeat a vertex join strips, and have no area."""
    triangles = np.stack([rows[:-2], rows[1:-1], rows[2:]], axis=1)
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    repeats = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return triangles[~repeats]


def _add_indices(content: dict[str, Any], buffers: list[bytes], triangles: np.ndarray) -> None:
    data = triangles.astype("<u4").tobytes()
    content["accessors"].append(
        {"bufferView": len(content["bufferViews"]), "componentType": 5125, "count": triangles.size, "type": "SCALAR"}
    )
    content["bufferViews"].append({"buffer": len(buffers), "byteLength": len(data)})
    buffers.append(data)


def _glb(content: dict[str, Any], buffers: list[bytes]) -> bytes:
    """With all buffers joined."""
    begins, joined = [], b""
    for buffer in buffers:
        begins.append(len(joined))
        joined += buffer + bytes(-len(buffer) % 4)
    for view in content.get("bufferViews", []):
        view["byteOffset"] = view.get("byteOffset", 0) + begins[view["buffer"]]
        view["buffer"] = 0
    content["buffers"] = [{"byteLength": len(joined)}]
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(joined), 0x004E4942) + joined
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
