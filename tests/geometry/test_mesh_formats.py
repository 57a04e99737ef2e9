"""Files mean what their format says: points, outlines, outsides and units are those of the file, in every format."""

from __future__ import annotations

import base64
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pgccd
from pgccd import cli
from pgccd.geometry.file_checks import declared_triangles
from pgccd.geometry.polygons import is_convex

trimesh = pytest.importorskip("trimesh")
L_SHAPE = [[2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0], [0, 0, 0]]


def area(mesh: pgccd.Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def volume(mesh: pgccd.Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    return float((a * np.cross(b, c)).sum() / 6.0)


def star(rng: np.random.Generator, corners: int) -> np.ndarray:
    """A polygon that goes once round a point, in any plane, most often not convex."""
    angle = 2.0 * np.pi * (np.arange(corners) + rng.uniform(0.0, 0.9, corners)) / corners
    flat = rng.uniform(0.2, 1.0, corners)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    first, second = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    return flat @ np.stack([first, second]) + rng.normal(size=3)


def polygon_area(corners: np.ndarray) -> float:
    relative = corners - corners[0]
    return float(0.5 * np.linalg.norm(np.cross(relative, np.roll(relative, -1, axis=0)).sum(axis=0)))


def write_polygons(path: Path, vertices: np.ndarray, polygons: list[list[int]]) -> None:
    points = [" ".join(repr(float(x)) for x in vertex) for vertex in vertices]
    if path.suffix == ".obj":
        lines = [f"v {point}" for point in points] + ["f " + " ".join(str(k + 1) for k in each) for each in polygons]
    elif path.suffix == ".off":
        lines = ["OFF", f"{len(points)} {len(polygons)} 0", *points]
        lines += [" ".join(map(str, [len(each), *each])) for each in polygons]
    else:
        lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
        lines += [f"property double {axis}" for axis in "xyz"]
        lines += [f"element face {len(polygons)}", "property list uchar int vertex_indices", "end_header", *points]
        lines += [" ".join(map(str, [len(each), *each])) for each in polygons]
        if path.name.startswith("binary"):
            header = "\n".join(lines[: lines.index("end_header") + 1]).replace("ascii", "binary_little_endian")
            rows = [np.uint8(len(each)).tobytes() + np.array(each, dtype="<i4").tobytes() for each in polygons]
            path.write_bytes(header.encode() + b"\n" + vertices.astype("<f8").tobytes() + b"".join(rows))
            return
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("name", ["polygons.obj", "polygons.off", "text.ply", "binary.ply"])
def test_polygons_are_divided_within_their_outlines(name: str, tmp_path: Path) -> None:
    """The area of all is that of the polygons, seen along their normals: a fan of one with a notch covers more."""
    pytest.importorskip("mapbox_earcut")
    path = tmp_path / name
    concave = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        stars = [star(rng, int(rng.integers(4, 9))) for _ in range(4)]
        stars.append(np.array(L_SHAPE, dtype=np.float64) + 10.0)
        concave += sum(not is_convex(each) for each in stars)
        first = np.cumsum([0, *map(len, stars)])
        polygons = [list(range(a, b)) for a, b in zip(first[:-1], first[1:], strict=True)]
        if seed % 2:
            polygons = [each[::-1] for each in polygons]
        write_polygons(path, np.concatenate(stars), polygons)
        mesh = pgccd.Mesh.load(path)
        assert len(mesh.faces) == sum(len(each) - 2 for each in polygons)
        assert area(mesh) == pytest.approx(sum(map(polygon_area, stars)), rel=1e-12)
        # Each triangle is wound as its polygon.
        owner = np.repeat(np.arange(len(stars)), [len(each) for each in stars])[mesh.faces[:, 0].numpy()]
        a, b, c = mesh.vertices[mesh.faces.long()].numpy().transpose(1, 0, 2)
        for k, each in enumerate(stars):
            ordered = each[::-1] if seed % 2 else each
            normal = np.cross(ordered - ordered[0], np.roll(ordered - ordered[0], -1, axis=0)).sum(axis=0)
            assert (np.cross(b - a, c - a)[owner == k] @ normal >= -1e-12).all()
    assert concave > 60


def test_an_outline_that_crosses_itself_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("mapbox_earcut")
    path = tmp_path / "equal.obj"  # both halves are as large
    path.write_text("v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.raises(
        ValueError, match="^path: .*equal.obj .*face 0: expected a polygon whose outline does not cross"
    ):
        pgccd.Mesh.load(path)
    path = tmp_path / "bow.obj"
    path.write_text("o bow\nv 0 0 0\nv 3 1 0\nv 3 0 0\nv 0 2 0\nv 5 5 5\nf 1 2 5\nf 1 2 3 4\n")
    with pytest.raises(ValueError, match="^path: .*bow.obj .*face 1 of bow: expected a polygon whose outline does not"):
        pgccd.Mesh.load(path)


@pytest.mark.parametrize("name", ["dart.obj", "dart.off", "text.ply", "binary.ply"])
@pytest.mark.parametrize("corners", [4, 5])
def test_a_single_polygon_with_a_notch(name: str, corners: int, tmp_path: Path) -> None:
    """Four corners suffice for a notch."""
    pytest.importorskip("mapbox_earcut")
    dart = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [0.5, 1, 0], [0.2, 0.5, 0]], dtype=np.float64)[:corners]
    for shift in range(corners):
        write_polygons(tmp_path / name, np.roll(dart, shift, axis=0), [list(range(corners))])
        mesh = pgccd.Mesh.load(tmp_path / name)
        assert len(mesh.faces) == corners - 2 and area(mesh) == pytest.approx(polygon_area(dart))


