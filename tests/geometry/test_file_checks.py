"""Mesh files that hold less or more than they declare, that name vertices which are not there, or whose reader is not
installed.
"""

from __future__ import annotations

import builtins
import copy
import json
import runpy
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd.geometry.file_checks import declared_triangles

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
FACES = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 2, 4]]
QUAD = struct.pack("<B4i", 4, 0, 1, 2, 3)
TRIANGLE = struct.pack("<B3i", 3, 0, 1, 4)


def stl_binary(declared: int = 4, records: int = 4) -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 1, *CORNERS[face].ravel(), 0) for face in FACES[:records]]
    return b"solid or not".ljust(80) + struct.pack("<I", declared) + b"".join(rows)


def stl_text(name: str = "part") -> str:
    rows = []
    for face in FACES:
        corners = "".join(f"  vertex {x} {y} {z}\n" for x, y, z in CORNERS[face])
        rows.append(f"facet normal 0 0 1\n outer loop\n{corners} endloop\nendfacet\n")
    return f"solid {name}\n{''.join(rows)}endsolid {name}\n"


def ply_header(kind: str, vertices: int, faces: int, properties: str = "list uchar int vertex_indices") -> str:
    of_faces = "".join(f"property {each}\n" for each in properties.split(";"))
    of_vertices = "property float x\nproperty float y\nproperty float z\n"
    rows = f"element vertex {vertices}\n{of_vertices}element face {faces}\n{of_faces}"
    return f"ply\nformat {kind} 1.0\ncomment some rows\n{rows}end_header\n"


def ply_text(vertices: int = 5, faces: int = 4) -> str:
    rows = [" ".join(map(str, row)) for row in CORNERS.tolist()] + [f"3 {i} {j} {k}" for i, j, k in FACES]
    return ply_header("ascii", vertices, faces) + "\n".join(rows) + "\n"


def ply_binary(rows: list[bytes], vertices: int = 5, faces: int | None = None, **options: str) -> bytes:
    points = CORNERS.astype("<f4").tobytes()
    count = len(rows) if faces is None else faces
    return ply_header("binary_little_endian", vertices, count, **options).encode() + points + b"".join(rows)


def ply_big(rows: list[bytes]) -> bytes:
    """As `ply_binary`, with the most significant bytes first; of rows of int32 corners."""
    header = ply_header("binary_big_endian", 5, len(rows))
    turned = [row[:1] + np.frombuffer(row[1:], "<i4").astype(">i4").tobytes() for row in rows]
    return header.encode() + CORNERS.astype(">f4").tobytes() + b"".join(turned)


def off(vertices: int = 5, faces: int = 4) -> str:
    rows = [" ".join(map(str, row)) for row in CORNERS.tolist()] + [f"3 {i} {j} {k}" for i, j, k in FACES]
    return f"OFF\n{vertices} {faces} 0\n" + "\n".join(rows) + "\n"


def obj(*faces: str) -> str:
    return "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(f"f {face}\n" for face in faces)


COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_materials><material id="paint"><instance_effect url="#missing"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="15">{corners}</float_array>
<technique_common><accessor source="#a" count="5" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
</source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
{faces}</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#{name}"><bind_material><technique_common>
<instance_material symbol="m" target="#paint"/></technique_common></bind_material></instance_geometry></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def collada(faces: str, name: str = "g") -> str:
    """A file whose material has no effect."""
    corners = " ".join(str(x) for corner in CORNERS for x in corner)
    faces = faces.replace("/>", ' material="m"><input semantic="VERTEX" source="#v" offset="0"/>')
    return COLLADA.format(corners=corners, faces=faces, name=name)


def mujoco_mesh(faces: int = 2) -> bytes:
    """With texture coordinates, which are not read."""
    corners = struct.pack("<15f", *(x for corner in CORNERS for x in corner))
    return struct.pack("<4i", 5, 0, 5, faces) + corners + bytes(40) + struct.pack("<6i", 0, 1, 2, 0, 1, 3)


SKIN = '<library_controllers><controller id="c"><skin source="#g"/></controller></library_controllers>'
TRIANGLES = '<triangles count="2"/><p>0 1 2 0 1 3</p></triangles>'

