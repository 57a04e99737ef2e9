"""Values as given: lengths and times in full precision, columns validated at each use, errors that give the value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from support.shapes import Bodies, approaching, tensors

import pgccd
from pgccd.motion.validation import CHECK_NUMBERS, RADIUS
from pgccd.runtime.sizes import Capacity

NAN, INF = float("nan"), float("inf")
STILL = np.array([[1.0, 0.0, 0.0, 0.0]] * 2)
WRONG_MARGINS = (-10.0, -1e-300, NAN, INF, -INF, 1e151)
KINDS = ("rigid", "linear", "deforming")


def bodies() -> Bodies:
    return approaching(np.random.default_rng(0), (0, 0), closeness=0.7)


def moving(kind: str, device: torch.device | str = "cpu") -> tuple[pgccd.Scene, Any]:
    """Two bodies with margins that collide."""
    b = bodies()
    scene = pgccd.Scene(b.meshes, device=device, margin=[0.0, 0.001])
    if kind != "deforming":
        return scene, b.motion(kind, device=device)  # type: ignore[arg-type]
    ends = [
        torch.cat([m.vertices + torch.from_numpy(p) for m, p in zip(b.meshes, position, strict=True)]).to(device)
        for position in (b.position_t0, b.position_t1)
    ]
    return scene, pgccd.VertexMotion(*ends)


@pytest.mark.parametrize(
    "margin",
    [
        0.3,
        [0.3, 0.3],
        (0.3, 0.3),
        np.float64(0.3),
        [np.float64(0.3)] * 2,
        np.array([0.3, 0.3]),
        torch.tensor(0.3, dtype=torch.float64),
        torch.tensor([0.3, 0.3], dtype=torch.float64),
    ],
)
def test_margins_keep_all_their_digits(margin: Any, device: torch.device) -> None:
    triangle = pgccd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    scene = pgccd.Scene([triangle, triangle], device=device, margin=margin)
    assert scene.margin is not None and scene.margin.tolist() == [0.3, 0.3]
    for gap, count in ((0.6 - 1e-12, 1), (0.6 + 1e-12, 0)):
        x, q = tensors(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, gap]]), STILL, device=device)
        assert len(pgccd.detect(scene, pgccd.RigidMotion(x, q, x, q), tolerance=0.0)) == count


def test_float32_and_integers_are_widened() -> None:
    b = bodies()
    half = pgccd.Scene(b.meshes, margin=torch.tensor([0.1, 0.2]))
    assert half.margin is not None and half.margin.tolist() == [float(np.float32(0.1)), float(np.float32(0.2))]
    whole = pgccd.Scene(b.meshes, margin=[1, 2])
    assert whole.margin is not None and whole.margin.tolist() == [1.0, 2.0]
    for wrong in (True, [True, False], [1j, 0], "thick", [None, 1.0], torch.ones(2).half(), torch.ones(2).to_sparse()):
        with pytest.raises(TypeError, match="^margin: expected"):
            pgccd.Scene(b.meshes, margin=wrong)  # type: ignore[arg-type]
    for value in WRONG_MARGINS:
        with pytest.raises(ValueError, match="^margin: body 1: expected a finite length >= 0.*, got "):
            pgccd.Scene(b.meshes, margin=[0.0, value])


def test_times_keep_all_their_digits(device: torch.device) -> None:
    motion = bodies().motion(device=device)
    exact = motion.at(torch.tensor([0.1, 0.7], dtype=torch.float64))
    for given in ([0.1, 0.7], (0.1, 0.7), np.array([0.1, 0.7])):
        assert all(torch.equal(x, y) for x, y in zip(motion.at(given), exact, strict=True))  # type: ignore[arg-type]
    if device.type == "cpu":
        with pytest.raises(ValueError, match=r"^t: expected times in \[0, 1\], got 1.5"):
            motion.at([0.5, 1.5])  # type: ignore[arg-type]
        for wrong in (True, 1j, "noon", torch.tensor(0.5).half()):
            with pytest.raises(TypeError, match="^t: expected times"):
                motion.at(wrong)  # type: ignore[arg-type]


def test_origins_keep_all_their_digits() -> None:
    mesh = bodies().meshes[0]
    for origin in ((0.1, 0.2, 0.3), [0.1, 0.2, 0.3], np.array([0.1, 0.2, 0.3])):
        assert pgccd.Mesh(mesh.vertices, mesh.faces, origin).origin.tolist() == [0.1, 0.2, 0.3]
    for wrong in (torch.ones(3, dtype=torch.complex64), torch.ones(3, dtype=torch.bool), [1j, 0, 0]):
        with pytest.raises(TypeError, match="^origin: expected a point"):
            pgccd.Mesh(mesh.vertices, mesh.faces, wrong)


@pytest.mark.parametrize(
    ("values", "hint"),
    [
        ([[0.0, 0, 0]] * 2, r"got list: pass torch.tensor\(values, dtype=torch.float64\)"),
        (torch.zeros(2, 3).half(), "expected float32 or float64, got torch.float16"),
    ],
)
def test_poses_are_tensors(values: Any, hint: str) -> None:
    x, q = tensors(np.zeros((2, 3)), STILL)
    with pytest.raises(TypeError, match=f"^position_t1: .*{hint}"):
        pgccd.RigidMotion(x, q, values, q)
    with pytest.raises(TypeError, match=f"^x_t0: .*{hint}"):
        pgccd.VertexMotion(values, x)
    with pytest.raises(TypeError, match=f"^position: .*{hint}"):
        pgccd.Trajectory(values)


def test_numbers_are_not_detached_silently() -> None:
    b = bodies()
    wanting = torch.tensor(0.1, requires_grad=True)
    with pytest.raises(ValueError, match="^tolerance: requires grad"):
        pgccd.detect(b.scene(), b.motion(), tolerance=wanting)  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="^tolerance: expected values, got a tensor on the device meta"):
        pgccd.detect(b.scene(), b.motion(), tolerance=torch.tensor(0.1, device="meta"))  # type: ignore[call-overload]


@pytest.mark.parametrize("value", WRONG_MARGINS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_margin_written_later_is_validated(kind: str, value: float, device: torch.device) -> None:
    scene, motion = moving(kind, device)
    expected = pgccd.detect(scene, motion)
    assert len(expected) == 1 and scene.margin is not None
    pairs = torch.tensor([[0, 1]], device=device)
    trusted = pgccd.VertexMotion._of_checked(motion.x_t0, motion.x_t1) if kind == "deforming" else motion[:]
    scene.margin[1] = value
    named = r"^margin: body 1: expected a finite length >= 0, at most 1e\+150, got " + str(value).replace("+", r"\+")
    calls: list[Callable[[], Any]] = [
        *(lambda p=p: pgccd.detect(scene, motion, broad_phase=p) for p in ("sweep", "grid", "lbvh")),
        lambda: pgccd.detect(scene, motion, "all", pairs=pairs),
        lambda: pgccd.detect(scene, motion, memory_budget=1),
        lambda: pgccd.detect(scene, trusted),
        lambda: pgccd.MovingBodies.of(scene, motion),
        lambda: pgccd.MovingBodies.of(scene, trusted),
        lambda: pgccd.detect(scene, motion, capacity=Capacity.of(9)).trim(),
        lambda: pgccd.detect(scene, trusted, capacity=Capacity.of(9)).trim(),
        lambda: pgccd.detect(scene, motion, capacity=Capacity.of(9), pairs=pairs).trim(),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=named):
            call()
    assert bool(pgccd.detect(scene, motion, capacity=Capacity.of(9)).overflow)
    scene.margin[1] = 0.001
    assert pgccd.detect(scene, motion) == expected
    assert pgccd.detect(scene, motion, capacity=Capacity.of(9)).trim() == expected


@pytest.mark.parametrize("kind", KINDS)
def test_stages_called_alone_validate_margins(kind: str) -> None:
    scene, motion = moving(kind)
    made = pgccd.MovingBodies.of(scene, motion)
    pairs = pgccd.broad.sweep(made)
    candidates, _ = pgccd.traverse.find_candidates(made, pairs)
    assert scene.margin is not None
    scene.margin[0] = -1.0
    for stage in (
        lambda: pgccd.broad.grid(made),
        lambda: pgccd.traverse.find_candidates(made, pairs),
        lambda: pgccd.narrow.find_contacts(made, pairs, candidates),
    ):
        with pytest.raises(ValueError, match="^margin: body 0: .*, got -1.0"):
            stage()


def test_margins_in_memory_shared_with_numpy() -> None:
    b = bodies()
    shared = np.zeros(2)
    scene = pgccd.Scene(b.meshes, margin=torch.from_numpy(shared))
    assert len(pgccd.detect(scene, b.motion())) == 1
    shared[0] = -3.0
    with pytest.raises(ValueError, match="^margin: body 0: .*, got -3.0"):
        pgccd.detect(scene, b.motion())


@pytest.mark.parametrize("kind", ["rigid", "deforming"])
def test_a_trajectory_validates_margins_and_waypoints(kind: str) -> None:
    scene, step = moving(kind)
    if kind == "rigid":
        position = torch.stack([step.position_t0, step.position_t1, step.position_t0])
        trajectory = pgccd.Trajectory(position, step.orientation_t0.repeat(3, 1, 1))
    else:
        trajectory = pgccd.Trajectory(torch.stack([step.x_t0, step.x_t1, step.x_t0]))
    assert len(pgccd.detect(scene, trajectory)) == 1 and scene.margin is not None
    scene.margin[1] = -1.0
    with pytest.raises(ValueError, match="^margin: body 1: .*, got -1.0"):
        pgccd.detect(scene, trajectory)
    scene.margin[1] = 0.0
    trajectory.position[2, 1, 0] = NAN
    row = "body" if kind == "rigid" else "vertex"
    for use in (lambda: pgccd.detect(scene, trajectory), lambda: trajectory.segment(1)):
        with pytest.raises(ValueError, match=rf"^position: waypoint 2, {row} 1: expected finite .*, got \[nan, "):
            use()
    trajectory.segment(0)
    trajectory.position = None  # type: ignore[assignment]
    with pytest.raises(TypeError, match="^position: expected a float32 or float64 tensor, got None"):
        pgccd.detect(scene, trajectory)


@pytest.mark.parametrize("kind", ["rigid", "deforming"])
def test_captured_loops_validate_margins(kind: str, device: torch.device) -> None:
    scene, motion = moving(kind, device)
    expected = pgccd.detect(scene, motion)
    captured = pgccd.CapturedDetection(scene, motion)
    assert captured(motion).trim() == expected and scene.margin is not None
    scene.margin[0] = -1.0
    assert bool(captured(motion).overflow)
    with pytest.raises(ValueError, match="^margin: body 0: .*, got -1.0"):
        captured.contacts()
    scene.margin[0] = 0.0
    assert captured(motion).trim() == expected
    captured = pgccd.CapturedDetection(scene, motion)
    assert captured(motion).trim() == expected
    scene.margin = torch.tensor([0.0, NAN], dtype=torch.float64, device=device)  # another tensor: captured again
    with pytest.raises(ValueError, match="^margin: body 1: .*, got nan"):
        captured(motion).trim()
    captured = pgccd.CapturedDetection(scene, motion, capacity=Capacity.of(9))
    scene.margin = None
    assert len(captured(motion).trim()) == 1


def test_captured_loops_follow_the_meshes(device: torch.device) -> None:
    b = bodies()
    small = pgccd.Mesh(1e-3 * b.meshes[0].vertices, b.meshes[0].faces)
    scene, motion = pgccd.Scene([small, b.meshes[0]], [0, 0], device), b.motion(device=device)
    captured = pgccd.CapturedDetection(scene, motion, capacity=Capacity.of(100))
    assert len(captured(motion).trim()) == 0
    scene.mesh_index[:] = 1
    expected = pgccd.detect(pgccd.Scene([small, b.meshes[0]], [1, 1], device), motion)
    assert len(expected) == 1 and captured(motion).trim() == expected


@pytest.mark.parametrize("wrong", [-1, 2, 2**31 - 1, -(2**31)])
def test_a_mesh_written_later_is_validated(wrong: int, device: torch.device) -> None:
    scene, motion = moving("rigid", device)
    expected = pgccd.detect(scene, motion)
    scene.mesh_index[1] = wrong
    for options in ({}, {"capacity": Capacity.of(9)}):
        with pytest.raises(ValueError, match=f"^mesh_index: body 1: expected a mesh from 0 to 1 .*, got {wrong}"):
            pgccd.detect(scene, motion, **options).trim()  # type: ignore[call-overload]
    scene.mesh_index[1] = 1
    assert pgccd.detect(scene, motion) == expected


def test_meshes_written_without_torch() -> None:
    b = bodies()
    small = pgccd.Mesh(1e-3 * b.meshes[0].vertices, b.meshes[0].faces)
    meshes = [small, b.meshes[0]]
    for motion in (b.motion(), moving("deforming")[1]):
        scene = pgccd.Scene(meshes, [0, 0])
        without_torch = scene.mesh_index.numpy()
        pgccd.detect(scene, motion)
        without_torch[:] = 1
        assert pgccd.detect(scene, motion) == pgccd.detect(pgccd.Scene(meshes, [1, 1]), motion)
        without_torch[1] = 7
        with pytest.raises(ValueError, match="^mesh_index: body 1: .*, got 7"):
            pgccd.detect(scene, motion)


def test_meshes_written_later_are_validated_in_a_capacity() -> None:
    scene, motion = moving("rigid")
    expected = pgccd.detect(scene, motion)
    assert pgccd.detect(scene, motion, capacity=Capacity.of(9)).trim() == expected
    scene.mesh_index[1] = 5
    found = pgccd.detect(scene, motion, capacity=Capacity.of(9))
    assert bool(found.overflow)
    with pytest.raises(ValueError, match="^mesh_index: body 1: expected a mesh from 0 to 1 .*, got 5"):
        found.trim()


@pytest.mark.slow
def test_compiled_steps_validate_margins(device: torch.device) -> None:
    scene, motion = moving("rigid", device)
    expected = pgccd.detect(scene, motion)

    @torch.compile(fullgraph=True, backend="aot_eager")
    def step(x0: torch.Tensor, q0: torch.Tensor, x1: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = pgccd.detect(scene, pgccd.RigidMotion(x0, q0, x1, q0), capacity=Capacity.of(100))
        return found.toi[:1], found.overflow

    columns = motion.position_t0, motion.orientation_t0, motion.position_t1
    reference = pgccd.detect(scene, pgccd.RigidMotion(*columns, motion.orientation_t0))
    toi, overflow = step(*columns)
    assert torch.equal(toi, reference.toi) and not bool(overflow) and len(expected) == 1
    assert scene.margin is not None
    scene.margin[0] = -1.0
    assert bool(step(*columns)[1])


def test_worlds_written_later_are_validated(device: torch.device) -> None:
    b = bodies()
    scene = pgccd.Scene(b.meshes, device=device, world=[3, 3])
    x, q = tensors(b.position_t0, b.orientation_t0, device=device)
    hits = pgccd.detect(scene, b.motion(device=device))
    assert scene.world is not None and len(hits.first_toi("world")) == 4
    scene.world[1] = -1
    for use in (
        lambda: hits.first_toi("world"),
        lambda: pgccd.detect(scene, pgccd.Trajectory(torch.stack([x, x]), torch.stack([q, q]))),
        lambda: pgccd.Scene(b.meshes, world=[3, -1]),
    ):
        with pytest.raises(ValueError, match="^world: body 1: expected an id in .*, got -1"):
            use()


def test_what_is_written_to_the_radius_has_no_effect() -> None:
    scene, motion = moving("rigid")
    expected = pgccd.detect(scene, motion)
    scene.radius[:] = 0.0
    assert pgccd.detect(scene, motion) == expected
    with pytest.raises(AttributeError):
        scene.radius = torch.zeros(2)  # type: ignore[misc]


def test_what_collides_with_itself_is_fixed(device: torch.device) -> None:
    b, (_, motion) = bodies(), moving("deforming", device)
    none, some = (pgccd.Scene(b.meshes, device=device, self_collision=own) for own in (False, [True, False]))
    pgccd.detect(none, motion)
    pgccd.detect(some.to(device), motion)
    with pytest.raises(ValueError, match="^self_collision: it is fixed: make a new Scene"):
        none.self_collision = torch.tensor([True, True], device=device)
    assert some.self_collision is not None
    some.self_collision[1] = True
    with pytest.raises(ValueError, match="^self_collision: it is fixed, but was written to"):
        pgccd.detect(some, motion)


def test_a_path_replaced_by_something_else() -> None:
    scene, motion = moving("rigid")
    with pytest.raises(ValueError, match="^path: expected one of .*, got 'Linear'"):
        motion.path = "Linear"
    assert len(pgccd.detect(scene, motion)) == 1


def test_errors_give_the_value(device: torch.device) -> None:
    scene, made = moving("rigid", device)
    motion = pgccd.RigidMotion.from_rotation(**made.columns())
    cases: list[tuple[str, float, str]] = [
        ("position_t0", NAN, r"finite numbers up to 1e\+150, got \[.*, .*, nan\]"),
        ("position_t1", 1e160, r"finite numbers up to 1e\+150, got \[.*, .*, 1e\+160\]"),
        ("orientation_t0", 3.0, r"a unit quaternion \(w, x, y, z\), got \[.*, .*, 3.0, .*\] of norm 3\.\d+"),
        ("rotation", 1e7, r"a turn of at most 1e\+06 radians in the step, got \[.*, 10000000.0\] of length 1e\+07"),
    ]
    for name, value, message in cases:
        former = getattr(motion, name)[1].clone()
        getattr(motion, name)[1, 2] = value
        with pytest.raises(ValueError, match=f"^{name}: body 1: expected {message}$"):
            pgccd.detect(scene, motion)
        padded = pgccd.detect(scene, motion, capacity=Capacity.of(9))
        getattr(motion, name)[1] = former
        with pytest.raises(ValueError, match=f"^{name}: body 1: expected [^[]*$"):  # the value has been overwritten
            padded.trim()
    x, q = tensors(np.zeros((2, 3)), STILL, device=device)
    with pytest.raises(ValueError, match=r"^orientation_t1: body 0: .*, got \[1.2, 0.0, 0.0, 0.0\] of norm 1.2$"):
        pgccd.detect(scene, pgccd.RigidMotion(x, q, x, 1.2 * q))
    with pytest.raises(ValueError, match=r"^position: body 0: .*, got \[inf, 0.0, 0.0\]$"):
        fast = torch.tensor([[INF, 0.0, 0.0]] * 2, dtype=torch.float64)
        pgccd.RigidMotion.from_velocity(fast, q.cpu(), x.cpu(), x.cpu(), 1.0)
    if device.type == "cpu":
        for pairs, message in (([[0, 2]], r"row 0 is \[0, 2\]"), ([[0, 1], [0, 1]], r"row 0 is \[0, 1\]")):
            with pytest.raises(ValueError, match=f"^pairs: expected .*; {message}"):
                pgccd.detect(scene, motion, pairs=torch.tensor(pairs))


def test_radii_of_bodies_with_sound_rows(device: torch.device) -> None:
    x, q = torch.zeros((4, 3)), torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1)
    columns = [column.double().to(device) for column in (x, x.clone(), q, x.clone(), torch.ones(4))]
    of_meshes = torch.tensor([2.0, 3.0], dtype=torch.float64, device=device)
    index = torch.tensor([1, 0, 0, 1], dtype=torch.int32, device=device)
    given = torch.tensor([4.0, -INF, 5.0, 6.0], dtype=torch.float64, device=device)

    def radii(given: torch.Tensor | None, *changed: tuple[int, int, float]) -> tuple[list[float], list[int]]:
        p0, p1, turned, rotation, margin = written = [column.clone() for column in columns]
        for column, row, value in changed:
            written[column][row] = value
        radius, first = pgccd.ops.sound_radii(of_meshes, index, given, p0, p1, turned, rotation, margin)
        return radius.tolist(), first.tolist()

    assert radii(None) == ([3.0, 2.0, 2.0, 3.0], [4, 4, 4, 4, 4, 4, 0])
    assert radii(given) == ([4.0, -INF, 5.0, 6.0], [4, 4, 4, 4, 4, 0])
    wrong = [(0, 3, NAN), (1, 0, 1.01e150), (2, 2, 0.51), (3, 2, 5.8e5), (4, 3, -1.0)]
    assert radii(None, *wrong) == ([-INF, 2.0, -INF, -INF], [3, 0, 2, 2, 4, 3, 1])
    assert radii(None, (0, 0, 1e150), (2, 0, 0.5004), (3, 1, 5.7e5), (4, 2, 1e150))[1] == [4, 4, 4, 4, 4, 4, 0]
    for mesh in (-1, 2):
        index[1] = mesh
        assert radii(None) == ([3.0, -INF, 2.0, 3.0], [4, 4, 4, 4, 1, 4, 1])
    assert radii(given)[1] == [4, 4, 4, 4, 4, 0]


def test_numbers_of_checks() -> None:
    """They are those of the operator, which refuses others."""
    column = torch.tensor([[0.5], [-0.5], [2.0], [NAN]], dtype=torch.float64)
    first = pgccd.ops.first_invalid_rows([column] * 5, list(CHECK_NUMBERS.values()), [1.0, 0.6, 1.0, 1.0, 1.0])
    assert first.tolist() == [2, 2, 2, 1, 1, 1]
    with pytest.raises(RuntimeError, match="checks: expected"):
        pgccd.ops.first_invalid_rows([column], [5], [1.0])


@pytest.mark.parametrize("radius", [0.0, 1e-30, 1.0, 1e30, -1.0, 0.999e-30, 1.001e30, NAN, INF, -0.0])
def test_radii_are_zero_or_of_a_size(radius: float) -> None:
    """By the operator as by the words of the error."""
    found = pgccd.ops.first_invalid_rows(
        [torch.tensor([[radius]], dtype=torch.float64)], [CHECK_NUMBERS["size"]], [1e30]
    )
    is_invalid = not (radius == 0.0 or 1e-30 <= radius <= 1e30)
    assert found.tolist() == [1 - is_invalid, is_invalid] and RADIUS.is_invalid([radius]) == is_invalid
