"""Bad input raises an exception that names the argument; unusual but valid input does not."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.capacities import ON_GPU
from support.forked_job import ForkedJob
from support.shapes import Bodies, approaching, bumpy, tensors, tetrahedron

import pgccd


def bodies() -> Bodies:
    return approaching(np.random.default_rng(0), (0, 0), closeness=0.7)


def detect(**options: Any) -> pgccd.Contacts:
    b = bodies()
    return pgccd.detect(b.scene(), b.motion(), **options)


def scene(**options: Any) -> pgccd.Scene:
    return pgccd.Scene([tetrahedron()] * 2, **options)


def moved() -> pgccd.MovingBodies:
    b = bodies()
    return pgccd.MovingBodies.of(b.scene(), b.motion())


def poses(**changed: Any) -> dict[str, Any]:
    """Arguments of RigidMotion for three bodies."""
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1)
    whole = {"position_t0": torch.zeros(3, 3), "orientation_t0": unit, "position_t1": torch.ones(3, 3)}
    return whole | {"orientation_t1": unit.clone()} | changed


def velocities(**changed: Any) -> dict[str, Any]:
    """Arguments of RigidMotion.from_velocity for three bodies."""
    whole = {"position": torch.zeros(3, 3), "orientation": poses()["orientation_t0"]}
    whole |= {"linear_velocity": torch.ones(3, 3), "angular_velocity": torch.ones(3, 3), "dt": 0.1}
    return whole | changed


def one_bad(width: int, value: float, row: int = 1) -> torch.Tensor:
    x = torch.zeros(3, width)
    x[:, 0] = 1.0
    x[row, width - 1] = value
    return x


NAN, INF = float("nan"), float("inf")
TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]
CASES: dict[str, tuple[Callable[[], Any], str]] = {}


def case(name: str, call: Callable[[], Any], *words: str) -> None:
    """An error whose message starts with the argument's name and contains the other words, in that order."""
    CASES[name] = call, "^" + ".*".join(words)


def rigid(**changed: Any) -> Callable[[], Any]:
    """RigidMotion with some arguments changed."""
    return lambda: pgccd.RigidMotion(**poses(**changed))


def spinning(**changed: Any) -> Callable[[], Any]:
    """RigidMotion.from_velocity with some arguments changed."""
    return lambda: pgccd.RigidMotion.from_velocity(**velocities(**changed))


def resting(position: torch.Tensor, orientation: torch.Tensor) -> Callable[[], Any]:
    """RigidMotion.at_rest."""
    return lambda: pgccd.RigidMotion.at_rest(position, orientation)


def deforming(**changed: Any) -> Callable[[], Any]:
    """VertexMotion with some arguments changed."""
    return lambda: pgccd.VertexMotion(**({"x_t0": torch.ones(3, 3), "x_t1": torch.ones(3, 3)} | changed))


for _name in ("position_t0", "position_t1"):
    for _value in (NAN, INF, -INF):
        case(f"{_name} {_value}", rigid(**{_name: one_bad(3, _value)}), _name, "body 1", "finite")
    case(f"{_name} shape", rigid(**{_name: torch.zeros(3, 2)}), _name, "3")
    case(f"{_name} dtype", rigid(**{_name: torch.zeros(3, 3).int()}), _name, "float64")
    case(f"{_name} type", rigid(**{_name: np.zeros((3, 3)).tolist()}), _name, "tensor")
for _name in ("orientation_t0", "orientation_t1"):
    for _value in (NAN, INF, 0.05, -1.0):
        case(f"{_name} {_value}", rigid(**{_name: one_bad(4, _value)}), _name, "body 1", "unit")
    case(f"{_name} zero", rigid(**{_name: torch.zeros(3, 4)}), _name, "body 0", "unit")
    case(f"{_name} shape", rigid(**{_name: torch.zeros(2, 4)}), _name, "3, 4")
    case(f"{_name} dtype", rigid(**{_name: torch.zeros(3, 4).half()}), _name, "float64")