STRIP_WITH_NORMALS = (
    '<tristrips count="1"/><input semantic="NORMAL" source="#p" offset="1"></input><p>0 0 1 0 2 0 3 0</p></tristrips>'
)
OTHER_SCENE = '<visual_scene id="other"><node><instance_geometry url="#g"/></node></visual_scene>'

WHOLE: dict[str, tuple[bytes | str, int]] = {
    "binary.stl": (stl_binary(), 4),
    "text.stl": (stl_text(), 4),
    "text.ply": (ply_text(), 4),
    "windows.ply": (ply_text().replace("\n", "\r\n"), 4),
    "binary.ply": (ply_binary([TRIANGLE] * 3), 3),
    "quads.ply": (ply_binary([QUAD] * 3), 6),
    "flags.ply": (ply_binary([b"\1" + TRIANGLE] * 2, properties="uchar flag;list uchar int vertex_indices"), 2),
    "after.ply": (ply_binary([TRIANGLE + b"\1"] * 2, properties="list uchar int vertex_index;uchar flag"), 2),
    "uv.ply": (
        ply_binary(
            [TRIANGLE + struct.pack("<B6f", 6, *[0.0] * 6)] * 2,
            properties="list uchar int vertex_indices;list uchar float texcoord",
        ),
        2,
    ),
    "floats.ply": (ply_binary([struct.pack("<B3f", 3, 0, 1, 2)], properties="list uchar float vertex_indices"), 1),
    "points.ply": (ply_text().replace("3 0 1 2", "3 0.0 1 2.0", 1), 4),
    "edge.ply": (ply_text().replace("3 0 1 2", "2 0 1", 1), 3),  # lists may be of any length
    "edges.ply": (ply_binary([TRIANGLE, struct.pack("<B2i", 2, 0, 1)]), 1),
    "edge.off": (off().replace("3 0 1 2", "2 0 1", 1), 3),
    "plain.off": (off(), 4),
    "comment.off": (off().replace("OFF\n", "OFF # a comment\n# another\n"), 4),
    "colours.off": (off().replace("3 1 2 4", "4 0 1 2 3 255 0 0"), 5),
    "plain.obj": (obj("1 2 3", "1/1/1 3//1 4/1"), 2),
    "polygon.obj": (obj("1 2 3 4 5", "1 2 5"), 4),
    "continued.obj": (obj("1 2 \\\n3"), 1),
    "backwards.obj": (obj("-5 -4 -3"), 1),
    "amid.obj": (obj("-3 -2 -1") + obj("-3 -2 -1"), 2),
    "comments.obj": ("# a\n" + obj("1 2 3 # b", "1/1 3//1 4/1#c").replace("v 0.0 0.0 0.0", "v 0.0 0.0 0.0 # d"), 2),
    "comments_uv.obj": (obj() + "vt 0 0 # a\nvn 0 0 1# b\no part # c\n" + "f 1/1/1 2/1/1 3/1/1\t# d\n", 1),
    "quad_comments.obj": (obj("1 2 3 4 # b").replace("v 0.0 0.0 0.0", "v 0.0 0.0 0.0 # d"), 2),
    "mixed.ply": (ply_binary([TRIANGLE, QUAD]), 3),
    "big.ply": (ply_big([TRIANGLE] * 3), 3),
    "big_mixed.ply": (ply_big([TRIANGLE, QUAD]), 3),
    "triangles.dae": (collada(TRIANGLES), 2),
    "normals.dae": (collada(STRIP_WITH_NORMALS), 2),
    "scenes.dae": (collada(TRIANGLES).replace("</library_v", OTHER_SCENE + "</library_v"), 2),
    "fans.dae": (collada(TRIANGLES + '<trifans count="1"/><p>0 1 2 3</p></trifans>'), 4),
    "strips.dae": (collada('<tristrips count="1"/><p>0 1 2 3</p></tristrips>'), 2),
    "polygons.dae": (collada('<polylist count="2"/><vcount>3 4</vcount><p>0 1 2 0 1 2 3</p></polylist>'), 3),
}