def test_triangles_are_wound_as_their_polygon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However the triangulation winds them, of which it promises nothing."""
    earcut = pytest.importorskip("mapbox_earcut")
    cut = earcut.triangulate_float64
    path = tmp_path / "notch.obj"
    for is_turned in (False, True):
        if is_turned:
            monkeypatch.setattr(earcut, "triangulate_float64", lambda *given: cut(*given)[::-1])
        for order in (1, -1):
            write_polygons(path, np.array(L_SHAPE[::order], dtype=np.float64), [list(range(6))])
            mesh = pgccd.Mesh.load(path)
            a, b, c = mesh.vertices[mesh.faces.long()].numpy().transpose(1, 0, 2)
            assert (order * np.cross(b - a, c - a)[:, 2] > 0.0).all() and len(mesh.faces) == 4


@pytest.mark.parametrize("name", ["beyond.off", "text.ply", "binary.ply"])
@pytest.mark.parametrize("row", [-1, 6])
def test_polygons_of_vertices_that_are_not_there(name: str, row: int, tmp_path: Path) -> None:
    corners = np.array(L_SHAPE, dtype=np.float64)
    write_polygons(tmp_path / name, corners, [[0, 1, 2, 3, 4, 5], [0, 1, row, 4, 5]])
    with pytest.raises(ValueError, match=rf"^path: .*face .*\[0, 1, {row}, 4, 5\]: there are 6 vertices"):
        pgccd.Mesh.load(tmp_path / name)


def test_words_of_obj_and_ply_files(tmp_path: Path) -> None:
    """Texture and normals of corners, continued lines, indices that count backwards, the other name of faces."""
    pytest.importorskip("mapbox_earcut")
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in L_SHAPE) + "vt 0 0\nvt 1 0\nvn 0 0 1\n"
    for number, face in enumerate(
        (
            "f 1/1/1 2/2/1 3/1/1 4/1/1 5/2/1 6/1/1",
            "f 1//1 2//1 3//1 4//1 5//1 6//1",
            "f 1 2 3 \\\n 4 5 6 # an L",
            "f 1 2 3 \\\r\n 4 5 6",
            "f -6 -5 -4 -3 -2 -1\nv 7 7 7",
            "f -6/1 -5/1 -4/2 -3/1 -2/1 -1/1",
        )
    ):
        path = tmp_path / f"{number}.obj"
        path.write_bytes((lines + face + "\n").encode())
        mesh = pgccd.Mesh.load(path)
        assert len(mesh.faces) == 4 and area(mesh) == pytest.approx(3.0), face
    # Backwards from the vertices before the face, not from the last one.
    for face in ("f -3 -2 -1", "f -4 -3 -2 -1"):
        corners = [[x, y, z] for z in (0.0, 5.0) for x, y in ((0.0, 0.0), (4.0, 0.0), (1.0, 1.0), (0.0, 4.0))]
        words = [f"v {x} {y} {z}" for x, y, z in corners]
        (tmp_path / "amid.obj").write_text("\n".join([*words[:4], face, *words[4:], face]) + "\n")
        mesh = pgccd.Mesh.load(tmp_path / "amid.obj")
        z = (mesh.vertices + mesh.origin)[mesh.faces.long()][..., 2]
        assert z.tolist() == [[level] * 3 for level in (0.0, 5.0) for _ in range(len(mesh.faces) // 2)]
        count = len(face.split()) - 1
        expected = polygon_area(np.array(corners[4 - count : 4]))
        assert len(mesh.faces) == 2 * (count - 2) and area(mesh) == pytest.approx(2.0 * expected)
    path = tmp_path / "text.ply"
    write_polygons(path, np.array(L_SHAPE, dtype=np.float64), [list(range(6))])
    path.write_text(path.read_text().replace("vertex_indices", "vertex_index"))
    assert area(pgccd.Mesh.load(path)) == pytest.approx(3.0)


def turned_randomly(corners: list[list[float]] | np.ndarray, seed: int) -> np.ndarray:
    """Corners (n, 2) in some plane."""
    rng = np.random.default_rng(seed)
    first, second = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    return np.array(corners, dtype=np.float64) @ np.stack([first, second]) + rng.normal(size=3)


@pytest.mark.parametrize("kind", ["bow", "pentagram"])
def test_outlines_that_turn_to_one_side_or_cancel_in_any_plane(kind: str, tmp_path: Path) -> None:
    """The halves of a bow have no area together, up to rounding; a pentagram turns to one side, but twice round."""
    pytest.importorskip("mapbox_earcut")
    bow = [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]
    star = [[np.cos(0.8 * np.pi * k), np.sin(0.8 * np.pi * k)] for k in range(5)]
    for seed in range(20):
        corners = turned_randomly(bow if kind == "bow" else star, seed)
        assert not is_convex(corners)
        write_polygons(tmp_path / "polygon.obj", corners, [list(range(len(corners)))])
        with pytest.raises(ValueError, match="face 0: expected a polygon whose outline does not cross itself"):
            pgccd.Mesh.load(tmp_path / "polygon.obj")


def test_polygons_without_an_area(tmp_path: Path) -> None:
    """Corners in one line, in any direction: nothing to divide, and no outline that crosses itself."""
    path = tmp_path / "line.obj"
    for seed in range(40):
        rng = np.random.default_rng(seed)
        line = rng.normal(size=3) + rng.permutation([0.0, 0.1, 0.7, 1.0, 1.3])[:, None] * rng.normal(size=3)
        assert is_convex(line)
        write_polygons(path, np.concatenate([line, rng.normal(size=(1, 3))]), [[0, 1, 5], [0, 1, 2, 3, 4]])
        assert len(pgccd.Mesh.load(path).faces) == 4


def test_corners_in_the_middle_of_edges_make_no_notch(tmp_path: Path) -> None:
    """In any plane, where they are beside the edge by rounding, of the file's reader to float32 too."""
    pytest.importorskip("collada")
    path = tmp_path / "square.dae"
    group = '<polylist count="1">{}<vcount>8</vcount><p>0 1 2 3 4 5 6 7</p></polylist>'
    square = np.array([[0, 0], [0.3, 0], [1, 0], [1, 0.7], [1, 1], [0.1, 1], [0, 1], [0, 0.6]], dtype=np.float64)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        far = rng.normal(size=3) * 10.0 ** rng.uniform(-1.0, 2.0)
        corners = turned_randomly(square, seed)
        assert is_convex(corners) and is_convex(corners[::-1])
        path.write_text(collada(corners + far, group))
        assert area(pgccd.Mesh.load(path)) == pytest.approx(1.0, rel=1e-3)
        # What is more than rounding is a notch.
        notched = square + 1e-3 * np.array([[0.0, 1.0]]) * (np.arange(8) == 1)[:, None]
        path.write_text(collada(turned_randomly(notched, seed) + far, group))
        with pytest.raises(ValueError, match="polygon 0 is not convex"):
            pgccd.Mesh.load(path)


