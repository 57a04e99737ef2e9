"""Nonsensical values for every argument of every public function: accepted where meaningful, or rejected by name."""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.shapes import Bodies, approaching, tetrahedron

import pgccd
from pgccd import distributed, files, sim
from pgccd.runtime.sizes import BufferSizes

NAN = float("nan")
NONSENSE: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "True": lambda: True,
    "a string": lambda: "nonsense",
    "a complex number": lambda: 1j,
    "-1": lambda: -1,
    "0": lambda: 0,
    "1.5": lambda: 1.5,
    "2^31": lambda: 2**31,
    "2^63 - 1": lambda: 2**63 - 1,
    "2^70": lambda: 2**70,
    "10^400": lambda: 10**400,
    "-10^400": lambda: -(10**400),
    "an integer of NumPy": lambda: np.uint64(2**64 - 1),
    "a number of NumPy": lambda: np.float32(0.3),
    "a bool of NumPy": lambda: np.bool_(True),
    "nan": lambda: NAN,
    "inf": lambda: float("inf"),
    "an object": object,
    "a type": lambda: int,
    "no rows": lambda: [],
    "ragged rows": lambda: [[1, 2, 3], [4]],
    "strings": lambda: ["a", "b", "c"],
    "a dict": dict,
    "a half tensor": lambda: torch.ones(2, 3, dtype=torch.float16),
    "a bfloat16 tensor": lambda: torch.ones(2, 3, dtype=torch.bfloat16),
    "a complex tensor": lambda: torch.ones(2, 3, dtype=torch.complex64),
    "a bool tensor": lambda: torch.ones(2, 3, dtype=torch.bool),
    "an int64 tensor": lambda: torch.ones(2, 3, dtype=torch.int64),
    "a scalar tensor": lambda: torch.tensor(-3.0),
    "one column": lambda: torch.ones(2),
    "a nan tensor": lambda: torch.full((2, 3), NAN),
    "a sparse tensor": lambda: torch.ones(2, 3).to_sparse(),
    "a tensor elsewhere": lambda: torch.ones(2, 3, device="meta"),
    "a tensor that wants gradients": lambda: torch.ones(2, 3, requires_grad=True),
    "an array": lambda: np.ones((2, 3)),
    "an array of objects": lambda: np.array([None, {}]),
}


@dataclass
class Call:
    """A function with valid arguments."""

    function: Callable[..., Any]
    arguments: dict[str, Any]
    also: dict[str, tuple[str, ...]] = field(default_factory=dict)  #: per argument, others it may conflict with


def bodies() -> Bodies:
    return approaching(np.random.default_rng(0), (0, 0), closeness=0.7)