BROKEN: dict[str, tuple[bytes | str, str]] = {
    "truncated.stl": (stl_binary()[:-50], "declares 4 triangles of 50 bytes, but 150 bytes follow"),
    "cut.stl": (stl_binary()[:-7], "declares 4 triangles of 50 bytes, but 193 bytes follow"),
    "more.stl": (stl_binary(9), "declares 9 triangles of 50 bytes, but 200 bytes follow"),
    "fewer.stl": (stl_binary(2), "declares 2 triangles of 50 bytes, but 200 bytes follow"),
    "header.stl": (stl_binary()[:84], "declares 4 triangles of 50 bytes, but 0 bytes follow"),
    "text.stl": (stl_text()[:-120], "3 of them ended.* the file is truncated"),
    "upper.stl": (stl_text().upper()[:-120], "3 of them ended.* the file is truncated"),
    "solid.stl": (stl_text().rsplit("\n", 2)[0], "4 of them ended, and 0 of 1 solids: the file is truncated"),
    "second.stl": (stl_text() + stl_text("other")[:-120], "1 of 2 solids: the file is truncated"),
    "corner.stl": (stl_text().replace("  vertex 1.0 1.0 0.0\n", "", 1), "4 facets with 11 vertices, 4 of them ended"),
    "facet.stl": (stl_text().replace("endfacet\n", "", 1), "4 facets with 12 vertices, 3 of them ended"),
    "rows.ply": (ply_text().rsplit("\n", 3)[0], "declares 4 rows of element face, but holds 2 whole"),
    "word.ply": (ply_text().strip().rsplit(" ", 1)[0], "declares 4 rows of element face, but holds 3 whole"),
    "faces.ply": (ply_text(faces=7), "declares 7 rows of element face, but holds 4 whole"),
    "vertices.ply": (ply_text(vertices=6), "declares 4 rows of element face, but holds 3 whole"),
    "beyond.ply": (ply_text(faces=2), "more rows than it declares"),
    "shifted.ply": (ply_text(vertices=4), "'0.5' as the length of a list"),
    "cut.ply": (ply_binary([TRIANGLE] * 3)[:-3], "declares 3 rows of element face, but holds 2 whole"),
    "no_faces.ply": (ply_binary([], faces=3), "declares 3 rows of element face, but holds 0 whole"),
    "no_points.ply": (ply_binary([])[:-30], "declares 5 rows of element vertex, but holds 2 whole"),
    "uv.ply": (WHOLE["uv.ply"][0][:-4], "declares 2 rows of element face, but holds 1 whole"),
    "above_text.ply": (ply_text().replace("3 0 1 2", "3 0 1 5"), r"face 0 \(line 16\): \[0, 1, 5\]: there are 5 verti"),
    "below_text.ply": (ply_text().replace("3 0 1 2", "3 0 1 -1"), r"face 0 \(line 16\): \[0, 1, -1\]: there are 5 ver"),
    "part_text.ply": (ply_text().replace("3 0 1 2", "3 0 1.5 2"), r"face 0 \(line 16\): .*: expected vertex indices"),
    "nan_text.ply": (ply_text().replace("3 0 1 2", "3 0 nan 2"), r"face 0 \(line 16\): .*: expected vertex indices"),
    "quad_text.ply": (ply_text().replace("3 0 1 2", "4 0 1 2.5 3"), r"face 0 \(line 16\): .*: expected vertex indices"),
    "letter_text.ply": (ply_text().replace("3 0 1 2", "3 0 x 2"), "line 16: could not convert string"),
    "letter.ply": (ply_text().replace("0.0 0.0 0.0", "0.0 y 0.0"), "line 11: could not convert string"),
    "above.ply": (
        ply_binary([TRIANGLE, struct.pack("<B3i", 3, 0, 1, 5)]),
        r"face 1: \[0, 1, 5\]: there are 5 vertices",
    ),
    "below.ply": (ply_binary([TRIANGLE, struct.pack("<B3i", 3, 0, 1, -1)]), r"face 1: \[0, 1, -1\]: there are 5 vert"),
    **{
        f"{name}.ply": (
            ply_binary([struct.pack("<B3f", 3, 0, 1, at)], properties="list uchar float vertex_index"),
            "face 0: .*: expected vertex indices",
        )
        for name, at in (("part", 1.5), ("nan", np.nan), ("infinite", np.inf))
    },
    "above.off": (off().replace("3 0 1 2", "3 0 1 5"), r"line 8: face \[0, 1, 5\]: there are 5 vertices"),
    "below.off": (off().replace("3 0 1 2", "3 0 1 -1"), r"line 8: face \[0, 1, -1\]: there are 5 vertices"),
    "part.off": (off().replace("3 0 1 2", "3 0 1.5 2"), "line 8: face '3 0 1.5 2': expected vertex indices"),
    "letter.off": (off().replace("3 0 1 2", "x 0 1 2"), "line 8: face 'x 0 1 2': expected vertex indices"),
    "part.obj": (obj("1 2 3", "1 2 3.5"), "line 7: face 1: '1 2 3.5': expected vertex indices"),
    "continued.obj": (obj("1 \\\n2 3", "1 2"), "line 8: face 1: '1 2': expected three corners or more"),
    "letter.obj": ("# a\n" + obj("1 2 3").replace("v 0.0 0.0 0.0", "v 0.0 y 0.0"), "line 2: 'v 0.0 y 0.0': expected t"),
    "pair.obj": (obj("1 2 3").replace("v 0.0 0.0 0.0", "v 0.0 0.0"), "line 1: 'v 0.0 0.0': expected three numbers"),
    "rows.off": (off().rsplit("\n", 3)[0], "declares 4 rows of faces, but holds 2 whole"),
    "word.off": (off().strip().rsplit(" ", 1)[0], "declares 4 rows of faces, but holds 3 whole"),
    "vertices.off": (off(vertices=11), "declares 11 rows of vertices, but holds 9 whole"),
    "short.off": (off().replace("1.0 1.0 0.0", "1.0 1.0"), "declares 5 rows of vertices, but holds 4 whole"),
    "beyond.off": (off(faces=3), "more rows than it declares"),
    "numbers.off": ("OFF\nmany few\n", "without the numbers of vertices and faces"),
    "zero.obj": (obj("1 2 3", "0 1 2"), "face 1: '0 1 2': vertices of an OBJ file are numbered from 1"),
    "zero_uv.obj": (obj("1 2 3", "2/1 3/1 0/1"), "face 1: '2/1 3/1 0/1': vertices of an OBJ file are numbered"),
    "range.obj": (obj("1 2 6"), "face 0: '1 2 6': there are 5 vertices"),
    "below.obj": (obj("-1 -2 -6"), "face 0: '-1 -2 -6': there are 5 vertices"),
    "cut.obj": (obj("1 2 3", "1 2"), "face 1: '1 2': expected three corners or more"),
    "word.obj": (obj("1 2 x"), "face 0: '1 2 x': expected vertex indices"),
    "amid.obj": (obj("-3 -2 -1", "-3 -2 -6") + obj("1 2 3"), "face 1: .* counts backwards beyond the first vertex"),
    "skin.dae": (
        collada(TRIANGLES)
        .replace('instance_geometry url="#g"', 'instance_controller url="#c"')
        .replace("</instance_geometry>", "</instance_controller>")
        .replace("<library_v", SKIN + "<library_v", 1),
        "it holds no triangles",
    ),
    "both.dae": (
        collada(TRIANGLES)
        .replace("<node>", '<node><instance_controller url="#c"/>')
        .replace("<library_v", SKIN + "<library_v", 1),
        "trimesh reads 2 of its 4 triangles",
    ),
    "other.dae": (collada(TRIANGLES, "h"), "without the geometry '#h' of its scene"),
    "cut.dae": (collada(TRIANGLES)[:-30], "a Collada file that is no XML: "),
    "cut.msh": (mujoco_mesh()[:-4], "MuJoCo, whose 5 vertices and 2 faces make 140 bytes, got 136"),
    "faces.msh": (mujoco_mesh(3), "MuJoCo, whose 5 vertices and 3 faces make 152 bytes, got 140"),
    "longer.msh": (mujoco_mesh() + bytes(12), "MuJoCo, whose 5 vertices and 2 faces make 140 bytes, got 152"),
    "negative.msh": (struct.pack("<4i", 5, -2, 3, 0) + bytes(60), "a file: expected a binary mesh of MuJoCo$"),
    "short.msh": (b"12345", "a file: expected a binary mesh of MuJoCo$"),
    "gmsh.msh": ("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n", "a mesh of Gmsh: expected a binary mesh of MuJoCo"),
    "indented.obj": (obj("1 2 3") + "  f 1 2 4\n", "trimesh reads 1 of its 2 triangles"),
}


