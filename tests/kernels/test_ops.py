"""The operators within torch: schemas, fake kernels, opcheck, torch.compile."""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.arms import slider
from support.cases import few_and_many
from support.reports import detected
from support.shapes import approaching, tensors, unit_quaternions

import pgccd
from pgccd import ops
from pgccd.baselines import PCCCD
from pgccd.distributed import Cells
from pgccd.search.padded import counts_of_given, lower_first_toi
from pgccd.sim.simulation import FIRST_CONTACTS

Call = tuple[str, tuple[Any, ...]]


class Recorder:
    """Replaces torch.ops.pgccd and records every call."""

    def __init__(self, real: Any) -> None:
        self.real, self.calls = real, []  # type: Any, list[Call]

    def __getattr__(self, name: str) -> SimpleNamespace:
        def call(*arguments: Any) -> Any:
            self.calls.append((name, arguments))
            return getattr(self.real, name)(*arguments)

        return SimpleNamespace(default=call)


def share_out(moving: pgccd.MovingBodies) -> None:
    """Calls the operators that distribute bodies over ranks, as one of two ranks."""
    partition = Cells.uniform((-1.0,) * 3, (1.0,) * 3, 2, cells=2, device=moving.device)
    centres = [moving.position_t0, moving.position_t1, moving.radius]
    subdomain = partition.subdomain(1)
    reach, boundary, _ = ops.boundary_bodies(centres, 0.01, -1e-6, *subdomain)
    pgccd.broad.find_pairs_of_checked(moving, 0.01, "sweep", in_other_search=reach)
    capacity, invalid = pgccd.Capacity.of(moving.scene.body_count), torch.zeros_like(boundary[:1])
    pgccd.broad.find_pairs_padded(moving, 0.01, "grid", capacity, invalid, in_other_search=reach)
    rows = torch.arange(len(boundary), device=moving.device)
    replica_ranks, counts = ops.replica_ranks(centres, 0.01, -1e-6, *subdomain, rows, [2, len(boundary) - 2], 2)
    ops.reached_ranks(centres, 0.01, -1e-6, subdomain, rows, 2)
    ops.rows_by_rank(replica_ranks, rows, counts, [3, 0])
    ops.counts_to_send(counts, [3, 0], counts[:1], 4)
    pairs = torch.combinations(rows)
    ops.meeting_pairs(pairs, centres, 0.01, -1e-6)
    ops.owned_pairs(pairs, rows, rows, centres, 0.01, -1e-6, reach, *subdomain)
    ops.near_ghosts(centres, reach, [column[:1] for column in centres], 0.01, -1e-6, *subdomain)
    ops.leaving_bodies(moving.position_t0, *subdomain, 2)
    ops.leaving_and_invalid(moving.position_t0, None, *subdomain)


def move_rows(device: torch.device) -> None:
    """Calls the operators that move rows of columns."""
    for count in (0, 5):
        columns = [
            torch.arange(count),
            torch.ones((count, 3)).double(),
            torch.ones(count).bool(),
            torch.ones((count, 0)),
        ]
        columns = [column.to(device) for column in columns]
        rows = torch.arange(0, count, 2, device=device)
        packed = ops.pack_rows(columns, rows)
        ops.unpack_rows(packed, columns)
        ops.take_rows(columns, [], rows)
        ops.take_rows(columns, [column[1:] for column in columns], 2 * rows)
        ops.merge_rows(columns, rows, packed)
    ops.pack_rows([], rows)
    ops.unpack_rows(packed[:, :0], [])


