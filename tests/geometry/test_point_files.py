"""Files of points and segments: OBJ and PLY files without faces, and what trimesh makes of others."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pgccd

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 0, 0], [5, 5, 5]])
ROWS = "".join("{} {} {}\n".format(*row) for row in CORNERS)
XYZ = "property double x\nproperty double y\nproperty double z\n"


def written(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def ply(edges: list[tuple[int, int]] | None = None, kind: str = "ascii", other: str = "") -> bytes:
    """A PLY file of the corners, and of edges if given."""
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(CORNERS)}\n{XYZ}{other}"
    if edges is not None:
        head += f"element edge {len(edges)}\nproperty int vertex1\nproperty int vertex2\nproperty uchar red\n"
    rows = [(*edge, 255) for edge in edges or []]
    if kind == "ascii":
        return (head + "end_header\n" + ROWS + "".join("{} {} {}\n".format(*row) for row in rows)).encode()
    order = ">" if "big" in kind else "<"
    body = CORNERS.astype(f"{order}f8").tobytes() + b"".join(struct.pack(f"{order}iiB", *row) for row in rows)
    return (head + "end_header\n").encode() + body


def obj(records: str) -> str:
    return "".join(f"v {row}\n" for row in ROWS.splitlines()) + records


KINDS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("kind", KINDS)
def test_vertices_of_a_ply_file_are_points(tmp_path: Path, kind: str) -> None:
    for other in ("", "element face 0\nproperty list uchar int vertex_indices\n"):
        path = written(tmp_path, "cloud.ply", ply(None, kind, other))
        mesh = pgccd.Mesh.load(path)
        assert (mesh.point_count, len(mesh.faces), mesh.welded_vertices, mesh.dropped_faces) == (4, 4, 1, 1)
        assert mesh.source_vertex is not None and mesh.source_face is not None
        assert mesh.source_vertex.tolist() == mesh.source_face.tolist() == [0, 1, 2, 4]
        assert np.array_equal(mesh.vertices, CORNERS[[0, 1, 2, 4]])
        every = pgccd.Mesh.load(path, weld=False)
        assert (every.point_count, every.dropped_faces) == (5, 0) and np.array_equal(every.vertices, CORNERS)
        (one,) = pgccd.Mesh.load_all(path)
        assert torch.equal(one.faces, mesh.faces)


@pytest.mark.parametrize("kind", KINDS)
def test_edges_of_a_ply_file_are_segments(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, "wire.ply", ply([(0, 1), (1, 3), (3, 2)], kind))
    mesh = pgccd.Mesh.load(path)
    assert (mesh.segment_count, mesh.point_count, mesh.dropped_faces) == (2, 0, 1)  # (1, 3) has equal ends
    assert mesh.faces.tolist() == [[0, 1, 1], [1, 2, 2]] and mesh.source_face.tolist() == [0, 2]
    every = pgccd.Mesh.load(path, weld=False, origin=(1.0, 0.0, 0.0))
    assert every.faces[:, :2].tolist() == [[0, 1], [1, 3], [3, 2]]
    assert np.array_equal(every.vertices + every.origin, CORNERS)


def test_lines_and_points_of_an_obj_file(tmp_path: Path) -> None:
    text = obj("l 1/1 2/2 \\\n 3 # a polyline\no end\nl -1 -3\np 5 5 1\n")
    mesh = pgccd.Mesh.load(written(tmp_path, "wire.obj", text), weld=False)
    assert (mesh.triangle_count, mesh.segment_count, mesh.point_count, mesh.dropped_faces) == (0, 3, 2, 1)
    assert mesh.faces.tolist() == [[0, 1, 1], [1, 2, 2], [4, 2, 2], [4, 4, 4], [0, 0, 0]]
    assert mesh.source_face.tolist() == [0, 1, 2, 3, 5]
    first, second = pgccd.Mesh.load_all(tmp_path / "wire.obj")
    assert (first.name, first.segment_count, first.point_count) == (None, 2, 0)
    assert (second.name, second.segment_count, second.point_count) == ("end", 1, 2)
    assert pgccd.Mesh.load(written(tmp_path, "back.obj", "v 0 0 0\nv 1 0 0\nl -2 -1\nv 5 5 5\n")).faces[0, 0] == 0
    assert pgccd.Mesh.load(written(tmp_path, "dots.obj", obj("p 1\np 2 4\n"))).dropped_faces == 1


def test_lines_and_points_beside_triangles_are_left_out(tmp_path: Path) -> None:
    for name, content in (
        ("mixed.obj", obj("l 1 5\np 5\nf 1 2 3\n")),
        (
            "mixed.ply",
            f"ply\nformat ascii 1.0\nelement vertex 5\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n"
            f"element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n{ROWS}3 0 1 2\n0 4\n",
        ),
    ):
        mesh = pgccd.Mesh.load(written(tmp_path, name, content))
        assert (mesh.triangle_count, len(mesh.faces)) == (1, 1)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", obj(""), "5 vertices without faces"),
        ("a.obj", obj("l 1\n"), "line 6: line '1': expected two vertices"),
        ("a.obj", obj("p 1\nl 1 x\n"), "line 7: line '1 x': expected vertex indices"),
        ("a.obj", obj("l 0 1\n"), "numbered from 1"),
        ("a.obj", obj("p 6\n"), "line 6: points '6': there are 5 vertices"),
        ("a.obj", "v 0 0 0\np -2\n", "1 of them before it"),
        ("a.obj", "v 0 0\np 1\n", "three numbers"),
        ("a.obj", obj("l 2 4\n"), "no segments with two different ends"),
        ("a.ply", ply()[:-9], "5 rows of element vertex"),
        ("a.ply", ply(None, KINDS[1])[:-1], "5 rows of element vertex"),
        ("a.ply", ply([(0, 1)], KINDS[1])[:-1], "1 rows of element edge"),
        ("a.ply", ply([(0, 1), (0, 5)]), r"edge 1: \[0, 5\]: expected two of the 5 vertices"),
        ("a.ply", ply([(0, -1)], KINDS[2]), r"edge 0: \[0, -1\]"),
        ("a.ply", ply([(0, 1)]).replace(b"vertex2", b"to"), "no vertex1 and vertex2"),
        ("a.ply", ply().replace(b" z", b" w"), "no x, y and z"),
        ("a.ply", ply().replace(b"5 5 5", b"5 nan 5").replace(b"5.0 5.0 5.0", b"5 nan 5"), "vertex 4 is not finite"),
        (
            "a.ply",
            f"ply\nformat ascii 1.0\nelement vertex 5\n{XYZ}element tristrips 1\n"
            f"property list int int vertex_indices\nend_header\n{ROWS}4 0 1 2 3\n",
            "lists of element tristrips",
        ),
        ("a.ply", f"ply\nformat ascii 1.0\nelement vertex 0\n{XYZ}end_header\n", "no triangles, segments or points"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, content: str | bytes, message: str) -> None:
    path = written(tmp_path, name, content)
    for load in (pgccd.Mesh.load, pgccd.Mesh.load_all):
        with pytest.raises(ValueError, match=rf"^path: .*a\.(obj|ply).*{message}"):
            load(path)


def test_a_ply_file_may_hold_other_elements(tmp_path: Path) -> None:
    other = "element camera 1\nproperty float view_px\n"
    path = written(tmp_path, "pcl.ply", ply(None, "ascii", other) + b"0.5\n")
    assert pgccd.Mesh.load(path).point_count == 4


def test_point_clouds_and_lines_of_trimesh(tmp_path: Path) -> None:
    trimesh: Any = pytest.importorskip("trimesh")
    cloud = trimesh.PointCloud(CORNERS)
    assert pgccd.Mesh.from_trimesh(cloud).point_count == 4
    lines = trimesh.load_path([[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    wire = pgccd.Mesh.from_trimesh(lines)
    assert wire.segment_count == 2 and wire.faces.tolist() == [[0, 1, 1], [1, 2, 2]]
    scene, place = trimesh.Scene(), np.diag([-2.0, 1.0, 1.0, 1.0])
    scene.add_geometry(lines, transform=place)
    scene.add_geometry(cloud)
    mesh = pgccd.Mesh.from_trimesh(scene)
    assert (mesh.segment_count, mesh.point_count) == (2, 4)
    assert mesh.vertices[mesh.faces[0, :2].long()].tolist() == [[0, 0, 0], [-2, 0, 0]]
    # Segments come first, also of parts behind.
    scene = trimesh.Scene([cloud, lines])
    mesh = pgccd.Mesh.from_trimesh(scene, weld=False)
    assert mesh.faces[[0, 2], :2].tolist() == [[5, 6], [0, 0]] and mesh.source_face is not None
    assert mesh.source_face.tolist() == [5, 6, 0, 1, 2, 3, 4]
    arc = trimesh.path.Path3D([trimesh.path.entities.Arc([0, 1, 2])], CORNERS)
    with pytest.raises(ValueError, match="^mesh: expected lines, got Arc"):
        pgccd.Mesh.from_trimesh(arc)
    with pytest.raises(ValueError, match="^mesh: .*lines in a plane"):
        pgccd.Mesh.from_trimesh(trimesh.load_path(CORNERS[:3, :2]))
    with pytest.raises(ValueError, match="^solid: "):
        pgccd.Mesh.from_trimesh(cloud, solid=True)
    assert not pgccd.Mesh.from_trimesh(cloud, solid="auto").solid
    # Files of other kinds: a cloud as glTF; lines there are read wrongly by trimesh.
    trimesh.Scene([cloud]).export(tmp_path / "cloud.glb")
    assert pgccd.Mesh.load(tmp_path / "cloud.glb").point_count == 4
    trimesh.Scene([lines]).export(tmp_path / "lines.glb")
    with pytest.raises(ValueError, match="^path: .*lines of a glTF file"):
        pgccd.Mesh.load(tmp_path / "lines.glb")
    assert pgccd.Mesh.load(written(tmp_path, "cloud.xyz", ROWS)).point_count == 4