def written(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def require_readers(name: str) -> None:
    """Skips a test of this file where the packages that read it are missing."""
    pytest.importorskip("trimesh")
    if name.endswith(".dae"):
        pytest.importorskip("collada")


@pytest.mark.parametrize("name", WHOLE)
def test_whole_files_are_read(tmp_path: Path, name: str) -> None:
    require_readers(name)
    content, triangles = WHOLE[name]
    path = written(tmp_path, name, content)
    assert declared_triangles(path) == triangles
    assert len(pgccd.Mesh.load(path).faces) == triangles
    assert sum(len(mesh.faces) for mesh in pgccd.Mesh.load_all(path)) == triangles


def test_meshes_of_mujoco(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    mesh = pgccd.Mesh.load(written(tmp_path, "whole.msh", mujoco_mesh()))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3]]
    assert np.array_equal((mesh.vertices + mesh.origin).numpy(), np.array(CORNERS, dtype=np.float32))


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_triangles_of_gltf_files_are_counted(tmp_path: Path, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    scene = trimesh.Scene([box, trimesh.creation.icosphere(1)])
    scene.add_geometry(box, geom_name="again", transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    exported = scene.export(file_type=suffix)
    if suffix == "glb":
        path = written(tmp_path, "scene.glb", exported)
        assert declared_triangles(path) == len(pgccd.Mesh.load(path).faces) == 104
        return
    for name, content in exported.items():
        written(tmp_path, name, content)
    (path,) = tmp_path.glob("*.gltf")
    assert declared_triangles(path) == len(pgccd.Mesh.load(path).faces) == 104
    whole = json.loads(path.read_text())
    second = copy.deepcopy(whole) | {"scenes": [{"nodes": []}, *whole["scenes"]], "scene": 1}
    path.write_text(json.dumps(second))
    assert declared_triangles(path) == len(pgccd.Mesh.load(path).faces) == 104
    nested = copy.deepcopy(whole)
    for scene in nested["scenes"]:
        nested["nodes"].append({"children": scene["nodes"]})
        scene["nodes"] = [len(nested["nodes"]) - 1]
    path.write_text(json.dumps(nested))
    assert declared_triangles(path) == len(pgccd.Mesh.load(path).faces) == 104
    lost = copy.deepcopy(whole)
    next(node for node in lost["nodes"] if "mesh" in node)["mesh"] = 9
    path.write_text(json.dumps(lost))
    with pytest.raises(ValueError, match="^path: .* cannot be read as a mesh: a glTF file with broken references"):
        pgccd.Mesh.load(path)


@pytest.mark.parametrize("name", BROKEN)
def test_nothing_is_dropped_silently(tmp_path: Path, name: str) -> None:
    require_readers(name)
    content, message = BROKEN[name]
    path = written(tmp_path, name, content)
    for load in (pgccd.Mesh.load, pgccd.Mesh.load_all):
        with pytest.raises(ValueError, match=f"^path: .*{name} cannot be read as a mesh: .*{message}"):
            load(path)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "off", "glb"])