def meet_in_boxes(device: torch.device) -> None:
    """Calls the operators of broad phases with bodies that fill little of their SBV."""
    count = 12
    rod = pgccd.Mesh.box([4.0, 0.4, 0.4])
    scene = pgccd.Scene([rod], torch.zeros(count, dtype=torch.int32), device)
    rng = np.random.default_rng(1)
    pose = (rng.uniform(-1.0, 1.0, (count, 3)), unit_quaternions(rng, count), rng.normal(size=(count, 3)))
    motion = pgccd.RigidMotion.from_velocity(*tensors(*pose, rng.normal(size=(count, 3)), device=device), dt=0.1)
    x = torch.cat([rod.vertices.to(device) + p for p in motion.position_t0])
    capacity, invalid = pgccd.Capacity.of(count), torch.zeros(1, dtype=torch.int64, device=device)
    for bodies in (pgccd.MovingBodies.of(scene, motion), pgccd.MovingBodies.of(scene, pgccd.VertexMotion(x, x))):
        pairs = pgccd.broad.find_pairs_of_checked(bodies, 0.0, "sweep", at_any_times=True)
        pgccd.broad.meeting_pairs(bodies, pairs, 0.0)
        pgccd.broad.find_pairs_padded(bodies, 0.0, "grid", capacity, invalid)
    pgccd.detect(scene, motion)


def certify_motions(device: torch.device) -> None:
    """Calls the operators of robots."""
    robot = slider()
    q = torch.tensor([[[0.0, 0.0], [1.5, 0.3], [0.0, 0.0]]], dtype=torch.float64, device=device)
    robot.certify(q, pgccd.robots.Obstacles([pgccd.Mesh.box([0.2] * 3)], torch.tensor([[0.1, 1.0, 0.3]])))
    robot.trajectory(q[0])
    robot.poses(q)


def stages_alone(bodies: pgccd.MovingBodies) -> None:
    """Calls the operators that `detect` uses on only one kind of device."""
    for find in (pgccd.broad.sweep, pgccd.broad.grid, pgccd.broad.lbvh):
        pairs = find(bodies)
    candidates, _ = pgccd.traverse.find_candidates(bodies, pairs)
    for report in ("any", "first", "all"):
        pgccd.narrow.find_contacts(bodies, pairs, candidates, report)


@functools.cache
def recorded(device: torch.device) -> list[Call]:
    """The package's own operator calls, with and without all optional arguments."""
    recorder = Recorder(ops.library.operators)
    rng = np.random.default_rng(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ops.library, "operators", recorder)
        move_rows(device)
        certify_motions(device)
        mesh = pgccd.Mesh.icosphere(1.0, 1)
        if device.type == "cpu":
            ops.prepare_mesh(mesh.vertices, mesh.faces, 2)
        for closeness in (0.7, 20.0):  # the latter: no pairs, no contacts
            bodies = approaching(rng, (0, 1, 0), (1.0, 1.0, 1.0), closeness=closeness)
            filters = {"group": [1, 1, 3], "mask": [1, 3, 1], "world": [0, 0, 0], "static": [False, False, True]}
            filters["margin"] = [0.0, 0.1, 0.2]  # type: ignore[assignment]
            bodies.motion(device=device).shortened(0.5).at(0.5)
            for options in ({}, filters):
                scene = pgccd.Scene(bodies.meshes, device=device, **options)
                for report in ("any", "first", "all", "earliest"):
                    detected(scene, bodies.motion(device=device), report, 0.01)
                for broad_phase in ("grid", "lbvh"):  # with few bodies the default is the sweep
                    pgccd.collide(scene, bodies.motion(device=device), broad_phase=broad_phase)
            pgccd.detect(scene, bodies.motion("linear", device))
            capacity = pgccd.Capacity.of(scene.body_count)
            pgccd.detect(scene, bodies.motion(device=device), "all", capacity=capacity)
            x = torch.cat(
                [m.vertices + torch.from_numpy(p) for m, p in zip(bodies.meshes, bodies.position_t0, strict=True)]
            )
            moved = pgccd.VertexMotion(x.to(device), (x + 0.3).to(device))
            pgccd.detect(scene, moved)
            pgccd.detect(scene, moved, capacity=capacity)
            for motion in (bodies.motion(device=device), bodies.motion("linear", device), moved):
                pgccd.approaching(scene, motion, pgccd.detect(scene, motion, "all", 0.01, normals="surface"))
            stages_alone(pgccd.MovingBodies.of(scene, bodies.motion(device=device)))
            stages_alone(pgccd.MovingBodies.of(scene, moved))
            meet_in_boxes(device)
            moving = pgccd.MovingBodies.of(scene, bodies.motion(device=device))
            ops.swept_boxes(moving.swept_spheres, 0.01, -1e-6)
            share_out(moving)
            if device.type == "cpu" and closeness == 0.7:
                PCCCD.create(bodies.meshes).detect(bodies.motion(), mesh_index=scene.mesh_index)
            pairs = pgccd.broad.sweep(moving)
            first = torch.full((scene.body_count,), torch.inf, dtype=torch.float64, device=device)
            asked = moving.mesh_set, moving.tensors, False, pairs, counts_of_given(pairs)
            for report in ("any", "all"):
                detected(scene, bodies.motion(device=device), report, pairs=pairs)
            for motion in (bodies.motion(device=device), moved):
                pgccd.distance(scene, motion, pairs=pairs[:1])  # changed ones are searched until they give up
            lower_first_toi(first, pairs, *asked, FIRST_CONTACTS, capacity)
            turn = bodies.orientation_t0
            pgccd.RigidMotion(*tensors(bodies.position_t0, turn, bodies.position_t1, turn[::-1].copy(), device=device))
            for test in (pgccd.narrow.vertex_face, pgccd.narrow.edge_edge):
                test(*tensors(*rng.normal(size=(2, 50, 4, 3)), device=device), min_separation=0.1)
                test(*tensors(*np.zeros((2, 0, 4, 3)), device=device))
    return recorder.calls