case("path", rigid(path="arc"), "path", "arc")
for _name in ("linear_velocity", "angular_velocity"):
    for _value in (NAN, INF):
        # An infinite velocity makes the position at t1 infinite, which may be the argument reported.
        case(f"{_name} {_value}", spinning(**{_name: one_bad(3, _value)}), f"(position_t1|{_name})", "body 1")
    case(f"{_name} shape", spinning(**{_name: torch.zeros(3)}), _name)
    case(f"{_name} dtype", spinning(**{_name: torch.zeros(3, 3).long()}), _name, "float64")
for _value in (NAN, INF, -0.1):
    case(f"dt {_value}", spinning(dt=_value), "dt")
case("turn overflows", lambda: detect_spinning(1e300, 1e200), "angular_velocity")
case("turn is beyond counting", lambda: detect_spinning(1e120, 1.0), "angular_velocity")
for _value in (NAN, INF):
    case(f"rest at {_value}", resting(one_bad(3, _value), poses()["orientation_t0"]), "position", "body 1")
case("rest turned", resting(torch.zeros(3, 3), one_bad(4, 0.05)), "orientation", "body 1", "unit")
case("rest shape", resting(torch.zeros(3, 3), torch.ones(2, 4)), "orientation", "3, 4")
for _name in ("x_t0", "x_t1"):
    for _value in (NAN, INF):
        case(f"{_name} {_value}", deforming(**{_name: one_bad(3, _value, 2)}), _name, "vertex 2")
case("x_t1 shape", lambda: pgccd.VertexMotion(torch.zeros(3, 3), torch.zeros(4, 3)), "x_t1", "3, 3")
case("x_t0 type", lambda: pgccd.VertexMotion([[0.0, 0, 0]], torch.zeros(1, 3)), "x_t0", "tensor")
case(
    "vertex count",
    lambda: pgccd.detect(scene(), pgccd.VertexMotion(torch.zeros(3, 3), torch.zeros(3, 3))),
    "motion",
    "8",
)
case("body count", lambda: pgccd.detect(scene(), pgccd.RigidMotion(**poses())), "motion", "3", "2")
for _value in (NAN, INF, -1e-9):
    case(f"min_separation {_value}", lambda v=_value: detect(min_separation=v), "min_separation")
    case(f"tolerance {_value}", lambda v=_value: detect(tolerance=v), "tolerance")
case("report", lambda: detect(report="last"), "report", "last")
case("broad_phase", lambda: detect(broad_phase="octree"), "broad_phase", "octree")
case("memory_budget", lambda: detect(memory_budget=0), "memory_budget")
case("axis", lambda: pgccd.broad.sweep(moved(), axis="w"), "axis")
case("mesh_index range", lambda: scene(mesh_index=[0, 2]), "mesh_index", "2 meshes")
case("mesh_index negative", lambda: scene(mesh_index=[0, -1]), "mesh_index")
case("mesh_index beyond int32", lambda: scene(mesh_index=[0, 2**32]), "mesh_index")
case("mesh_index float", lambda: scene(mesh_index=[0.0, 1.0]), "mesh_index", "integers")
case("mesh_index shape", lambda: scene(mesh_index=torch.zeros(2, 1).int()), "mesh_index")
case("meshes", lambda: pgccd.Scene([]), "meshes")
case("meshes type", lambda: pgccd.Scene([tetrahedron(), "robot.ply"]), r"meshes\[1\]", "robot.ply")  # type: ignore[list-item]
for _name in ("group", "mask", "world", "static"):
    case(f"{_name} count", lambda n=_name: scene(**{n: torch.tensor([True]) if n == "static" else [1]}), _name, "2")
for _name in ("group", "mask", "world"):
    case(f"{_name} float", lambda n=_name: scene(**{n: [0.5, 1.0]}), _name, "integers")