def test_objects_of_one_name(tmp_path: Path) -> None:
    """Objects and groups whose names together are the same, and one with the number of an unnamed one, are all kept."""
    pytest.importorskip("mapbox_earcut")
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in L_SHAPE)
    path = tmp_path / "names.obj"
    for text, names in (
        ("o a_b\ng c\nf 1 2 3 4 5 6\no a\ng b_c\nf 1 2 3\n", ["a_b_c", "a_b_c_1"]),
        ("f 1 2 3 4 5 6\no 0\nf 1 2 3\n", ["0", "0_1"]),
        ("o a\ng b\nf 1 2 3 4 5 6\ng c\nf 1 2 3\n", ["a_b", "a_c"]),
    ):
        path.write_text(lines + text)
        assert [(mesh.name, len(mesh.faces)) for mesh in pgccd.Mesh.load_all(path)] == list(
            zip(names, (4, 1), strict=True)
        )
        assert len(pgccd.Mesh.load(path).faces) == 5


def test_objects_of_files_with_polygons(tmp_path: Path) -> None:
    pytest.importorskip("mapbox_earcut")
    lines = [f"v {x} {y} {z}" for x, y, z in L_SHAPE]
    path = tmp_path / "two.obj"
    path.write_text(
        "\n".join([*lines, "o notched", "f 1 2 3 4 5 6", "o plain", "g part", "f 1 2 3", "v 0 0 9", "f 1 2 -1"])
    )
    meshes = pgccd.Mesh.load_all(path)
    assert [(mesh.name, len(mesh.faces)) for mesh in meshes] == [("notched", 4), ("plain_part", 2)]
    assert area(meshes[0]) == pytest.approx(3.0)