@pytest.mark.parametrize("traced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_opcheck(device: torch.device, traced: bool) -> None:
    """Schemas and fake kernels; slow tests also trace the operators with dynamic shapes."""
    every = 10 if traced else 40
    calls = recorded(device)
    names = {name for name, _ in calls}
    registered = torch._C._dispatch_get_registrations_for_dispatch_key(device.type.upper())
    own = {n.removeprefix("pgccd::") for n in registered if n.startswith("pgccd::")}
    elsewhere = re.compile("commit_rows|resolve|simulate|random|peer|.*conditional")  # checked in other files
    assert {n for n in own if not elsewhere.match(n)} <= names, "an operator was not called"
    seen: dict[str, int] = {}
    for name, arguments in calls:
        seen[name] = seen.get(name, 0) + 1
        if seen[name] <= 2 or seen[name] % every == 0:
            operator = getattr(torch.ops.pgccd, name).default
            torch.library.opcheck(operator, arguments, test_utils=("test_schema", "test_faketensor"))
    unequal = {"refit", "prepare_mesh"}  # empty slots hold NaN, which opcheck finds unequal
    unequal |= {"certify_paths"}  # points of free paths are NaN
    unequal |= {"near_ghosts", "leaving_bodies"}  # the trailing rows are uninitialised
    unequal |= {name for name in names if "padded" in name}  # times differ
    unequal |= {"detect_rigid", "lower_first_toi_rigid"}  # likewise
    if device.type == "cuda":
        unequal |= {"traverse_rigid", "traverse_deforming"}  # the order of candidates is unspecified
    for name in names - unequal:
        arguments = next(a for n, a in calls if n == name)
        utilities = ("test_autograd_registration", *(["test_aot_dispatch_dynamic"] if traced else []))
        torch.library.opcheck(getattr(torch.ops.pgccd, name).default, arguments, test_utils=utilities)


def shapes(values: Any) -> list[tuple[Any, ...]]:
    values = values if isinstance(values, tuple | list) else (values,)
    return [(tuple(v.shape), v.dtype, v.device.type) for v in values]


def form(value: Any) -> Any:
    """Which optional arguments are given, and the number of dimensions of each tensor."""
    if isinstance(value, torch.Tensor):
        return value.dtype, value.dim()
    return tuple(map(form, value)) if isinstance(value, list | tuple) else type(value)


@few_and_many("calls_of_a_form", 1, 9)
def test_fake_kernels_have_the_right_shapes(device: torch.device, calls_of_a_form: int) -> None:
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch.fx.experimental.symbolic_shapes import ShapeEnv

    seen: Counter[Any] = Counter()
    # One for all calls, since it keeps the fake tensors of the mesh sets.
    environment = ShapeEnv()
    mode = FakeTensorMode(shape_env=environment, allow_non_fake_inputs=False)
    for name, arguments in recorded(device):
        seen[name, form(arguments)] += 1
        if seen[name, form(arguments)] > calls_of_a_form:
            continue
        operator = getattr(torch.ops.pgccd, name).default
        real = shapes(operator(*arguments))
        # Sizes that depend on values stay unbound, since the test does not compute with them.
        with mode, environment.ignore_fresh_unbacked_symbols():
            fake = shapes(operator(*torch.utils._pytree.tree_map_only(torch.Tensor, mode.from_tensor, arguments)))
        assert len(real) == len(fake), name
        for (shape, *rest), (fake_shape, *fake_rest) in zip(real, fake, strict=True):
            assert rest == fake_rest and len(shape) == len(fake_shape), name
            assert all(isinstance(f, torch.SymInt) or f == s for s, f in zip(shape, fake_shape, strict=True)), name


@pytest.mark.slow
def test_compile_the_sweep(device: torch.device) -> None:
    @torch.compile(fullgraph=True, dynamic=True, backend="aot_eager")
    def pairs_of(start: torch.Tensor, end: torch.Tensor, radius: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        pairs = ops.broad_pairs((start, end, 1.5 * radius), 0.0, 0.0, 0, -1)
        offset = start[pairs[:, 1]] - start[pairs[:, 0]]
        return pairs, offset.norm(dim=1)

    rng = np.random.default_rng(1)
    for count, spread in ((50, 3.0), (70, 3.0), (40, 1e6), (2, 0.1)):
        start = spread * rng.uniform(-1, 1, (count, 3))
        columns = tensors(start, start + 0.1, np.full(count, 0.5), device=device)
        pairs, distance = pairs_of(*columns)
        expected = ops.broad_pairs((columns[0], columns[1], 1.5 * columns[2]), 0.0, 0.0, 0, -1)
        assert torch.equal(pairs, expected) and distance.shape == (len(pairs),)
        assert (len(pairs) == 0) == (spread == 1e6)


@pytest.mark.slow
@pytest.mark.parametrize("test", [pgccd.narrow.vertex_face, pgccd.narrow.edge_edge], ids=lambda t: t.__name__)
def test_compile_the_elementary_tests(device: torch.device, test: Callable[..., Any]) -> None:
    @torch.compile(fullgraph=True, dynamic=True, backend="aot_eager")
    def earliest(start: torch.Tensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = test(start, end, 0.01)
        return found.toi.clamp(max=1.0), (found.status != pgccd.Status.FREE).sum()

    rng = np.random.default_rng(2)
    for count in (100, 33):
        points = tensors(*rng.normal(size=(2, count, 4, 3)), device=device)
        toi, contacts = earliest(*points)
        found = test(*points, 0.01)
        assert torch.equal(toi, found.toi.clamp(max=1.0)) and int(contacts) == int(
            (found.status != pgccd.Status.FREE).sum()
        )
        assert int(contacts) > 0


@pytest.mark.slow
def test_compile_with_the_default_backend(device: torch.device) -> None:
    @torch.compile(fullgraph=True)
    def nearest(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
        return pgccd.narrow.vertex_face(start + 0.5, end + 0.5).toi.min()

    points = tensors(*np.random.default_rng(3).normal(size=(2, 64, 4, 3)), device=device)
    assert torch.equal(nearest(*points), pgccd.narrow.vertex_face(points[0] + 0.5, points[1] + 0.5).toi.min())


def test_operators_complain_themselves(device: torch.device) -> None:
    columns = tensors(*np.zeros((2, 5, 3)), np.ones(5), device=device)
    with pytest.raises(RuntimeError, match="position_t0: wrong dtype"):
        ops.broad_pairs((columns[0].float(), *columns[1:]), 0.0, 0.0, 0, -1)
    with pytest.raises(RuntimeError, match="expected size 5 in dimension 0, got 4"):
        ops.broad_pairs((columns[0], columns[1][:4], columns[2]), 0.0, 0.0, 2, -1)
    with pytest.raises(RuntimeError, match="capacity: expected 3 numbers, got 1"):
        ops.pairs_padded(columns, None, 0.0, 0.0, 1, [8])
    for swept, got in ((columns[:2], 2), ([*columns, *[None] * 7], 10)):
        with pytest.raises(RuntimeError, match=f"swept: expected 3 to 9 tensors, got {got}"):
            ops.broad_pairs(swept, 0.0, 0.0, 0, -1)
    for k in range(3):
        with pytest.raises(RuntimeError, match="swept: expected position_t0, position_t1 and radius first"):
            ops.broad_pairs([*columns[:k], None, *columns[k + 1 :]], 0.0, 0.0, 0, -1)
    names = ("group", "mask", "world", "is_static", "in_other_search", "boxes")
    for k, name in enumerate(names, 3):
        with pytest.raises(RuntimeError, match=f"{name}: "):  # one body too many
            ops.broad_pairs([*columns, *[None] * (k - 3), torch.zeros(6, device=device)], 0.0, 0.0, 0, -1)


@pytest.mark.cuda
def test_swept_bodies_are_on_one_device() -> None:
    columns = tensors(*np.zeros((2, 5, 3)), np.ones(5), device="cuda")
    for k in range(1, 9):
        swept = [*columns, *[None] * 6]
        swept[k] = torch.zeros(5)
        with pytest.raises(RuntimeError, match=": on another device than the first tensor"):
            ops.broad_pairs(swept, 0.0, 0.0, 0, -1)


def test_a_step_complains_itself(device: torch.device) -> None:
    _, arguments = next(call for call in recorded(device) if call[0] == "detect_rigid")
    _, _, _, swept, _, _, _, _, options, *_ = arguments
    fewer = tuple(None if column is None else column[:-1] for column in swept)
    for at, value, error in (
        (3, fewer, "swept: expected .*, one a body"),
        (8, options[:2], "options: expected 3 values"),
    ):
        with pytest.raises(RuntimeError, match=error):
            torch.ops.pgccd.detect_rigid(*arguments[:at], value, *arguments[at + 1 :])


@pytest.mark.cuda
def test_out_of_memory_is_an_exception() -> None:
    count = 40_000
    columns = tensors(*np.random.default_rng(3).uniform(0, 0.3, (2, count, 3)), np.ones(count), device="cuda")
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction(0.005)
    try:
        with pytest.raises(RuntimeError, match=r"(?i)memory"):
            ops.broad_pairs(columns, 0.0, 0.0, 0, -1)  # 800 million pairs
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
    few = [column[:50] for column in columns]
    assert len(ops.broad_pairs(few, 0.0, 0.0, 0, -1)) == 50 * 49 // 2


def test_layout_does_not_matter(device: torch.device) -> None:
    rng = np.random.default_rng(4)
    points = tensors(*rng.normal(size=(2, 40, 4, 3)), device=device)
    strided = [p.permute(2, 1, 0).contiguous().permute(2, 1, 0) for p in points]
    assert not strided[0].is_contiguous()
    assert torch.equal(pgccd.narrow.edge_edge(*strided).toi, pgccd.narrow.edge_edge(*points).toi)
    bodies = approaching(rng, (0, 0), closeness=0.7)
    columns = tensors(
        bodies.position_t0, bodies.orientation_t0, bodies.position_t1, bodies.orientation_t0, device=device
    )
    motions = [pgccd.RigidMotion(*c) for c in (columns, [c.T.contiguous().T for c in columns])]
    found = [pgccd.detect(bodies.scene(device), m, "all").toi for m in motions]
    assert torch.equal(*found) and len(found[0]) > 0


def test_arguments_are_not_changed(device: torch.device) -> None:
    for name, arguments in recorded(device)[:40]:
        flat = [a for a in torch.utils._pytree.tree_leaves(arguments) if isinstance(a, torch.Tensor)]
        before = [a.clone() for a in flat]
        getattr(torch.ops.pgccd, name)(*arguments)
        assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(flat, before, strict=True)), name