case("world range", lambda: scene(world=[0, 2**31]), "world")
case("self_collision count", lambda: scene(self_collision=[True]), "self_collision", "2")
case("self_collision type", lambda: scene(self_collision=[1, 0]), "self_collision", "bool")
case("self_collision number", lambda: scene(self_collision=1), "self_collision", "bool")
case("margin sign", lambda: scene(margin=[0.0, -1.0]), "margin", "body 1", ">= 0")
case("margin nan", lambda: scene(margin=[NAN, 0.0]), "margin", "body 0")
case("margin infinite", lambda: scene(margin=float("inf")), "margin", "finite")
case("margin count", lambda: scene(margin=[0.1, 0.1, 0.1]), "margin", "3")
case("margin type", lambda: scene(margin=[True, False]), "margin", "bool")
case("static type", lambda: scene(static=[0, 1]), "static", "bool")
case("no faces", lambda: pgccd.Mesh(TRIANGLE, np.zeros((0, 3), int)), "faces")
case("face range", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2], [0, 1, 3]]), "faces", "face 1", "3 vertices")
case("face negative", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, -1]]), "faces", "face 0")
case("face repeats", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2], [1, 1, 2]]), "faces", "face 1")
case("faces float", lambda: pgccd.Mesh(TRIANGLE, [[0.0, 1.0, 2.0]]), "faces", "integers")
case("faces shape", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2, 0]]), "faces", "shape")
case("vertices shape", lambda: pgccd.Mesh([[0.0, 1.0]], [[0, 1, 2]]), "vertices", "shape")
case("vertex nan", lambda: pgccd.Mesh([[0, 0, 0], [1, NAN, 0], [0, 1, 0]], [[0, 1, 2]]), "vertices", "vertex 1")
case("zero radius", lambda: pgccd.Mesh(np.ones((3, 3)), [[0, 1, 2]]), "vertices", "radius 0")
case("tiny radius", lambda: pgccd.Mesh(1e-40 * np.eye(3), [[0, 1, 2]]), "vertices", "radius")
case("huge radius", lambda: pgccd.Mesh(1e40 * np.eye(3), [[0, 1, 2]]), "vertices", "radius")
case("origin shape", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2]], [0.0, 1.0]), "origin", "3 numbers", "(2,)")
case("origin name", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2]], "middle"), "origin", "centroid", "middle")
case("origin nan", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2]], [0.0, NAN, 0.0]), "origin", "nan")
case("origin far", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2]], [1e13, 0.0, 0.0]), "origin", "1e.12 SBV radii")
case("origin open", lambda: pgccd.Mesh(TRIANGLE, [[0, 1, 2]], "center_of_mass"), "origin", "closed", "no triangle")
case(
    "origin inconsistent",
    lambda: pgccd.Mesh(np.eye(4, 3), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 3, 2]], "center_of_mass"),
    "origin",
    "more than one triangle",
)
case(
    "origin flat",
    lambda: pgccd.Mesh([*TRIANGLE, [1, 1, 0]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "center_of_mass"),
    "origin",
    "volume",
)
case(
    "from_trimesh",
    lambda: pgccd.Mesh.from_trimesh(object()),
    "mesh",
    "expected triangles, segments or points, got object",
)
QUERY = torch.zeros(2, 4, 3, dtype=torch.float64)
for _test in (pgccd.narrow.vertex_face, pgccd.narrow.edge_edge):
    _name = _test.__name__
    case(f"{_name} dtype", lambda t=_test: t(QUERY.half(), QUERY), "points_t0", "float64")
    case(f"{_name} dtypes", lambda t=_test: t(QUERY.float(), QUERY), "points_t1", "float32")
    case(f"{_name} type", lambda t=_test: t(QUERY, QUERY.tolist()), "points_t1")
    case(f"{_name} shape", lambda t=_test: t(QUERY, QUERY[:, :3]), "points_t1", "4, 3")
    case(f"{_name} count", lambda t=_test: t(QUERY, QUERY[:1]), "points_t1", "2, 4, 3")
    case(f"{_name} separation", lambda t=_test: t(QUERY, QUERY, min_separation=-1.0), "min_separation")
    case(f"{_name} tolerance", lambda t=_test: t(QUERY, QUERY, tolerance=NAN), "tolerance")
PAIR = torch.tensor([[0, 1]])
case("pairs dtype", lambda: pgccd.traverse.find_candidates(moved(), PAIR.int()), "pairs", "int64")
case("pairs shape", lambda: pgccd.traverse.find_candidates(moved(), PAIR[0]), "pairs", "shape")
for _rows in ([[0, 2]], [[-1, 1]], [[1, 0]], [[0, 1], [1, 1]]):
    case(f"pairs {_rows}", lambda r=_rows: pgccd.traverse.find_candidates(moved(), torch.tensor(r)), "pairs")
for _kind in ("other body", "rigid motion"):
    case(f"pair of one body, {_kind}", lambda k=_kind: one_body_as_pair(k), "pairs", "i < j")
case("horizon", lambda: pgccd.traverse.find_candidates(moved(), PAIR, horizon=torch.ones(2)), "horizon")
case(
    "horizon nan",
    lambda: pgccd.traverse.find_candidates(moved(), PAIR, horizon=torch.tensor([NAN]).double()),
    "horizon",
)
case("candidates", lambda: pgccd.narrow.find_contacts(moved(), PAIR, torch.zeros(1, 4)), "candidates", "int32")


def one_body_as_pair(kind: str) -> pgccd.Contacts:
    """Error for the pair (1, 1), which is invalid: only body 0 collides with itself, or nothing deforms."""
    b = bodies()
    ends = torch.cat([mesh.vertices for mesh in b.meshes])
    deforms = kind == "other body"
    motion = pgccd.VertexMotion(ends, ends) if deforms else b.motion()
    filtered = pgccd.Scene(b.meshes, self_collision=[True, not deforms])
    return pgccd.detect(filtered, motion, pairs=torch.tensor([[1, 1]]))


def detect_spinning(spin: float, dt: float) -> pgccd.Contacts:
    b = bodies()
    columns = tensors(b.position_t0, b.orientation_t0, b.velocity / dt, spin * b.rotation)
    return pgccd.detect(b.scene(), pgccd.RigidMotion.from_velocity(*columns, dt=dt))


@pytest.mark.parametrize("name", CASES)
def test_message_names_the_argument(name: str) -> None:
    call, pattern = CASES[name]
    with pytest.raises((ValueError, TypeError), match=pattern):
        call()


OUT_OF_RANGE = [[1, 0, 0, 0], [-1, 0, 0, 0], [0, 5, 0, 0], [0, 0, 100_000_000, 0], [0, 2, 0, 100_000_000]]
OUT_OF_RANGE += [[0, 1, -7, 0], [0, 1, 1, 0], [0, -1, 0, 0], [0, 3, 3, 0], [0, 3, 0, 1], [0, 4, 1, 0], [0, 4, 0, 3]]


def find_candidates() -> None:
    mesh = pgccd.Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    still = torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]] * 2)
    bodies = pgccd.MovingBodies.of(pgccd.Scene([mesh, mesh]), pgccd.RigidMotion(*still, *still))
    for row in OUT_OF_RANGE:
        sys.stderr.write(f"{row}\n")
        with pytest.raises((ValueError, RuntimeError), match="candidates"):
            pgccd.narrow.find_contacts(bodies, torch.tensor([[0, 1]]), torch.tensor([row], dtype=torch.int32))