def test_every_truncation_is_refused(tmp_path: Path, suffix: str) -> None:
    """At any byte but those of trailing white space; a number cut in its digits cannot be seen in text."""
    trimesh = pytest.importorskip("trimesh")
    content = trimesh.creation.icosahedron().export(file_type=suffix)
    content = content if isinstance(content, bytes) else content.encode()
    is_text = suffix in ("obj", "off")
    cuts = range(1, len(content), 7) if not is_text else np.flatnonzero(np.frombuffer(content, np.uint8) == ord(" "))
    for cut in cuts:
        try:
            mesh = pgccd.Mesh.load(written(tmp_path, f"cut.{suffix}", content[:cut]))
        except (ValueError, ImportError):
            continue
        # An OBJ file does not declare its rows: whole rows of faces may be missing.
        assert suffix == "obj" and content[:cut].rstrip().endswith(b"\nf"), (cut, mesh)


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize(
    ("name", "content", "package"),
    [
        ("part.3mf", b"PK\3\4", "lxml"),
        ("part.dae", b"<COLLADA/>", "pycollada"),
        ("latin.obj", "# größe\n".encode("latin-1") + obj("1 2 3").encode(), "charset-normalizer"),
    ],
)
def test_readers_that_are_not_installed_are_named(
    tmp_path: Path, name: str, content: bytes, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    trimesh = pytest.importorskip("trimesh")
    module = {"pycollada": "collada"}.get(package, package.replace("-", "_"))
    import_module = builtins.__import__

    def without(wanted: str, *rest: Any, **more: Any) -> Any:
        if wanted == module:
            raise ModuleNotFoundError(f"No module named {wanted!r}")
        return import_module(wanted, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.setattr(trimesh.util, "has_module", lambda wanted: wanted != module)
    # trimesh looks for the others when it is imported.
    for format_of, loaders in (("threemf", "_three_loaders"), ("dae", "_collada_loaders")):
        found = runpy.run_module(f"trimesh.exchange.{format_of}")[loaders]
        monkeypatch.setattr(trimesh.exchange.load, "mesh_loaders", trimesh.exchange.load.mesh_loaders | found)
    path = written(tmp_path, name, content)
    with pytest.raises(ImportError, match=f"^path: .*{name} cannot be read without {package}: pip install {package}"):
        pgccd.Mesh.load(path)


def far_away(features: float) -> tuple[np.ndarray, np.ndarray]:
    """A pyramid of size 1 and a small one, at a distance of 10^7."""
    points = np.concatenate([CORNERS, features * CORNERS]) + 1e7
    return points, np.concatenate([FACES, np.array(FACES) + 5])


@pytest.mark.parametrize("kind", ["array", "tensor", "file"])
def test_coordinates_rounded_away_by_float32(tmp_path: Path, kind: str) -> None:
    def make(points: np.ndarray, faces: np.ndarray) -> pgccd.Mesh:
        if kind == "array":
            return pgccd.Mesh(points.astype(np.float32), faces)
        if kind == "tensor":
            return pgccd.Mesh(torch.tensor(points, dtype=torch.float32), faces)
        rows = [struct.pack("<12fH", 0, 0, 1, *points[face].ravel(), 0) for face in faces]
        content = bytes(80) + struct.pack("<I", len(rows)) + b"".join(rows)
        return pgccd.Mesh.load(written(tmp_path, "far.stl", content))

    if kind == "file":
        pytest.importorskip("trimesh")
    points, faces = far_away(1e-3)
    points[:5] = 100.0 * CORNERS + 1e7  # a hundred times the rounding
    with pytest.warns(
        UserWarning, match="^.*: float32 has distorted 4 of 8 faces: the edges of face 4 .* multiples of 1\\."
    ):
        make(points, faces)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(points - 1e7, faces)
        pgccd.Mesh(points, faces)
        pgccd.Mesh(points.tolist(), faces)


def test_empty_files_and_folders_are_named(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    with pytest.raises(ValueError, match=r"^path: .*empty\.ply is empty \(0 bytes\)$"):
        pgccd.Mesh.load(written(tmp_path, "empty.ply", b""))
    with pytest.raises(IsADirectoryError, match=r"^path: .* is a folder: expected a mesh file$"):
        pgccd.Mesh.load_all(tmp_path)


def test_objects_come_in_the_order_of_their_file(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    names = ["zeta", "alpha", "mid"]
    scene = trimesh.Scene()
    for number, name in enumerate(names):
        scene.add_geometry(trimesh.creation.box((1.0 + number,) * 3), node_name=name, geom_name=name)
    scene.export(tmp_path / "three.glb")
    assert [mesh.name for mesh in pgccd.Mesh.load_all(tmp_path / "three.glb")] == names