def calls(folder: Path) -> dict[str, Call]:
    b = bodies()
    scene, motion = b.scene(), b.motion()
    moving = pgccd.MovingBodies.of(scene, motion)
    pairs = torch.tensor([[0, 1]])
    candidates, _ = pgccd.traverse.find_candidates(moving, pairs)
    poses: dict[str, Any] = {"position_t0": motion.position_t0, "orientation_t0": motion.orientation_t0}
    poses["position_t1"] = motion.position_t1
    spins = {"position": motion.position_t0, "orientation": motion.orientation_t0}
    spins |= {"linear_velocity": torch.ones(2, 3), "angular_velocity": torch.ones(2, 3)}
    options = {"min_separation": 0.0, "tolerance": None, "nonzero_toi": False}
    initial = {"initial": "report"}
    points = {name: torch.rand(3, 4, 3, dtype=torch.float64) for name in ("points_t0", "points_t1")}
    on_bodies = {"bodies": moving, "min_separation": 0.0, "tolerance": None}
    mesh = tetrahedron()
    (folder / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    np.savez(folder / "poses.npz", **{n: c.numpy() for n, c in poses.items()}, orientation_t1=poses["orientation_t0"])
    np.savez(folder / "rollout.npz", position=np.zeros((3, 2, 3)), orientation=np.zeros((3, 2, 4)))
    filters: dict[str, Any] = dict.fromkeys(("group", "mask", "world"), [0, 1]) | {"static": [False, True]}
    box, two = ((0, 0, 0), (9, 9, 9)), pgccd.Scene([mesh], [0, 0])
    world = distributed.World.create(two, motion.position_t0, *box, payload={"v": torch.ones(2, 3)})
    world.save(folder / "saved")
    hits = pgccd.detect(scene, motion)
    rollout = pgccd.Trajectory(*(torch.stack(ends) for ends in zip(motion.at(0.0), motion.at(1.0), strict=True)))

    def motion_of(bodies: distributed.Bodies) -> pgccd.RigidMotion:
        return motion

    def response_of(bodies: distributed.Bodies, *_: Any) -> dict[str, torch.Tensor]:
        return {"position": bodies.position}

    config = {field: getattr(sim.ModelConfig(), field) for field in sim.ModelConfig.__dataclass_fields__}
    new = {"scene": two, "position": motion.position_t0, "exclude": [[0, 1]]}
    added = new | {"id": torch.arange(2, 4), "payload": {"v": torch.ones(2, 3)}, "vertex_payload": {}}
    of_world = {name: value for name, value in vars(distributed.WorldOptions()).items() if name != "balance"}
    all_worlds = new | dict(zip(("lower", "upper"), box, strict=True))
    all_worlds |= {"id": torch.arange(2), "payload": {}, "vertex_payload": {}, "options": distributed.WorldOptions()}

    def create_with(**chosen: Any) -> distributed.World:
        options = distributed.WorldOptions(**chosen)
        return distributed.World.create(two, motion.position_t0, *box, options=options)

    return {
        "Mesh": Call(
            pgccd.Mesh,
            {
                "vertices": mesh.vertices,
                "faces": mesh.faces,
                "segments": [[0, 1]],
                "points": [0],
                "origin": "centroid",
                "solid": "auto",
                "thickness": 0.1,
            },
            {"vertices": ("faces", "segments", "points", "origin")},
        ),
        "Mesh.from_trimesh": Call(
            pgccd.Mesh.from_trimesh, {"mesh": mesh, "origin": "centroid", "weld": True, "solid": "auto"}
        ),
        "Mesh.load": Call(
            pgccd.Mesh.load,
            {"path": folder / "mesh.obj", "origin": "centroid", "weld": True, "unit": "mm", "solid": "auto"},
            {"solid": ("path",)},
        ),
        "Mesh.load_all": Call(
            pgccd.Mesh.load_all,
            {"path": folder / "mesh.obj", "origin": "centroid", "weld": True, "unit": "mm", "solid": "auto"},
            {"solid": ("path",)},
        ),
        "MeshSet": Call(pgccd.MeshSet, {"meshes": [mesh], "device": "cpu"}),
        "Scene": Call(
            pgccd.Scene,
            {"meshes": [mesh], "mesh_index": [0, 0], "device": "cpu", **filters, "self_collision": True, "margin": 0.1}
            | {"exclude": [[0, 1]]},
            {"mesh_index": ("group",)},
        ),
        "Scene.to": Call(scene.to, {"device": "cpu"}),
        "RigidMotion": Call(
            pgccd.RigidMotion,
            {**poses, "orientation_t1": motion.orientation_t0, "path": "rigid"},
            {"position_t0": ("orientation_t0",)},
        ),
        "RigidMotion.from_rotation": Call(
            pgccd.RigidMotion.from_rotation,
            {**poses, "rotation": motion.rotation, "path": "rigid"},
            {"position_t0": ("orientation_t0",)},
        ),
        "RigidMotion.from_velocity": Call(
            pgccd.RigidMotion.from_velocity,
            {**spins, "dt": 1.0, "path": "rigid"},
            {"position": ("orientation",), "dt": ("angular_velocity",)},
        ),
        "RigidMotion[]": Call(motion.__getitem__, {"rows": [0]}),
        "RigidMotion.to": Call(motion.to, {"device": "cpu"}),
        "VertexMotion": Call(
            pgccd.VertexMotion, {"x_t0": torch.ones(5, 3), "x_t1": torch.ones(5, 3)}, {"x_t0": ("x_t1",)}
        ),
        "Trajectory": Call(
            pgccd.Trajectory,
            {"position": torch.stack([motion.position_t0] * 2), "orientation": motion.orientation_t0, "path": "rigid"}
            | {"rotation": motion.rotation[None], "margin": torch.zeros(1, 2)},
            {"position": ("rotation", "orientation"), "orientation": ("rotation",), "rotation": ("orientation",)},
        ),
        "Trajectory.from_velocity": Call(
            pgccd.Trajectory.from_velocity,
            spins
            | {"linear_velocity": torch.ones(1, 2, 3), "angular_velocity": torch.ones(1, 2, 3), "dt": 1.0}
            | {"path": "rigid", "margin": torch.zeros(1, 2)},
            {"position": ("orientation",), "dt": ("linear_velocity", "angular_velocity")},
        ),
        "MovingBodies.of": Call(pgccd.MovingBodies.of, {"scene": scene, "motion": motion}),
        "BufferSizes": Call(
            BufferSizes, {"pairs": 9, "contacts": 9, "overlaps": 9, "launches": 4, "long_rows": True, "crowded": True}
        ),
        "Capacity.of": Call(pgccd.Capacity.of, {"body_count": 9, "pair_count": 9, "self_vertex_count": 0}),
        "Capacity.times": Call(BufferSizes(9, 9).times, {"factor": 1.5}),
        "resolve": Call(
            pgccd.resolve,
            {"scene": scene, "motion": motion, "movable": [True, False], "min_separation": 0.0, "tolerance": None}
            | initial
            | {"broad_phase": "auto", "capacity": pgccd.Capacity.of(9), "rounds": 3},
            {"capacity": ("rounds",)},
        ),
        "detect": Call(
            pgccd.detect,
            {"scene": scene, "motion": motion, "report": "first", **options, "broad_phase": "auto", "pairs": pairs}
            | initial
            | {"normals": "features"}
            | {"memory_budget": 1 << 20, "capacity": pgccd.Capacity.of(9)},
        ),
        "detect, exactly": Call(
            pgccd.detect,
            {"scene": scene, "motion": motion, "report": "first", **options, "broad_phase": "auto"}
            | initial
            | {"normals": "features", "memory_budget": 1 << 20, "pairs": None, "capacity": None},
        ),
        "detect, a trajectory": Call(
            pgccd.detect,
            {"scene": scene, "motion": rollout, "report": "first", **options, "broad_phase": "auto"}
            | initial
            | {"normals": "surface", "memory_budget": 1 << 20, "pairs": pairs, "capacity": None},
            {"capacity": ("normals",)},
        ),
        "collide": Call(
            pgccd.collide,
            {"scene": scene, "motion": motion, "min_separation": 0.01, "tolerance": None, "broad_phase": "auto"}
            | initial
            | {"pairs": pairs, "memory_budget": 1 << 20, "capacity": pgccd.Capacity.of(9)},
        ),
        "collide, a trajectory": Call(
            pgccd.collide,
            {"scene": scene, "motion": rollout, "min_separation": 0.01, "tolerance": None, "broad_phase": "auto"}
            | initial
            | {"pairs": pairs, "memory_budget": 1 << 20, "capacity": None},
        ),
        "distance": Call(
            pgccd.distance,
            {"scene": scene, "motion": motion, "cutoff": 0.1, "pairs": pairs, "tolerance": None},
        ),
        "exit_distance": Call(
            pgccd.exit_distance,
            {"scene": scene, "motion": motion, "direction": [0.0, 0.0, 1.0], "pairs": pairs}
            | {"min_separation": 0.0, "tolerance": None},
            {"direction": ("pairs",), "pairs": ("direction",), "min_separation": ("motion",)},
        ),
        "enclosed": Call(pgccd.enclosed, {"scene": pgccd.Scene([mesh], [0, 0]), "motion": motion}),
        "RigidMotion.at": Call(motion.at, {"t": 0.5}),
        "RigidMotion.shortened": Call(motion.shortened, {"fraction": 0.5}),
        "Trajectory.segment": Call(rollout.segment, {"index": 0}),
        "approaching": Call(
            pgccd.approaching,
            {"scene": scene, "motion": motion, "hits": hits, "slack": 0.1},
            {"hits": ("scene", "motion")},
        ),
        "approach_rates": Call(pgccd.approach_rates, {"scene": scene, "motion": motion, "hits": hits}),
        "Contacts.first_toi": Call(hits.first_toi, {"by": "body"}),
        "Mesh.as_solid": Call(mesh.as_solid, {"solid": "auto"}),
        "Mesh.thickened": Call(mesh.thickened, {"thickness": 0.1}),
        "Mesh.box": Call(
            pgccd.Mesh.box, {"extents": (1.0, 1.0, 1.0), "origin": "centroid", "solid": True}, {"extents": ("origin",)}
        ),
        "Mesh.points": Call(
            pgccd.Mesh.points, {"x": mesh.vertices, "radius": 0.1, "origin": "centroid"}, {"x": ("origin",)}
        ),
        "Mesh.segments": Call(
            pgccd.Mesh.segments,
            {"x": mesh.vertices, "edges": [[0, 1]], "radius": 0.1, "origin": "centroid"},
            {"x": ("edges", "origin")},
        ),
        "Mesh.sphere": Call(pgccd.Mesh.sphere, {"radius": 1.0, "origin": "centroid"}),
        "Mesh.capsule": Call(pgccd.Mesh.capsule, {"radius": 1.0, "length": 1.0, "origin": "centroid"}),
        "Mesh.icosphere": Call(
            pgccd.Mesh.icosphere, {"radius": 1.0, "subdivisions": 1, "origin": "centroid", "solid": True}
        ),
        "Mesh.cylinder": Call(
            pgccd.Mesh.cylinder, {"radius": 1.0, "height": 1.0, "sections": 8, "origin": "centroid", "solid": True}
        ),
        "CapturedDetection": Call(
            pgccd.CapturedDetection,
            {"scene": scene, "motion": motion, "report": "first", **options, "broad_phase": "auto"}
            | initial
            | {"capacity": None},
        ),
        "CapturedCollision": Call(
            pgccd.CapturedCollision,
            {"scene": scene, "motion": motion, "min_separation": 0.01, "tolerance": None, "broad_phase": "auto"}
            | initial
            | {"capacity": None},
        ),
        "BalanceOptions": Call(
            distributed.BalanceOptions,
            {
                field: getattr(distributed.BalanceOptions(), field)
                for field in distributed.BalanceOptions.__dataclass_fields__
            },
            {"start": ("goal",)},
        ),
        "audit": Call(
            pgccd.audit,
            {"scene": scene, "trajectory": rollout, "min_separation": 0.0, "path": "rigid", "tolerance": None}
            | {"broad_phase": "auto", "keep": 3},
        ),
        "Contacts[]": Call(hits.__getitem__, {"rows": [0]}),
        "Contacts.to": Call(hits.to, {"device": "cpu"}),
        "broad.sweep": Call(pgccd.broad.sweep, on_bodies | {"axis": "x"}),
        "broad.grid": Call(pgccd.broad.grid, on_bodies),
        "broad.lbvh": Call(pgccd.broad.lbvh, on_bodies),
        "broad.find_pairs": Call(pgccd.broad.find_pairs, on_bodies | {"broad_phase": "grid"}),
        "broad.choose": Call(pgccd.broad.choose, {"bodies": moving, "broad_phase": "grid"}),
        "traverse.find_candidates": Call(
            pgccd.traverse.find_candidates,
            on_bodies | {"pairs": pairs, "tolerance": None, "horizon": torch.ones(1).double(), "initial": "report"},
        ),
        "narrow.find_contacts": Call(
            pgccd.narrow.find_contacts,
            {"bodies": moving, "pairs": pairs, "candidates": candidates, "report": "all", **options},
        ),
        "narrow.vertex_face": Call(pgccd.narrow.vertex_face, points | options),
        "narrow.edge_edge": Call(pgccd.narrow.edge_edge, points | options),
        "files.iterate_frames": Call(
            files.iterate_frames,
            {"path": folder / "rollout.npz", "device": "cpu"},
            {"path": ("nonsense cannot be read as an npz file",)},
        ),
        "files.load_motion": Call(
            files.load_motion,
            {"path": folder / "poses.npz", "device": "cpu"},
            {"path": ("nonsense cannot be read as an npz file",)},
        ),
        "files.save_scene": Call(
            files.save_scene,
            {"path": folder / "new.json", "scene": two, "motion": motion, "names": ["a", "b"]},
        ),
        "integrate_orientation": Call(
            pgccd.integrate_orientation, {"orientation": motion.orientation_t0, "rotation": motion.rotation}
        ),
        "sim.ModelConfig": Call(sim.ModelConfig, config),
        "distributed.World.create": Call(distributed.World.create, all_worlds),
        "distributed.WorldOptions": Call(create_with, of_world),
        "distributed.World.step": Call(
            world.step,
            {"motion": motion, "payload": ("v", "position"), "resolve": True, "movable": [True, False]},
            {"resolve": ("movable",)},
        ),
        "distributed.World.collide": Call(world.collide, {"motion": motion, "payload": ("v", "position")}),
        "distributed.World.rows_of": Call(world.rows_of, {"ids": pairs}),
        "distributed.World.sum_per_body": Call(
            world.sum_per_body, {"hits": hits, "values": torch.ones(len(hits), 2)}, {"hits": ("values",)}
        ),
        # The ids have been used after the first call.
        "distributed.World.add": Call(world.add, added, dict.fromkeys(added, ("id",))),
        "distributed.World.remove": Call(world.remove, {"ids": torch.tensor([1])}),
        "distributed.World.move": Call(world.move, {"position": motion.position_t0, "v": torch.ones(2, 3)}),
        "distributed.World.save": Call(world.save, {"folder": folder / "saved", "keep": 2, "header": {}, "wait": True}),
        "distributed.World.load": Call(
            distributed.World.load,
            {"folder": folder / "saved", "meshes": [mesh], "device": "cpu", "options": distributed.WorldOptions()},
        ),
        "distributed.CapturedWorld": Call(
            distributed.CapturedWorld,
            {
                "world": world,
                "motion": motion_of,
                "response": response_of,
                "resolve": True,
                "movable": len,
                "tally": len,
            },
            {"resolve": ("movable",)},
        ),
        "distributed.World.first_toi": Call(world.first_toi, {"hits": hits}),
    }


with tempfile.TemporaryDirectory() as some_folder:
    NAMES = list(calls(Path(some_folder)))


@pytest.mark.parametrize("name", NAMES)
def test_nonsense_is_refused_by_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # some calls may create a folder
    call = calls(tmp_path)[name]
    wrong = []
    if name != "Mesh.from_trimesh":
        call.function(**call.arguments)
    for argument in call.arguments:
        for what, make in NONSENSE.items():
            value = make()
            try:
                call.function(**(call.arguments | {argument: value}))
            except (TypeError, ValueError, IndexError, FileNotFoundError) as error:
                names = (argument, *call.also.get(argument, ()))
                if not str(error).startswith(tuple(f"{name}{mark}" for name in names for mark in ":[")):
                    wrong.append(f"{argument} = {what}: {type(error).__name__}: {str(error)[:90]}")
            except Exception as error:
                wrong.append(f"{argument} = {what}: {type(error).__name__}: {str(error)[:90]}")
    assert wrong == []


def test_every_argument_is_tried(tmp_path: Path) -> None:
    # Not tried: internal flags, and `comm` and `balance`, which are objects of this package.
    known = {"wait", "comm", "balance", "poses", "tasks", "leaf_pairs", "candidates", "open", "graph"}
    for name, call in calls(tmp_path).items():
        parameters = inspect.signature(call.function).parameters.values()
        named = {each.name for each in parameters if each.kind is not inspect.Parameter.VAR_KEYWORD}
        assert named - set(call.arguments) <= known, name


def test_arguments_swapped() -> None:
    b = bodies()
    scene, motion = b.scene(), b.motion()
    cases: list[tuple[Callable[[], Any], str]] = [
        (lambda: pgccd.detect(motion, scene), "^scene: expected a pgccd.Scene, got RigidMotion"),  # type: ignore
        (lambda: pgccd.detect(scene, scene), "^motion: expected .*, got Scene"),  # type: ignore
        (lambda: pgccd.MovingBodies.of(motion, scene), "^scene: expected"),  # type: ignore
        (
            lambda: pgccd.RigidMotion(motion.orientation_t0, motion.position_t0, *[motion.position_t1] * 2),
            r"^position_t0: expected shape \(N, 3\), got \(2, 4\)",
        ),
        (lambda: pgccd.Scene(b.meshes[0]), r"^meshes: expected a list of meshes, got Mesh: write \[mesh\]"),  # type: ignore
        (lambda: pgccd.detect(scene, motion, capacity=100), "^capacity: expected a pgccd.Capacity, got 100"),  # type: ignore
        (lambda: pgccd.detect(scene, motion, capacity=BufferSizes(2**31, 1)), "^capacity: pairs: .*2147483648"),
    ]
    for call, message in cases:
        with pytest.raises((TypeError, ValueError), match=message):
            call()


@pytest.mark.parametrize("rows", [[[0, 2], [0, 1]], [[0, 1], [0, 1]], [[1, 2], [0, 1]]])
def test_pairs_are_sorted_and_each_once(rows: list[list[int]], device: torch.device) -> None:
    b = approaching(np.random.default_rng(0), (0, 0, 0), (1.0, 1.0, 1.0), closeness=0.7)
    if device.type == "cuda":
        pytest.skip("a device that has asserted is lost to this process")
    with pytest.raises(ValueError, match="^pairs: expected rows sorted by i, then j, each once"):
        pgccd.detect(b.scene(), b.motion(), pairs=torch.tensor(rows))
    pgccd.detect(b.scene(), b.motion(), pairs=torch.unique(torch.tensor(rows), dim=0))


def test_no_tolerance_means_the_default() -> None:
    points = torch.rand(400, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ends = points + 0.7 * torch.rand(400, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.35
    for test in (pgccd.narrow.vertex_face, pgccd.narrow.edge_edge):
        expected, found = test(points, ends), test(points, ends, tolerance=None)
        assert torch.equal(found.toi, expected.toi) and torch.equal(found.status, expected.status)
        assert 0 < int((found.status != pgccd.Status.FREE).sum()) < 400