@pytest.mark.parametrize("prefix", ["", "c:"])
@pytest.mark.parametrize("kind", ["polylist", "polygons"])
def test_collada_polygons_with_notches_are_refused(kind: str, prefix: str, tmp_path: Path) -> None:
    pytest.importorskip("collada")
    path = tmp_path / "notch.dae"
    corners = np.array(L_SHAPE, dtype=np.float64)
    for polygon, is_sound in (("0 1 4 5", True), ("0 1 2 3 4 5", False)):
        count = f"<vcount>{len(polygon.split())}</vcount>" if kind == "polylist" else ""
        text = collada(corners, f'<{kind} count="1">{{}}{count}<p>{polygon}</p></{kind}>')
        if prefix:
            text = re.sub("<(/?)(?=[a-zA-Z])", rf"<\1{prefix}", text).replace("xmlns=", "xmlns:c=")
        path.write_text(text)
        if is_sound:
            assert len(pgccd.Mesh.load(path).faces) == 2
        else:
            with pytest.raises(ValueError, match="geometry 'g': polygon 0 is not convex: divide it in triangles"):
                pgccd.Mesh.load(path)


def collada(vertices: np.ndarray, group: str, unit: str = "", matrix: np.ndarray | None = None) -> str:
    """A Collada file of vertices and a group of polygons, whose input is {}."""
    numbers = " ".join(repr(float(x)) for x in vertices.ravel())
    placed = "" if matrix is None else f"<matrix>{' '.join(repr(float(x)) for x in matrix.ravel())}</matrix>"
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{unit}</asset><library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="a" count="{vertices.size}">{numbers}</float_array><technique_common>
<accessor source="#a" count="{len(vertices)}" stride="3">{axes}</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
{group.format('<input semantic="VERTEX" source="#v" offset="0"/>')}</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node>{placed}<instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def triangles(faces: np.ndarray) -> str:
    return f'<triangles count="{len(faces)}">{{}}<p>{" ".join(map(str, faces.ravel()))}</p></triangles>'


FORMATS = ["stl", "stl_ascii", "ply", "off", "obj", "glb", "gltf", "dae", "3mf"]