def test_candidates_out_of_range(tmp_path: Path) -> None:
    # In a process of its own: an out-of-bounds read would crash this one.
    with ForkedJob(1, tmp_path, find_candidates) as job:
        assert job.finish() == [0], job.said


def test_files(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    with pytest.raises(FileNotFoundError, match="^path"):
        pgccd.Mesh.load(tmp_path / "nothing.ply")
    with pytest.raises(IsADirectoryError, match="^path"):
        pgccd.Mesh.load(tmp_path)
    broken = {
        "noise.ply": bytes(range(256)),
        "empty.stl": b"",
        "empty.obj": b"",
        "text.obj": b"this is no mesh\n",
        "picture.png": b"\x89PNG",
        "points.ply": b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        b"end_header\n0 0 0\n",
        "repeats.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2\n",
        "flat.obj": b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n",
        "range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
        "nan.obj": b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n",
    }
    for name, content in broken.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match="^path: .*" + name):
            pgccd.Mesh.load(tmp_path / name)


def test_faces_that_repeat_a_vertex_are_dropped_from_files(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / "some.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 2\n")
    assert len(pgccd.Mesh.load(tmp_path / "some.obj").faces) == 1


@pytest.mark.parametrize("exponent", [100, 150, 154, 160, 200, 300])
@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_far_beyond_sense_is_found_or_refused(exponent: int, path: Any) -> None:
    # Two bodies in the same place, one of which leaves along an absurdly long path: they certainly touch.
    b = approaching(np.random.default_rng(1), (0, 0), closeness=0.3)
    velocity = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]) * 10.0**exponent / 4
    try:
        motion = pgccd.RigidMotion(*tensors(-velocity, b.orientation_t0, velocity, b.orientation_t0), path=path)
        assert len(pgccd.detect(b.scene(), motion)) == 1
    except ValueError as error:
        assert str(error).startswith(("position_t0", "motion"))


