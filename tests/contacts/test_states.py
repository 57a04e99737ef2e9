"""State dictionaries, arrays of other libraries, scenes of some bodies, and the earliest contacts of worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.cases import mostly_slow
from support.gradients import meshes
from support.reports import detected
from support.same_bits import assert_same
from torch import Tensor

import pgccd


def scattered(count: int, device: torch.device, seed: int = 0) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Bodies of several meshes in worlds of four, with all optional columns."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=random).to(device)

    shapes = [*meshes()[:2], pgccd.Mesh.icosphere(0.7, 1, origin=(0.3, 0.1, 1e-3))]
    index = torch.randint(0, 3, (count,), generator=random).to(device)
    rows = torch.arange(count, device=device)
    scene = pgccd.Scene(
        shapes,
        index,
        device,
        world=rows // 4,
        margin=0.01 + 0.02 * normal(count).abs(),
        static=rows % 4 == 3,
        group=1 + rows % 2,
        mask=torch.full_like(rows, 3),
        self_collision=rows % 3 == 0,
        exclude=[(k, k + 1) for k in range(0, count - 1, 8)],
    )
    q = [torch.nn.functional.normalize(normal(count, 4), dim=1) for _ in range(2)]
    x = 1.6 * normal(count, 3)
    return scene, pgccd.RigidMotion(x, q[0], -0.5 * x, q[1])


def saved(state: Any, path: Path) -> Any:
    torch.save(state, path)
    return torch.load(path, weights_only=True)


@pytest.mark.parametrize("report", ["any", "first", "all", "earliest"])
def test_states_are_the_same_bits(report: Any, tmp_path: Path, device: torch.device) -> None:
    scene, motion = scattered(24, device)
    hits = detected(scene, motion, report)
    assert len(hits) > 0
    kind = type(hits)
    again = kind.from_state_dict(saved(hits.state_dict(), tmp_path / "hits"))
    assert again == hits and again.stats.pcs == hits.stats.pcs
    assert torch.equal(again.may_collide("body"), hits.may_collide("body"))
    if isinstance(hits, pgccd.Contacts):
        assert isinstance(again, pgccd.Contacts)
        assert torch.equal(again.first_toi("world"), hits.first_toi("world"))
    there = pgccd.Scene.from_state_dict(saved(scene.state_dict(), tmp_path / "scene"), device)
    path = pgccd.RigidMotion.from_state_dict(saved(motion.state_dict(), tmp_path / "motion"))
    assert_same(detected(there, path, report), hits)


def test_states_of_other_motions(tmp_path: Path, device: torch.device) -> None:
    scene, motion = scattered(8, device)
    linear = pgccd.RigidMotion.from_rotation(
        motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation, "linear"
    )
    again = pgccd.RigidMotion.from_state_dict(saved(linear.state_dict(), tmp_path / "linear"))
    assert again.path == "linear" and torch.equal(again.rotation, linear.rotation)
    ends = torch.randn(scene.layout.vertex_count, 3, dtype=torch.float64, device=device)
    deforming = pgccd.VertexMotion(ends, ends + 0.3)
    moved = pgccd.VertexMotion.from_state_dict(saved(deforming.state_dict(), tmp_path / "vertices"))
    same = pgccd.Scene.from_state_dict(saved(scene.state_dict(), tmp_path / "scene"), device)
    assert_same(pgccd.detect(same, moved, "all"), pgccd.detect(scene, deforming, "all"))
    steps = torch.stack([motion.position_t0, motion.position_t1])
    turns = motion.orientation_t0.expand(2, -1, -1)
    hits = pgccd.detect(scene, pgccd.Trajectory(steps, turns), "all")
    loaded = pgccd.TrajectoryContacts.from_state_dict(saved(hits.state_dict(), tmp_path / "hits"))
    assert loaded == hits and torch.equal(loaded.first_toi("body"), hits.first_toi("body"))


@pytest.mark.parametrize("dtype", mostly_slow([torch.float32, torch.float64], [torch.float32]))
def test_states_of_trajectories(dtype: torch.dtype, tmp_path: Path, device: torch.device) -> None:
    """Also of those given in float32, whose orientations and rotations agree only up to its rounding."""
    scene, motion = scattered(24, device)
    generator = torch.Generator().manual_seed(3)
    spin = 4.0 * torch.randn(2, 24, 3, generator=generator, dtype=torch.float64).to(device)
    ways = torch.stack([motion.position_t0, motion.position_t1, motion.position_t0])
    turns = pgccd.Trajectory(ways, motion.orientation_t0, rotation=spin).orientation
    assert turns is not None
    margin = torch.linspace(0.0, 0.1, 48, dtype=torch.float64, device=device).view(2, 24)
    ends = torch.randn((3, scene.layout.vertex_count, 3), generator=generator, dtype=torch.float64).to(device)
    for k, path in enumerate(
        (
            pgccd.Trajectory(ways.to(dtype), turns.to(dtype), "linear", rotation=spin.to(dtype), margin=margin),
            pgccd.Trajectory(ways, turns.to(dtype)),
            pgccd.Trajectory(ends.to(dtype), margin=margin.to(dtype)),
        )
    ):
        state = saved(path.state_dict(), tmp_path / str(k))
        again = pgccd.Trajectory.from_state_dict(state)
        for name in ("position", "orientation", "rotation", "margin"):
            own, other = getattr(path, name), getattr(again, name)
            assert (own is None and other is None) or torch.equal(own, other), name
        assert again.path == path.path and again.device.type == device.type
        assert_same(pgccd.detect(scene, again, "all"), pgccd.detect(scene, path, "all"))
    for name, wrong in (
        ("path", "arc"),
        ("rounding", 1.0),
        ("rounding", "no"),
        ("orientation", turns),
        ("rotation", spin),
        ("position", ends.int()),
        ("margin", -margin),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^{name}: "):
            pgccd.Trajectory.from_state_dict(state | {name: wrong})
    with pytest.raises(ValueError, match="^state: has no entry 'rounding'"):
        pgccd.Trajectory.from_state_dict({name: value for name, value in state.items() if name != "rounding"})


def test_states_keep_what_files_say() -> None:
    mesh = pgccd.Mesh.box([1.0, 2.0, 3.0])
    mesh.name, mesh.dropped_faces, mesh.source_vertex = "box", 2, torch.arange(8)
    again = pgccd.Mesh.from_state_dict(mesh.state_dict())
    assert again.name == "box" and again.dropped_faces == 2 and again.radius == mesh.radius
    assert torch.equal(again.source_vertex, mesh.source_vertex)  # type: ignore[arg-type]
    for name in ("vertices", "faces", "edges", "_node_blocks", "_corners", "_node_supports"):
        assert torch.equal(getattr(again, name).nan_to_num(), getattr(mesh, name).nan_to_num()), name


def test_wrong_states_are_named() -> None:
    scene, motion = scattered(8, torch.device("cpu"))
    hits = pgccd.detect(scene, motion)
    state = scene.state_dict()
    with pytest.raises(ValueError, match="^state: has no entry 'margin'"):
        pgccd.Scene.from_state_dict({name: value for name, value in state.items() if name != "margin"})
    with pytest.raises(ValueError, match="^mesh_index: body 0: expected a mesh"):
        pgccd.Scene.from_state_dict(state | {"mesh_index": scene.mesh_index + 9})
    broken = state["meshes"][0] | {"faces": state["meshes"][0]["faces"] + 7}
    with pytest.raises(ValueError, match="^faces: face 0"):
        pgccd.Scene.from_state_dict(state | {"meshes": [broken, *state["meshes"][1:]]})
    with pytest.raises(TypeError, match="^state: expected a dictionary"):
        pgccd.RigidMotion.from_state_dict(motion)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^state: expected entries .*got 'speed'"):
        pgccd.VertexMotion.from_state_dict({"x_t0": torch.zeros(3, 3), "x_t1": torch.zeros(3, 3), "speed": 1})
    with pytest.raises(TypeError, match=r"^toi: expected torch.float64"):
        pgccd.Contacts.from_state_dict(hits.state_dict() | {"toi": hits.toi.float()})
    with pytest.raises(ValueError, match="^point: expected shape"):
        pgccd.Contacts.from_state_dict(hits.state_dict() | {"point": hits.point[:, :2]})
    # Else they would read as free.
    for name, values, problem in [
        ("pairs", hits.pairs - 100, "row 0: expected numbers from 0 to 7"),
        ("pairs", hits.pairs + 8, "row 0: expected numbers from 0 to 7"),
        ("toi", hits.toi + torch.inf, "row 0: expected numbers from 0.0 to 1.0, got inf"),
        ("toi", hits.toi * torch.nan, "row 0: expected numbers from 0.0 to 1.0, got nan"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}: {problem}"):
            pgccd.Contacts.from_state_dict(hits.state_dict() | {name: values})
    of_ranks = hits.state_dict() | {"pairs": hits.pairs + 8, "body_count": None, "world": None}
    assert pgccd.Contacts.from_state_dict(of_ranks).pairs.max() >= 8
    for name, value, problem in [
        ("body_count", 7, "world: expected shape"),
        ("body_count", -1, "body_count: expected a number of bodies >= 0, got -1"),
        ("body_count", None, "world: expected None where there is no body_count"),
        ("world", torch.zeros(3, dtype=torch.int32), r"world: expected shape \(8,\)"),
        ("world", torch.zeros(8), "world: expected torch.int32"),
        ("world", torch.full((8,), -1, dtype=torch.int32), "world: body 0: expected an id"),
    ]:
        with pytest.raises((TypeError, ValueError), match=f"^{problem}"):
            pgccd.Contacts.from_state_dict(hits.state_dict() | {name: value})
    with pytest.raises(TypeError, match="^static: expected bool"):
        pgccd.Scene.from_state_dict(state | {"static": [0, 1] * 4})
    mesh = state["meshes"][0]
    for name, value in [("name", 3), ("welded_vertices", None), ("dropped_faces", "x"), ("source_face", [1, 2])]:
        with pytest.raises(TypeError, match=f"^{name}: expected"):
            pgccd.Mesh.from_state_dict(mesh | {name: value})
    for name in ("origin", "centre", "centre_offset"):
        for wrong in ("centroid", None, [0.0, 1.0], [0.0, 1.0, float("nan")]):
            broken = {"meshes": [mesh | {name: wrong}, *state["meshes"][1:]]}
            with pytest.raises((TypeError, ValueError), match=rf"^{name}: expected a point \(3 numbers\), got "):
                pgccd.Scene.from_state_dict(state | broken)
    whole = hits.state_dict()
    for change, message in [
        (None, "stats: expected a dictionary"),
        ({name: value for name, value in whole["stats"].items() if name != "pcs"}, "stats: has no entry 'pcs'"),
        (whole["stats"] | {"speed": 1}, "stats: expected entries .*, got 'speed'"),
        (whole["stats"] | {"pcs": "many"}, r"stats\['pcs'\]: expected a number >= 0, got 'many'"),
        (whole["stats"] | {"contacts": -1}, r"stats\['contacts'\]: expected a number >= 0, got -1"),
        (whole["stats"] | {"broad_phase": 3}, r"stats\['broad_phase'\]: expected a str, got 3"),
        (whole["stats"] | {"seconds": 3}, r"stats\['seconds'\]: expected a dictionary, got 3"),
        (whole["stats"] | {"seconds": {"broad": "x"}}, r"stats\['seconds'\]\['broad'\]: expected a number, got 'x'"),
    ]:
        with pytest.raises((TypeError, ValueError), match=f"^{message}"):
            pgccd.Contacts.from_state_dict(whole | {"stats": change})


def test_excluded_pairs_that_are_no_dense_values() -> None:
    mesh = [pgccd.Mesh.box([1.0, 1.0, 1.0])]
    pairs = torch.tensor([[0, 1]])
    for given in (pairs.to_sparse(), pairs.to("meta")):
        with pytest.raises(TypeError, match="^exclude: expected"):
            pgccd.Scene(mesh, [0, 0], exclude=given)


def test_scenes_of_some_bodies(device: torch.device) -> None:
    scene, motion = scattered(24, device)
    hits = pgccd.detect(scene, motion, "all")
    for rows in (slice(4, 12), list(range(4, 12)), (torch.arange(24, device=device) // 8) == 1):
        first = 8 if isinstance(rows, Tensor) else 4
        inside = hits[((hits.pairs >= first) & (hits.pairs < first + 8)).all(1)]
        part = pgccd.detect(scene[rows], motion[rows], "all")
        assert len(part) > 0
        assert torch.equal(part.pairs + first, inside.pairs) and torch.equal(part.toi, inside.toi)
        assert scene[rows].world_count == (first + 8) // 4
    assert scene[8:12].exclude.tolist() == [[0, 1]]  # type: ignore[union-attr]
    with pytest.raises(IndexError, match="^rows: expected numbers of 24 rows"):
        scene[[24]]
    with pytest.raises(ValueError, match="^rows: expected a slice with a step >= 1, got -1"):
        scene[::-1]
    with pytest.raises(ValueError, match="^rows: expected each body at most once"):
        scene[[3, 3]]


def test_the_earliest_of_each_world(device: torch.device) -> None:
    scene, motion = scattered(40, device)
    hits = pgccd.detect(scene, motion)
    of_worlds = hits.earliest(by="world")
    assert scene.world is not None
    worlds = scene.world[of_worlds.pairs[:, 0]].long()
    assert len(of_worlds) > 3 and len(of_worlds) < len(hits)
    assert torch.equal(worlds, torch.unique(scene.world[hits.pairs[:, 0]].long()))
    assert torch.equal(of_worlds.toi, hits.first_toi("world")[worlds])
    assert torch.equal(of_worlds.first_toi("world"), hits.first_toi("world"))
    assert torch.equal(of_worlds.may_collide("world"), hits.may_collide("world"))
    # No body has an earlier contact than its world.
    bound = of_worlds.first_toi("body")
    assert bool((bound <= hits.first_toi("body")).all())
    assert torch.equal(bound, hits.first_toi("world")[scene.world.long()])
    last = hits.earliest(-torch.arange(len(hits), device=device), by="world")
    assert torch.equal(last.toi, of_worlds.toi)
    assert len(hits[[]].earliest(by="world")) == 0
    single = pgccd.Scene(scene.meshes, scene.mesh_index)
    assert pgccd.detect(single, motion).earliest(by="world") == pgccd.detect(single, motion).earliest()
    with pytest.raises(ValueError, match="^by: expected one of"):
        hits.earliest(by="body")  # type: ignore[arg-type]


def test_the_earliest_of_a_trajectory(device: torch.device) -> None:
    """By time along the trajectory, not by the toi within a segment."""
    scene, motion = scattered(24, device)
    still = motion.position_t0 + 50.0 * torch.arange(24, device=device)[:, None]
    position = torch.stack([still, motion.position_t0, motion.position_t1])
    hits = pgccd.detect(scene, pgccd.Trajectory(position, motion.orientation_t0.expand(3, -1, -1)))
    assert float(hits.earliest().time[0]) == float(hits.time.min())
    assert torch.equal(hits.earliest(by="world").first_toi("world"), hits.first_toi("world"))


class Foreign:
    """An array of another library: it has the protocol of DLPack and nothing else."""

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __dlpack__(self, **named: Any) -> Any:
        return self.values.__dlpack__(**named)

    def __dlpack_device__(self) -> Any:
        return self.values.__dlpack_device__()


class OfDevice:
    """An array that has the interface of CUDA arrays alone."""

    def __init__(self, values: Tensor) -> None:
        self.values = values

    @property
    def __cuda_array_interface__(self) -> Any:
        return self.values.__cuda_array_interface__


@pytest.mark.parametrize(
    ("kind", "device"),
    [
        (Foreign, "cpu"),
        (np.asarray, "cpu"),
        *(pytest.param(k, "cuda", marks=pytest.mark.cuda) for k in (Foreign, OfDevice)),
    ],
    indirect=["device"],
)
def test_arrays_are_shared(kind: Any, device: torch.device) -> None:
    scene, motion = scattered(12, device)
    expected = pgccd.detect(scene, motion, "all")
    columns = {name: kind(column) for name, column in motion.columns().items()}
    shared = pgccd.RigidMotion.from_rotation(**columns)
    for name, column in motion.columns().items():
        assert getattr(shared, name).data_ptr() == column.data_ptr(), name
    assert scene.world is not None and scene.margin is not None and scene.group is not None
    there = pgccd.Scene(
        scene.meshes,
        kind(scene.mesh_index),
        device,
        world=kind(scene.world),
        margin=kind(scene.margin),
        group=kind(scene.group),
        mask=kind(scene.mask),
        static=scene.static.bool() if scene.static is not None else None,
        self_collision=scene.self_collision,  # type: ignore[arg-type]
        exclude=kind(scene.exclude),
    )
    assert there.margin.data_ptr() == scene.margin.data_ptr()  # type: ignore[union-attr]
    assert_same(pgccd.detect(there, shared, "all"), expected)
    if kind is not np.asarray:
        pairs = torch.unique(expected.pairs, dim=0)
        found = pgccd.detect(scene, motion, pairs=kind(pairs))
        assert torch.equal(found.pairs, pairs)
    points = torch.randn(20, 4, 3, dtype=torch.float64, device=device)
    one, other = (pgccd.narrow.vertex_face(make(points), make(points.flip(0))) for make in (kind, lambda x: x))
    assert torch.equal(one.toi, other.toi)
    mesh = pgccd.Mesh(kind(meshes()[0].vertices.to(device)), kind(meshes()[0].faces.to(device)))
    assert torch.equal(mesh.vertices, meshes()[0].vertices)


def test_arrays_that_cannot_be_shared_are_named() -> None:
    class Taped(Foreign):
        requires_grad = True

    x, q = torch.zeros(2, 3), torch.eye(4)[:1].repeat(2, 1)
    with pytest.raises(ValueError, match="^position_t0: requires grad in another library"):
        pgccd.RigidMotion(Taped(x), q, x, q)  # type: ignore[arg-type]

    class Failing(Foreign):
        def __dlpack__(self, **named: Any) -> Any:
            raise BufferError("it is read-only")

    with pytest.raises(TypeError, match="^position_t1: torch cannot share this Failing: it is read-only"):
        pgccd.RigidMotion(x, q, Failing(x), q)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^position_t1: expected float32 or float64, got torch.int64"):
        pgccd.RigidMotion(x, q, np.zeros((2, 3), dtype=np.int64), q)  # type: ignore[arg-type]
    locked = np.zeros((2, 3))
    locked.flags.writeable = False
    assert pgccd.RigidMotion(locked, q, x, q).body_count == 2  # type: ignore[arg-type]


def test_rows_of_distances(tmp_path: Path, device: torch.device) -> None:
    """Selected, moved, copied and stored as contacts are."""
    scene, motion = scattered(16, device)
    near = pgccd.distance(scene, motion, cutoff=2.0)
    again = pgccd.Distances.from_state_dict(saved(near.state_dict(), tmp_path / "near"))
    chosen = near[near.upper < torch.inf]
    assert 0 < len(chosen) <= len(near) and isinstance(chosen, pgccd.Distances)
    for name, column in near.columns.items():
        for other in (again, near.clone(), near.to("cpu").to(device)):
            assert torch.equal(getattr(other, name).nan_to_num(9.0), column.nan_to_num(9.0)), name
        assert torch.equal(getattr(chosen, name), column[near.upper < torch.inf]), name
    with pytest.raises(TypeError, match="^rows: expected a mask"):
        near[0]  # type: ignore[index]
    state = near.state_dict()
    for name, wrong in (("points", state["points"][:, :1]), ("lower", state["lower"].float()), ("pairs", None)):
        with pytest.raises((TypeError, ValueError), match=f"^{name}: "):
            pgccd.Distances.from_state_dict(state | {name: wrong})
    with pytest.raises(ValueError, match="upper"):
        pgccd.Distances.from_state_dict({name: state[name] for name in state if name != "upper"})