def exported(mesh: Any, kind: str, folder: Path) -> Path:
    """A file of a mesh or scene, by trimesh."""
    path = folder / f"mesh.{kind.partition('_')[0]}"
    if kind == "dae":
        is_scene = isinstance(mesh, trimesh.Scene)
        solid = next(iter(mesh.geometry.values())) if is_scene else mesh
        matrix = mesh.graph[mesh.graph.nodes_geometry[0]][0] if is_scene else None
        path.write_text(collada(solid.vertices, triangles(solid.faces), matrix=matrix))
        return path
    content = mesh.export(file_type=kind)
    if isinstance(content, dict):
        for name, part in content.items():
            (folder / name).write_bytes(part)
        return next(folder.glob("*.gltf"))
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("kind", FORMATS)
def test_the_same_points_and_the_same_outside_in_every_format(kind: str, tmp_path: Path) -> None:
    """Random solids, written by trimesh: points to the precision of the format, volume with its sign."""
    pytest.importorskip({"dae": "collada", "3mf": "networkx"}.get(kind, "trimesh"))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        solid = trimesh.convex.convex_hull(rng.normal(size=(12, 3)))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rng.normal(size=(3, 3)), rng.normal(size=3)  # half of them mirror
        scene = solid if kind in ("stl", "stl_ascii", "ply", "off", "obj") else trimesh.Scene()
        placed = solid.vertices
        if scene is not solid:
            scene.add_geometry(solid, transform=matrix)
            placed = solid.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        mesh = pgccd.Mesh.load(exported(scene, kind, tmp_path))
        found = mesh.vertices[np.unique(mesh.faces.numpy())].numpy()
        nearest = np.linalg.norm(found[:, None] - placed[None], axis=2)
        assert nearest.min(axis=0).max() < 1e-5 and nearest.min(axis=1).max() < 1e-5
        assert volume(mesh) == pytest.approx(
            abs(np.linalg.det(matrix[:3, :3]) if scene is not solid else 1.0) * solid.volume, rel=1e-4
        )


@pytest.mark.parametrize(("case", "mark"), [("upper", b""), ("lower", b"\xef\xbb\xbf"), ("upper", b"\xef\xbb\xbf")])
def test_text_stl_files_in_upper_case_or_with_a_mark(case: str, mark: bytes, tmp_path: Path) -> None:
    text = trimesh.creation.box().export(file_type="stl_ascii")
    path = tmp_path / "box.stl"
    path.write_bytes(mark + getattr(text, case)().encode())
    mesh = pgccd.Mesh.load(path)
    assert len(mesh.faces) == 12 and volume(mesh) == pytest.approx(1.0)


def test_solids_of_text_stl_files_keep_their_names(tmp_path: Path) -> None:
    path = tmp_path / "two.stl"
    texts = [trimesh.creation.box([1.0, 1.0, size]).export(file_type="stl_ascii") for size in (1.0, 2.0)]
    named = [re.sub("solid *\n", f"solid {name}\n", text) for name, text in zip(("Left", "Right"), texts, strict=True)]
    path.write_text("".join(named))
    meshes = pgccd.Mesh.load_all(path)
    assert [(mesh.name, volume(mesh)) for mesh in meshes] == [
        ("Left", pytest.approx(1.0)),
        ("Right", pytest.approx(2.0)),
    ]


