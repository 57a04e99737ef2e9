"""Audits: planted tunnelling is found and nothing else, by separating axes and by coal; what frames show; streaming."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from support.cases import mostly_slow
from support.rollouts import Rollout, Rows, planted, rows_of, tumbling
from support.shapes import height_field

import pgccd
from pgccd.auditing import audit as auditing
from pgccd.motion import windows

UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def frames_of(*positions: list[list[float]]) -> pgccd.Trajectory:
    """Upright bodies at the positions of each frame."""
    position = torch.tensor(positions, dtype=torch.float64)
    return pgccd.Trajectory(position, UPRIGHT.expand(*position.shape[:2], 4))


def plate_and_dart(**filters: object) -> pgccd.Scene:
    return pgccd.Scene([pgccd.Mesh.box([2.0, 2.0, 0.1]), pgccd.Mesh.box([0.1, 0.1, 0.02])], **filters)  # type: ignore[arg-type]


def heights(*z: float) -> pgccd.Trajectory:
    """A plate at rest, and a dart at these heights."""
    return frames_of(*([[0.0, 0.0, 0.0], [0.3, 0.2, each]] for each in z))


def runs_of(touching: pgccd.Touching) -> list[tuple[int, ...]]:
    return [
        (*pair, first, last)
        for pair, first, last in zip(
            touching.pairs.tolist(), touching.first.tolist(), touching.last.tolist(), strict=True
        )
    ]


@pytest.mark.parametrize("seed", range(3))
def test_planted_tunnelling_is_found_and_nothing_else(seed: int, device: torch.device) -> None:
    rollout, rows = planted(np.random.default_rng(seed), 40, 12)
    assert len(rows) > 15
    found = pgccd.audit(rollout.scene(device), rollout.trajectory(device))
    assert rows_of(found.passages) == rows
    assert len(found.touching) == len(found.enclosed) == 0 and found.frames == 12
    assert bool((found.passages.status == pgccd.Status.TOUCH).all())


@pytest.mark.parametrize("seed", mostly_slow(range(3), [0]))
def test_random_rollouts_agree_with_separating_axes(seed: int) -> None:
    rollout = tumbling(np.random.default_rng(seed), 12, 9, 3.0)
    deep, any_at_all = rollout.overlapping_between(depth=1e-3)
    assert len(deep) > 20
    found = pgccd.audit(rollout.scene(), rollout.trajectory())
    rows = rows_of(found.passages)
    assert deep <= rows
    # The others only graze, or have passed between two samples: the boxes meet at toi.
    columns = found.passages.segment.numpy(), found.passages.toi.numpy(), *found.passages.pairs.numpy().T
    gap = rollout.gap(*columns)
    assert np.abs(gap).max() < 2e-6 and len(rows - any_at_all) < 0.2 * len(rows)
    for end in (0.0, 1.0):
        assert rollout.gap(columns[0], np.full(len(gap), end), *columns[2:]).min() > 0.0
    # What frames show: solids that overlap. Those that touch are wholly inside or in `touching`.
    i, j = np.triu_indices(len(rollout.half), 1)
    touching = {(f, a, b) for a, b, first, last in runs_of(found.touching) for f in range(first, last + 1)}
    for frame in range(9):
        segment, time = (frame, 0.0) if frame < 8 else (7, 1.0)
        gap = rollout.gap(np.full(len(i), segment), np.full(len(i), time), i, j)
        overlapping = {(frame, int(a), int(b)) for a, b in zip(i[gap < 0.0], j[gap < 0.0], strict=True)}
        at_frame = {row for row in touching if row[0] == frame}
        assert at_frame <= overlapping
        position, orientation = (torch.tensor(c[frame]) for c in (rollout.position, rollout.orientation))
        inside = pgccd.enclosed(rollout.scene(), pgccd.RigidMotion.at_rest(position, orientation)).tolist()
        assert overlapping - at_frame == {(frame, min(pair), max(pair)) for pair in inside}


def sampled_by_coal(rollout: Rollout, samples: int = 400) -> Rows:
    """Pairs that coal finds apart at both frames, and overlapping at one of so many times between them."""
    coal = pytest.importorskip("coal")
    shapes, rows = [coal.Box(*(2.0 * h)) for h in rollout.half], set()
    pairs = np.argwhere(np.triu(np.ones((len(shapes),) * 2), 1)).astype(int)
    reach = np.linalg.norm(rollout.half, axis=1)

    def overlap(i: int, j: int, segment: int, time: float) -> bool:
        placed = []
        for body in (i, j):
            x, axes, _ = rollout.at(np.array([segment]), np.array([time]), np.array([body]))
            placed.append(coal.Transform3s(axes[0].T, x[0]))
        request, result = coal.CollisionRequest(), coal.CollisionResult()
        return coal.collide(shapes[i], placed[0], shapes[j], placed[1], request, result) > 0

    for segment in range(len(rollout.position) - 1):
        for i, j in pairs.tolist():
            lines = rollout.position[[segment, segment + 1]][:, [i, j]]
            offset = lines[:, 1] - lines[:, 0]
            move = offset[1] - offset[0]
            nearest = np.clip(-(offset[0] @ move) / max(move @ move, 1e-30), 0.0, 1.0)
            if np.linalg.norm(offset[0] + nearest * move) > reach[i] + reach[j]:
                continue
            if not overlap(i, j, segment, 0.0) and not overlap(i, j, segment, 1.0):
                times = np.linspace(0.0, 1.0, samples)
                if any(overlap(i, j, segment, t) for t in times):
                    rows.add((segment, i, j))
    return rows


def test_planted_tunnelling_agrees_with_coal() -> None:
    rollout, rows = planted(np.random.default_rng(7), 12, 6)
    rollout.half[:12, 2] = 0.02  # so that samples do not jump across the plate
    assert sampled_by_coal(rollout) == rows == rows_of(pgccd.audit(rollout.scene(), rollout.trajectory()).passages)


def test_what_a_passage_is() -> None:
    scene = plate_and_dart()
    found = pgccd.audit(scene, heights(1.0, 0.5, -0.25, -1.0))
    assert rows_of(found.passages) == {(1, 0, 1)} and len(found.touching) == len(found.enclosed) == 0
    gap = 0.5 - 0.05 - 0.01
    assert found.passages.toi.tolist() == pytest.approx([gap / 0.75], abs=1e-6)
    assert found.passages.time.tolist() == pytest.approx([(1.0 + gap / 0.75) / 3.0], abs=1e-6)
    assert found.passages.approach.tolist() == pytest.approx([0.75], rel=1e-12)
    assert found.passages.measure.tolist() == pytest.approx([0.75 - gap], rel=1e-5)
    assert found.passages.body_count == scene.body_count and found.passages.stats.contacts == 1
    # A segment that ends in the plate, or starts there, is shown by the frame.
    found = pgccd.audit(scene, heights(1.0, 0.055, -1.0, 1.0))
    assert rows_of(found.passages) == {(2, 0, 1)} and runs_of(found.touching) == [(0, 1, 1, 1)]
    # Resting contacts are runs of frames; so is one at the last frame alone.
    found = pgccd.audit(scene, heights(0.06, 0.06, 1.0, 0.06, 0.055, 0.06, 1.0, 0.06))
    assert runs_of(found.touching) == [(0, 1, 0, 1), (0, 1, 3, 5), (0, 1, 7, 7)] and not len(found.passages)
    # Nothing moves, nothing touches.
    found = pgccd.audit(scene, heights(1.0, 1.0))
    assert not len(found.passages) and not len(found.touching) and found.steps() == ([], [])


def test_bodies_inside_others_are_shown_by_frames() -> None:
    scene = plate_and_dart()
    found = pgccd.audit(scene, heights(1.0, 0.0, 0.01, -1.0))
    assert rows_of(found.enclosed) == {(0, 0, 1), (2, 0, 1)}
    assert not len(found.passages) and not len(found.touching)
    assert found.enclosed.measure.tolist() == pytest.approx([0.06, 1.01 - 0.05], rel=1e-4)
    # A surface that is not watertight has no inside.
    open_box = pgccd.Mesh.box([2.0, 2.0, 0.1])
    parts = pgccd.Mesh(open_box.vertices, open_box.faces[1:]), scene.meshes.meshes[1]
    found = pgccd.audit(pgccd.Scene(parts), heights(1.0, 0.0, 0.01, -1.0))
    assert rows_of(found.passages) == {(0, 0, 1), (2, 0, 1)} and not len(found.enclosed)


def test_separations_margins_and_filters() -> None:
    near = heights(1.0, 0.08, 1.0)  # 0.02 above the plate at frame 1
    assert len(pgccd.audit(plate_and_dart(), near).touching) == 0
    for found in (
        pgccd.audit(plate_and_dart(), near, min_separation=0.03),
        pgccd.audit(plate_and_dart(margin=[0.01, 0.02]), near),
    ):
        assert runs_of(found.touching) == [(0, 1, 1, 1)] and not len(found.passages)
    # Margins of the trajectory are those of paths, and count between frames only.
    margin = torch.tensor([[0.0, 0.0], [0.01, 0.02]])
    for z, rows, toi in ((near, {(1, 0, 1)}, 0.0), (heights(1.0, 0.095, 0.085), {(1, 0, 1)}, 0.5)):
        loose = pgccd.Trajectory(z.position, z.orientation, margin=margin)
        found = pgccd.audit(plate_and_dart(), loose)
        assert rows_of(found.passages) == rows and not len(found.touching)
        assert found.passages.toi.tolist() == pytest.approx([toi], abs=1e-4)
        assert found.passages.measure.tolist() == pytest.approx([0.0 if toi == 0.0 else 0.005], abs=1e-6)
    passing = heights(1.0, -1.0)
    assert len(pgccd.audit(plate_and_dart(), passing).passages) == 1
    for filters in ({"exclude": [[0, 1]]}, {"world": [0, 1]}, {"static": [True, True]}):
        assert len(pgccd.audit(plate_and_dart(**filters), passing).passages) == 0


def test_turns_of_more_than_half_a_revolution() -> None:
    mill, peg = pgccd.Mesh.box([2.0, 0.1, 0.1]), pgccd.Mesh.box([0.1, 0.1, 0.1])
    position = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]]).expand(3, 2, 3)
    rotation = torch.zeros(2, 2, 3)
    rotation[:, 0, 2] = torch.pi * torch.tensor([2.0, 0.1])
    turning = pgccd.Trajectory(position, UPRIGHT.expand(2, 4), rotation=rotation)
    scene = pgccd.Scene([mill, peg])
    assert rows_of(pgccd.audit(scene, turning).passages) == {(0, 0, 1)}
    assert not len(pgccd.audit(scene, pgccd.Trajectory(turning.position, turning.orientation)).passages)


def test_deforming_bodies() -> None:
    rng = np.random.default_rng(2)
    cloth, ball = height_field(rng, 4, 4, 0.1), pgccd.Mesh.box([0.2, 0.2, 0.2])
    scene = pgccd.Scene([cloth, ball])
    x = [cloth.vertices, ball.vertices + torch.tensor([2.1, 1.8, 1.0])]
    waving = [cloth.vertices + 0.3 * torch.sin(cloth.vertices[:, :1] + k) for k in range(3)]
    frames = [torch.cat([waving[0], x[1]]), torch.cat([waving[1], x[1] - torch.tensor([0.0, 0.0, 3.0])])]
    frames.append(torch.cat([waving[2], x[1] - torch.tensor([0.0, 0.0, 3.1])]))
    for rollout in (frames, [frame.numpy() for frame in frames], pgccd.Trajectory(torch.stack(frames))):
        found = pgccd.audit(scene, rollout)  # type: ignore[arg-type]
        assert rows_of(found.passages) == {(0, 0, 1)} and len(found.steps()[0]) == 1


def gap_along_normal(
    scene: pgccd.Scene, motion: pgccd.RigidMotion | pgccd.VertexMotion, hits: pgccd.Contacts, row: int, time: float
) -> float:
    """Of the nearest points at toi, held fixed on the features, along the normal."""
    points = []
    for side, body in enumerate(hits.pairs[row].tolist()):
        mesh = scene.meshes.meshes[int(scene.mesh_index[body])]
        if isinstance(motion, pgccd.RigidMotion) and motion.path == "rigid":
            (x,), (q,) = (column[body : body + 1].numpy() for column in motion.at(time))
            w, v = q[0], q[1:]
            p = mesh.vertices.numpy()
            vertices = x + p + 2 * np.cross(v, np.cross(v, p) + w * p)
        else:
            assert isinstance(motion, pgccd.VertexMotion)
            first = int(scene.layout.vertex_begin[body])
            vertices = motion.at(time)[first : first + len(mesh.vertices)].numpy()
        kind, feature = int(hits.kind[row]), int(hits.features[row, side])
        u, v_ = hits.coordinates[row].tolist()
        if kind == pgccd.Kind.EE:
            a, b = vertices[mesh.edges.numpy()[feature]]
            points.append(a + (u, v_)[side] * (b - a))
        elif kind == side:  # VF_AB: the vertex is the first one's
            points.append(vertices[feature])
        else:
            a, b, c = vertices[mesh.faces.numpy()[feature]]
            points.append(a + u * (b - a) + v_ * (c - a))
    return float((points[1] - points[0]) @ hits.normal[row].numpy())


@pytest.mark.parametrize("kind", ["rigid", "linear", "deforming"])
def test_approach_is_the_rate_of_the_gap(kind: str) -> None:
    rollout = tumbling(np.random.default_rng(5), 10, 6, 3.0)
    scene, given = rollout.scene(), rollout.trajectory()
    trajectory = pgccd.Trajectory(given.position, given.orientation, "linear" if kind == "linear" else "rigid")
    vertices = []
    for x, q in zip(given.position, given.orientation, strict=True):
        for body, mesh in enumerate(scene.meshes.meshes):
            w, v = q[body, :1], q[body, 1:].expand_as(mesh.vertices)
            turned = mesh.vertices + 2 * torch.linalg.cross(v, torch.linalg.cross(v, mesh.vertices) + w * mesh.vertices)
            vertices.append(turned + x[body])
    as_vertices = pgccd.Trajectory(torch.cat(vertices).view(6, -1, 3))
    found = pgccd.audit(scene, as_vertices if kind == "deforming" else trajectory, min_separation=0.01)
    assert len(found.passages) > 20 and len(set(found.passages.kind.tolist())) == 3
    for row, segment in enumerate(found.passages.segment.tolist()):
        motion = (trajectory if kind == "rigid" else as_vertices).segment(segment)
        toi, h = float(found.passages.toi[row]), 1e-6
        ends = [gap_along_normal(scene, motion, found.passages, row, t) for t in (toi - h, toi + h)]
        assert float(found.passages.approach[row]) == pytest.approx(abs(ends[1] - ends[0]) / (2 * h), rel=1e-6)
        assert float(found.passages.measure[row]) == pytest.approx((1 - toi) * float(found.passages.approach[row]))


def same(a: pgccd.Audit, b: pgccd.Audit) -> bool:
    runs = [[column.tolist() for column in vars(each.touching).values()] for each in (a, b)]
    return a.passages == b.passages and a.enclosed == b.enclosed and runs[0] == runs[1] and a.frames == b.frames


@pytest.mark.cuda
@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_bits_are_the_same_on_a_gpu(path: str) -> None:
    rollout = tumbling(np.random.default_rng(1), 12, 9, 2.0)
    found = []
    for device in ("cpu", "cuda"):
        columns = (torch.tensor(c, device=device) for c in (rollout.position, rollout.orientation))
        found.append(pgccd.audit(rollout.scene(device), pgccd.Trajectory(*columns, path=path)))  # type: ignore[arg-type,misc]
    for of_cpu, of_gpu in ((getattr(each, name) for each in found) for name in ("passages", "enclosed")):
        assert of_gpu.pairs.device.type == "cuda" and of_gpu.to("cpu") == of_cpu
    assert runs_of(found[0].touching) == runs_of(found[1].touching)


def in_windows_of(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "_ROWS", rows)


@pytest.mark.parametrize("rows", [1, 30, 64, 1000])
def test_windows_do_not_change_the_result(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rollout = tumbling(np.random.default_rng(1), 12, 9, 2.0)
    rollout.half[0], rollout.position[:, 0] = 0.6, 1.0  # others are inside of it at some frames
    rollout.position[4:, :6] = rollout.position[4, :6]  # runs of several windows
    scene, trajectory = rollout.scene(), rollout.trajectory()
    whole = pgccd.audit(scene, trajectory)
    assert len(whole.passages) > 10 and len(whole.enclosed) > 0 and len(whole.touching) > 10
    assert any(last - first > 2 for *_, first, last in runs_of(whole.touching))
    in_windows_of(rows, monkeypatch)
    assert same(pgccd.audit(scene, trajectory), whole)
    assert same(pgccd.audit(scene, zip(trajectory.position, trajectory.orientation, strict=True)), whole)
    # A simulator writes every frame to the same memory.
    x, q = np.zeros((12, 3)), np.zeros((12, 4))

    def simulated() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in range(9):
            x[:], q[:] = rollout.position[frame], rollout.orientation[frame]
            yield x, q

    assert same(pgccd.audit(scene, simulated()), whole)


def test_frames_are_held_a_window_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    in_windows_of(2 * 10, monkeypatch)
    made, most, segments = 0, 0, 0
    along = torch.linspace(0.0, 1.0, 500, dtype=torch.float64)

    def frames() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        nonlocal made
        for shift in along.tolist():
            made += 1
            yield torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.2, 1.0 + shift]], dtype=torch.float64), UPRIGHT.expand(2, 4)

    def watched(*given: Any) -> Iterator[pgccd.Trajectory]:
        nonlocal most, segments
        for part in windows.windows(*given):
            most = max(most, made - segments, len(part.position))
            yield part
            segments += part.segment_count

    monkeypatch.setattr(auditing, "windows", watched)
    assert pgccd.audit(plate_and_dart(), frames()).frames == 500
    assert most == 11


def test_deepest_segments_are_kept_for_a_picture(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    rollout = tumbling(np.random.default_rng(3), 12, 30, 3.0)
    scene, trajectory = rollout.scene(), rollout.trajectory()
    in_windows_of(50, monkeypatch)
    found = pgccd.audit(scene, trajectory, keep=5)
    deepest = {}
    for segment, measure in zip(found.passages.segment.tolist(), found.passages.measure.tolist(), strict=True):
        deepest[segment] = max(measure, deepest.get(segment, 0.0))
    expected = sorted(sorted(deepest, key=lambda segment: -deepest[segment])[:5])
    motions, contacts = found.steps()
    for segment, motion, hits in zip(expected, motions, contacts, strict=True):
        assert isinstance(motion, pgccd.RigidMotion)
        assert torch.equal(motion.position_t0, trajectory.position[segment])
        assert hits.toi.tolist() == found.passages.toi[found.passages.segment == segment].tolist()
    pages = [pgccd.viz.Page.of(scene, motions, contacts), pgccd.viz.Page.of(scene, trajectory, found.passages)]
    assert "5 steps" in pages[0].title and "30 waypoints" in pages[1].title
    assert pgccd.audit(scene, trajectory, keep=0).steps() == ([], [])


@pytest.mark.parametrize(
    ("rollout", "error", "message"),
    [
        (None, TypeError, r"trajectory: expected a pgccd.Trajectory, or frames.*got None"),
        (torch.zeros(3, 2, 3), TypeError, r"trajectory: expected a pgccd.Trajectory"),
        ([], ValueError, "trajectory: expected at least two frames, got 0"),
        ([(torch.zeros(2, 3), UPRIGHT.expand(2, 4))], ValueError, "trajectory: expected at least two frames, got 1"),
        ([(torch.zeros(3, 3), UPRIGHT.expand(3, 4))], ValueError, r"trajectory: frame 0: position: expected.*2, 3"),
        ([(torch.zeros(2, 3),)], ValueError, "trajectory: frame 0: expected a position.*got 1 values"),
        ([(torch.zeros(2, 3), "upright")], TypeError, "trajectory: frame 0: orientation: expected numbers"),
        ([torch.zeros(16, 3), (torch.zeros(2, 3), UPRIGHT.expand(2, 4))], ValueError, "frame 1: expected vertices"),
        ([torch.zeros(5, 3)] * 2, ValueError, r"trajectory: frame 0: vertices: expected.*16, 3"),
        (
            [(torch.zeros(2, 3), UPRIGHT.expand(2, 4)), (torch.full((2, 3), torch.nan), UPRIGHT.expand(2, 4))],
            ValueError,
            "trajectory: counted from frame 0: position: waypoint 1, body 0: .*nan",
        ),
        (frames_of([[0.0] * 3] * 3, [[0.0] * 3] * 3), ValueError, "trajectory: has 3 bodies, the scene 2"),
    ],
)
def test_errors_name_the_frame(rollout: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        pgccd.audit(plate_and_dart(), rollout)  # type: ignore[arg-type]


def test_errors_of_options() -> None:
    scene, rollout = plate_and_dart(), heights(1.0, -1.0)
    for name, value in {
        "min_separation": -1.0,
        "tolerance": -1.0,
        "path": "arc",
        "keep": -1,
    }.items():
        with pytest.raises(ValueError, match=f"{name}: expected"):
            pgccd.audit(scene, rollout, **{name: value})  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"scene: expected a pgccd\.Scene"):
        pgccd.audit(rollout, rollout)  # type: ignore[arg-type]
    with pytest.warns(UserWarning, match="it has one body"):
        pgccd.audit(pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])]), frames_of([[0.0] * 3], [[1.0] * 3]))


def test_states_of_passages() -> None:
    """As those of other contacts, with their own columns."""
    scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], [0, 0])
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)
    frames = [(torch.tensor([[0.0, 0, 0], [x, 0.1, 0.2]]), upright) for x in (-3.0, 3.0, 3.0)]
    passages = pgccd.audit(scene, frames).passages
    assert len(passages) == 1
    again = pgccd.auditing.results.Passages.from_state_dict(passages.state_dict())
    for name, column in passages.columns.items():
        assert torch.equal(getattr(again, name), column), name
    assert float(again.measure) == float(passages.measure) > 0.0
    state = passages.state_dict() | {"measure": passages.measure.float()}
    with pytest.raises(TypeError, match="^measure: expected torch.float64"):
        type(passages).from_state_dict(state)