@pytest.mark.parametrize("device", ON_GPU, indirect=True)
def test_device_of_every_argument(device: torch.device) -> None:
    b = bodies()
    for name in ("orientation_t0", "position_t1", "orientation_t1"):
        arguments = {k: v.to(device) for k, v in poses().items()} | {name: poses()[name]}
        with pytest.raises(ValueError, match=f"^{name}.*device"):
            pgccd.RigidMotion(**arguments)
    with pytest.raises(ValueError, match="^motion"):
        pgccd.detect(b.scene("cpu"), b.motion(device=device))
    with pytest.raises(ValueError, match="^device"):
        pgccd.Scene(pgccd.MeshSet(b.meshes), device=device)


def test_odd_but_valid(device: torch.device) -> None:
    b = bodies()
    empty = pgccd.Scene([tetrahedron()], [], device)
    none = pgccd.RigidMotion(*(torch.zeros(0, n, device=device) for n in (3, 4, 3, 4)))
    assert len(pgccd.detect(empty, none)) == 0 and empty.body_count == 0
    assert len(pgccd.collide(b.scene(device), b.motion(device=device), min_separation=1e6)) == 1
    flat = pgccd.Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 3]])  # one face of zero area
    assert len(flat.edges) == 5
    unused = pgccd.Mesh(
        np.concatenate([bumpy(np.random.default_rng(2), 0).vertices, [[9.0, 9, 9]]]),
        bumpy(np.random.default_rng(2), 0).faces,
    )
    assert unused.radius < 2 and len(unused.vertices) == 13
    single = pgccd.RigidMotion(**{k: v.to(device) for k, v in poses(position_t0=torch.zeros(3, 3).double()).items()})
    assert single.position_t1.dtype == torch.float64


def test_devices_that_are_not_there_are_named() -> None:
    """Before torch initialises a driver, whose errors name no argument."""
    missing = f"cuda:{torch.cuda.device_count()}"
    match = f"^device: {missing} is not available"
    scene = pgccd.Scene([tetrahedron()])
    with pytest.raises(ValueError, match=match):
        pgccd.Scene([tetrahedron()], device=missing)
    with pytest.raises(ValueError, match=match):
        scene.to(missing)
    with pytest.raises(ValueError, match=match):
        pgccd.Scene.from_state_dict(scene.state_dict(), missing)
    with pytest.raises(ValueError, match=match):
        pgccd.sim.Model(pgccd.sim.ModelConfig(robots=2), device=missing)
    for wrong in ("nonsense", missing):
        with pytest.raises(ValueError, match="^device: "):
            pgccd.distributed.connect(wrong)


def test_numbers_under_another_default_dtype() -> None:
    """Lists keep their digits, whatever the default dtype is."""
    torch.set_default_dtype(torch.float16)
    try:
        scene = pgccd.Scene([tetrahedron()], margin=[0.1])
    finally:
        torch.set_default_dtype(torch.float32)
    assert scene.margin is not None and scene.margin.tolist() == [0.1]