@pytest.mark.parametrize("kind", ["glb", "gltf", "data"])
def test_gltf_strips_fans_and_lines_beside_triangles(kind: str, tmp_path: Path) -> None:
    """A pyramid: its sides a fan, its base a strip, its edges lines that are left out; with and without indices."""
    points = np.array([[0, 0, 1], [1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], dtype="<f4")
    fan, strip, edges = ([0, 1, 2, 3, 4, 1], [2, 1, 3, 4], [1, 2, 3, 4])
    flat = points[[2, 1, 3, 4]]  # without indices
    buffer = points.tobytes() + np.array(fan + strip + edges, dtype="<u2").tobytes() + flat.tobytes()
    begins = np.cumsum([0, points.nbytes, 2 * len(fan), 2 * len(strip), 2 * len(edges), flat.nbytes]).tolist()
    views = [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in zip(begins[:-1], begins[1:], strict=True)]

    def accessor(view: int, count: int, kind: str, code: int) -> dict[str, Any]:
        return {"bufferView": view, "componentType": code, "count": count, "type": kind}

    accessors = [accessor(0, 5, "VEC3", 5126) | {"min": [-1, -1, 0], "max": [1, 1, 1]}]
    accessors += [accessor(1 + k, len(rows), "SCALAR", 5123) for k, rows in enumerate((fan, strip, edges))]
    accessors.append(accessor(4, 4, "VEC3", 5126) | {"min": [-1, -1, 0], "max": [1, 1, 0]})
    of = {"attributes": {"POSITION": 0}}
    base: dict[str, Any] = {"attributes": {"POSITION": 4}} if kind == "data" else of | {"indices": 2}
    primitives = [of | {"indices": 1, "mode": 6}, base | {"mode": 5}, of | {"indices": 3, "mode": 1}]
    content: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    path = tmp_path / f"pyramid.{'glb' if kind == 'glb' else 'gltf'}"
    if kind == "glb":
        text = json.dumps(content).encode()
        text, binary = text + b" " * (-len(text) % 4), buffer + bytes(-len(buffer) % 4)
        parts = [b"glTF", (2).to_bytes(4, "little"), (28 + len(text) + len(binary)).to_bytes(4, "little")]
        parts += [len(text).to_bytes(4, "little"), b"JSON", text, len(binary).to_bytes(4, "little"), b"BIN\0", binary]
        path.write_bytes(b"".join(parts))
    else:
        uri = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
        if kind == "gltf":
            (tmp_path / "a buffer.bin").write_bytes(buffer)
            uri = "a%20buffer.bin"
        content["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(content))
    mesh = pgccd.Mesh.load(path)
    assert len(mesh.faces) == 6 and volume(mesh) == pytest.approx(4.0 / 3.0) and mesh.unit == 1.0
    assert declared_triangles(path) == 4  # of the fan


def two_squares(code: int) -> dict[str, Any]:
    """A glTF file of two squares apart as a strip with joints, after two triangles, whose mode is the default; the
    indices of both are in one view.
    """
    kind = np.dtype({5121: "<u1", 5123: "<u2", 5125: "<u4"}[code])
    points = np.array([[x, y, 0] for x in (0, 1, 5, 6) for y in (0, 1)], dtype="<f4")
    below, strip = [0, 6, 1, 0, 6, 7], [0, 2, 1, 3, 3, 4, 4, 6, 5, 7]
    rows = np.array(below + strip, dtype=kind)
    buffer = points.tobytes() + rows.tobytes()
    indices = {"bufferView": 1, "componentType": code, "type": "SCALAR"}
    of = {"attributes": {"POSITION": 0}}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [of | {"indices": 1}, of | {"indices": 2, "mode": 5}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "min": [0, 0, 0], "max": [6, 1, 0]},
            indices | {"count": len(below)},
            indices | {"count": len(strip), "byteOffset": len(below) * kind.itemsize},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": rows.nbytes},
        ],
        "buffers": [
            {
                "byteLength": len(buffer),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(buffer).decode(),
            }
        ],
    }


@pytest.mark.parametrize("code", [5121, 5123, 5125])
def test_gltf_strips_with_joints(code: int, tmp_path: Path) -> None:
    """Indices of all types; triangles without area, which join the strips, are no dropped faces."""
    path = tmp_path / "squares.gltf"
    path.write_text(json.dumps(two_squares(code)))
    mesh = pgccd.Mesh.load(path)
    a, b, c = mesh.vertices[mesh.faces.long()].numpy().transpose(1, 0, 2)
    doubled = np.cross(b - a, c - a)[:, 2]
    assert sorted(doubled.tolist()) == [1.0, 1.0, 1.0, 1.0, 6.0, 6.0] and mesh.dropped_faces == 0


def test_gltf_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "squares.gltf"
    content = two_squares(5123)
    content["accessors"][2]["sparse"] = {"count": 1}
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="^path: .*a glTF file with sparse indices, which cannot be read"):
        pgccd.Mesh.load(path)
    content = two_squares(5123)
    del content["buffers"][0]["uri"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="^path: .*a glTF file whose buffer 0 is missing"):
        pgccd.Mesh.load(path)


def with_unit(path: Path, unit: str) -> Path:
    """A copy of a 3MF file that states another unit."""
    changed = path.parent / "other.3mf"
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(changed, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, re.sub(rb' unit="[a-z]+"', f' unit="{unit}"'.encode(), content))
    return changed


def test_units_of_files(tmp_path: Path) -> None:
    """Collada and 3MF state one, glTF is in metres, and other files state none."""
    pytest.importorskip("collada")
    box = trimesh.creation.box([2.0, 3.0, 4.0])
    for kind, unit in (("stl", None), ("ply", None), ("obj", None), ("glb", 1.0), ("dae", 1.0), ("3mf", 1e-3)):
        path = exported(box, kind, tmp_path)
        plain = pgccd.Mesh.load(path)
        assert plain.unit == unit and float(plain.vertices[:, 2].max()) == 2.0
        state = plain.state_dict()
        assert pgccd.Mesh.from_state_dict(state).unit == unit
        del state["unit"]
        assert pgccd.Mesh.from_state_dict(state).unit is None
        for name, metres in (("m", 1.0), ("mm", 1e-3), ("in", 0.0254)):
            converted = pgccd.Mesh.load(path, unit=name)  # type: ignore[arg-type]
            expected = 2.0 if unit is None else 2.0 * unit / metres
            assert converted.unit == metres and float(converted.vertices[:, 2].max()) == pytest.approx(
                expected, rel=1e-6
            )
    # Of 3MF files, all that their format knows.
    for name, metres in (("micron", 1e-6), ("millimeter", 1e-3), ("centimeter", 1e-2), ("meter", 1.0)):
        assert pgccd.Mesh.load(with_unit(path, name)).unit == metres
    for name, metres in (("inch", 0.0254), ("foot", 0.3048)):
        path = with_unit(path, name)
        assert pgccd.Mesh.load(path).unit == metres
        for wanted, size in (("m", 2.0 * metres), ("cm", 200.0 * metres), ("ft", 2.0 * metres / 0.3048)):
            (mesh,) = pgccd.Mesh.load_all(path, unit=wanted)  # type: ignore[arg-type]
            assert float(mesh.vertices[:, 2].max()) == pytest.approx(size, rel=1e-6)
    with pytest.raises(ValueError, match="^path: .*other.3mf: expected lengths in one of meters, .*; got 'furlong'"):
        pgccd.Mesh.load(with_unit(path, "furlong"))
    inches = collada(box.vertices, triangles(box.faces), '<unit name="inch" meter="0.0254"/>')
    (tmp_path / "inches.dae").write_text(inches)
    assert pgccd.Mesh.load(tmp_path / "inches.dae").unit == 0.0254
    for number in ("-1", "0", "inf"):
        (tmp_path / "wrong.dae").write_text(inches.replace('meter="0.0254"', f'meter="{number}"'))
        with pytest.raises(ValueError, match="^path: .*wrong.dae: unit: expected a length > 0 in metres, got"):
            pgccd.Mesh.load(tmp_path / "wrong.dae")
    (mesh,) = pgccd.Mesh.load_all(tmp_path / "inches.dae", unit="m")
    assert float(mesh.vertices[:, 2].max()) == pytest.approx(2.0 * 0.0254, rel=1e-6)
    for unit, error in (("mile", ValueError), (1.0, TypeError)):
        with pytest.raises(error, match="^unit: expected one of"):
            pgccd.Mesh.load(tmp_path / "inches.dae", unit=unit)  # type: ignore[arg-type]


def test_robots_scenes_and_the_command_line_are_in_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("collada")
    pytest.importorskip("yourdfpy")
    box = trimesh.creation.box([200.0, 300.0, 400.0])
    millimetres = collada(box.vertices, triangles(box.faces), '<unit name="mm" meter="0.001"/>')
    (tmp_path / "mesh.dae").write_text(millimetres)
    link = (
        '<link name="l"><collision><geometry><mesh filename="mesh.dae" scale="1 -2 1"/></geometry></collision></link>'
    )
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{link}</robot>')
    mesh = pgccd.robots.load_urdf(tmp_path / "r.urdf").meshes[0]
    assert volume(mesh) == pytest.approx(2.0 * 0.024, rel=1e-5)
    np.savez(tmp_path / "poses.npz", position=np.zeros((2, 1, 3)), orientation=np.tile([1.0, 0, 0, 0], (2, 1, 1)))
    scene = {"meshes": ["mesh.dae"], "mesh_index": [0], "poses": "poses.npz"}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    loaded = pgccd.files.load_scene(tmp_path / "scene.json")[0]
    assert float(loaded.meshes.meshes[0].vertices[:, 2].max()) == pytest.approx(0.2, rel=1e-6)
    assert cli.main(["info", "--json", str(tmp_path / "mesh.dae")]) == 0
    (size,) = json.loads(capsys.readouterr().out)["meshes"]
    assert size["radius"] == pytest.approx(0.5 * np.linalg.norm([0.2, 0.3, 0.4]), rel=1e-6)
