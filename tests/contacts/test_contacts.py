"""Contacts as Python values, and calls that cannot find any: messages say what to write instead."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import numpy as np
import pytest
import torch
from support.reports import detected
from support.shapes import Bodies, approaching, tensors, tetrahedron

import pgccd
from pgccd import distributed
from pgccd.runtime.sizes import Capacity


def bodies() -> Bodies:
    return approaching(np.random.default_rng(0), (0, 0), closeness=0.7)


def along_a_trajectory(device: torch.device | str = "cpu", report: Any = "all") -> pgccd.TrajectoryContacts:
    b = bodies()
    x, q = tensors(np.stack([b.position_t0, b.position_t1, b.position_t0]), np.stack([b.orientation_t0] * 3))
    return detected(b.scene(device), pgccd.Trajectory(x.to(device), q.to(device)), report)


def of_one_step(device: torch.device | str = "cpu", report: Any = "all") -> pgccd.Contacts:
    b = bodies()
    return detected(b.scene(device), b.motion(device=device), report)


@pytest.mark.parametrize("report", ["all", "any"])
@pytest.mark.parametrize("make", [of_one_step, along_a_trajectory])
def test_contacts_are_compared_bit_by_bit(
    make: Callable[..., pgccd.Contacts], report: str, device: torch.device
) -> None:
    hits, again = make(device, report), make(device, report)
    assert len(hits) > 0 and hits == hits and hits == again == hits.clone()
    assert hits != hits[:0] and hits != 3 and hits is not again
    for name, column in hits.columns.items():
        other = hits.clone()
        values = getattr(other, name)
        values.reshape(-1)[0] = np.nextafter(float(column.reshape(-1)[0]), 9.0) if values.is_floating_point() else 9
        assert hits != other, name
    with pytest.raises(TypeError, match="unhashable"):
        hash(hits)


@pytest.mark.parametrize("report", get_args(pgccd.Report))
@pytest.mark.parametrize("make", [of_one_step, along_a_trajectory])
def test_no_report_has_a_late_toi(make: Callable[..., pgccd.Contacts], report: str, device: torch.device) -> None:
    """Whichever contacts a report keeps: they are contacts of "all", and `first_toi` is not that of later ones."""
    every, hits = make(device, "all"), make(device, report)
    assert len(set(every.toi.tolist())) > 1
    assert torch.equal(hits.first_toi(), every.first_toi())
    rows = [
        {str(row) for row in zip(*(c.tolist() for c in each.columns.values()), strict=True)} for each in (every, hits)
    ]
    assert rows[1] <= rows[0]


def test_padded_contacts_are_compared() -> None:
    b = bodies()
    first, again = (pgccd.detect(b.scene(), b.motion(), capacity=Capacity.of(9)) for _ in range(2))
    assert first == again and first != of_one_step()


def test_subsets_of_trajectories_have_all_columns(device: torch.device) -> None:
    hits = along_a_trajectory(device)
    assert len(hits) > 3 and hits.segment is not None and hits.time is not None
    late = hits.segment == 1
    for picked in (late, torch.nonzero(late).flatten(), slice(2, 4)):
        part = hits[picked]
        for name in (*hits.columns, "segment", "time"):
            assert torch.equal(getattr(part, name), getattr(hits, name)[picked]), name
        assert part.first_toi("body").shape == (2,)
    assert hits.to("cpu").segment.device.type == "cpu"  # type: ignore[union-attr]


def test_single_contacts_and_loops_say_what_to_write() -> None:
    hits = of_one_step()
    with pytest.raises(TypeError, match=r"^rows: expected .* got 0: write hits\[\[0\]\]"):
        hits[0]  # type: ignore[index]
    with pytest.raises(
        TypeError, match=r"^Contacts: not iterable: .*zip\(hits.pairs.tolist\(\), hits.toi.tolist\(\)\)"
    ):
        for _ in hits:  # type: ignore[attr-defined]
            pass
    assert len(hits[[0]]) == 1


def test_representations_are_summaries() -> None:
    hits = along_a_trajectory()
    assert repr(hits) == f"TrajectoryContacts(count={len(hits)}, pcs={hits.stats.pcs}, device=cpu)"
    assert repr(of_one_step()).startswith("Contacts(count=")


@pytest.mark.parametrize("wrong", [None, 3, "rigid", torch.zeros(2, 3), np.zeros((2, 3)), pgccd.RigidMotion])
def test_every_kind_of_motion_is_named(wrong: Any) -> None:
    with pytest.raises(TypeError, match=r"^motion: expected a pgccd.RigidMotion, VertexMotion or Trajectory, got "):
        pgccd.detect(bodies().scene(), wrong)
    with pytest.raises(TypeError, match="^scene: expected a pgccd.Scene, got Trajectory"):
        pgccd.detect(pgccd.Trajectory(torch.zeros(2, 1, 3)), bodies().motion())  # type: ignore[call-overload]


def test_vmap_is_refused_by_name() -> None:
    b = bodies()
    scene, motion = b.scene(), b.motion()
    samples = torch.stack([motion.position_t1] * 3)

    def toi(position_t1: torch.Tensor) -> torch.Tensor:
        moved = pgccd.RigidMotion(motion.position_t0, motion.orientation_t0, position_t1, motion.orientation_t0)
        return pgccd.detect(scene, moved, capacity=Capacity.of(9)).first_toi()

    cases: list[tuple[str, Callable[[torch.Tensor], torch.Tensor], torch.Tensor]] = [
        ("position_t1", toi, samples),
        ("points_t0", lambda x: pgccd.narrow.vertex_face(x, x).toi, torch.rand(2, 5, 4, 3)),
        ("t", lambda t: motion.at(t)[0], torch.rand(4)),
        ("x_t0", lambda x: pgccd.VertexMotion(x, x).at(0.5), samples),
        ("position", lambda x: pgccd.Trajectory(torch.stack([x, x])).position, samples),
        ("margin", lambda m: pgccd.Scene(b.meshes, margin=m).margin, torch.rand(3, 2)),  # type: ignore[arg-type, return-value]
    ]
    for name, call, values in cases:
        with pytest.raises(
            TypeError, match=f"^{name}: torch.vmap is not supported: pass all samples in one call .*`world`"
        ):
            torch.vmap(call)(values)


def poses(count: int, device: torch.device | str = "cpu") -> pgccd.RigidMotion:
    x, q = tensors(np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), device=device)
    return pgccd.RigidMotion(x, q, x, q)


def test_one_body_alone_warns(device: torch.device) -> None:
    mesh = tetrahedron()
    alone, folding = (pgccd.Scene([mesh], device=device, self_collision=own) for own in (False, True))
    x = mesh.vertices.to(device)
    deforms, waypoints = pgccd.VertexMotion(x, x), pgccd.Trajectory(torch.stack([x, x]))
    found = "^scene: it has one body, so no contact can be found: add the bodies that it may meet"
    cases: list[tuple[pgccd.Scene, Any, str]] = [
        (alone, poses(1, device), "$"),
        (alone, deforms, ", or pass self_collision=True to test it against itself$"),
        (alone, waypoints, ", or pass self_collision=True to test it against itself$"),
        (folding, poses(1, device), r"; self_collision applies to bodies that deform \(VertexMotion\)$"),
    ]
    for scene, motion, advice in cases:
        with pytest.warns(UserWarning, match=found + advice) as seen:
            assert len(pgccd.detect(scene, motion)) == 0
        assert seen[0].filename == __file__ and len(seen) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pgccd.detect(folding, deforms)
        pgccd.detect(folding, waypoints)
        pgccd.detect(pgccd.Scene([mesh], [], device), poses(0, device))
        pgccd.detect(pgccd.Scene([mesh], [0, 0], device), poses(2, device))
        pgccd.MovingBodies.of(alone, poses(1, device))


def test_a_rank_with_one_body_does_not_warn() -> None:
    motion = poses(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = pgccd.Scene([tetrahedron()])
        world = distributed.World.create(scene, motion.position_t0, (-9, -9, -9), (9, 9, 9))
        assert len(world.step(motion)) == 0
        waypoints = motion.position_t0.repeat(3, 1, 1), motion.orientation_t0.repeat(3, 1, 1)
        again = distributed.World.create(scene, motion.position_t0, (-9, -9, -9), (9, 9, 9))
        assert len(again.step(pgccd.Trajectory(*waypoints))) == 0


def test_worlds_name_row_and_value() -> None:
    x = torch.zeros(2, 3, dtype=torch.float64)
    world = distributed.World.create(pgccd.Scene([tetrahedron()], [0, 0], margin=0.3), x, (-9, -9, -9), (9, 9, 9))
    assert world.columns["margin"].tolist() == [0.3, 0.3]
    with pytest.raises(ValueError, match=r"^position: row 1: expected finite .*, got \[0.0, 0.0, nan\]"):
        world.move(torch.tensor([[0.0, 0, 0], [0, 0, float("nan")]], dtype=torch.float64))


def test_starts_need_all_first_contacts() -> None:
    """What is left of the earliest contact alone, without those at the start, would read as free."""
    tetrahedron = pgccd.Mesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    x = torch.tensor([[0.0, 0, 0], [0.1, 0.1, 0.1], [9, 0, 0]])
    upright = torch.tensor([[1.0, 0, 0, 0]] * 3)
    scene = pgccd.Scene([tetrahedron], [0, 0, 0])
    motion = pgccd.RigidMotion(x, upright, x + torch.tensor([[0.0, 0, 0], [0, 0, 0], [-8.5, 0, 0]]), upright)
    first = pgccd.detect(scene, motion)
    assert first.starts_intersecting.tolist() == [True, False, False]
    assert 0.0 < float(first[~first.starts_intersecting].first_toi()) < 1.0
    trajectory = pgccd.Trajectory(torch.stack([x, motion.position_t1.float()]), torch.stack([upright, upright]))
    capacity = pgccd.Capacity.of(3)
    earliest = [pgccd.detect(scene, m, "earliest") for m in (motion, trajectory)]
    padded = pgccd.detect(scene, motion, "earliest", capacity=capacity)
    for hits in (*earliest, earliest[0][[0]], first.earliest(), padded, padded.trim()):
        with pytest.raises(ValueError, match='^report: "earliest" leaves out'):
            _ = hits.starts_intersecting


@pytest.mark.parametrize("given", ["constructor", "velocity", "rest", "trajectory"])
def test_positions_that_float32_has_rounded_to_the_size_of_bodies(given: str) -> None:
    scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], mesh_index=[0, 0])
    q = torch.tensor([[1.0, 0, 0, 0]] * 2)

    def moved(x: torch.Tensor) -> pgccd.RigidMotion | pgccd.Trajectory:
        v = torch.zeros(2, 3)
        return {
            "constructor": lambda: pgccd.RigidMotion(x, q, x.double(), q),
            "velocity": lambda: pgccd.RigidMotion.from_velocity(x, q, v, v, dt=1.0),
            "rest": lambda: pgccd.RigidMotion.at_rest(x, q),
            "trajectory": lambda: pgccd.Trajectory(x.expand(3, 2, 3), q.expand(3, 2, 4)),
        }[given]()

    x = torch.tensor([[5.0, 0, 0], [1e7, 0, 0]])
    found = "float32 has rounded the positions of 1 of 2 bodies: that of body 1, of radius 0.866, is a multiple of 1."
    calls: list[Callable[[Any], Any]] = [partial(pgccd.detect, scene), partial(pgccd.resolve, scene)]
    for call in [*calls, partial(pgccd.distance, scene, cutoff=1.0)]:
        with pytest.warns(UserWarning, match=found):
            call(moved(x))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            call(moved(x.double()))
            call(moved(torch.tensor([[5.0, 0, 0], [1e6, 0, 0]])))  # multiples of 1/16


@pytest.mark.filterwarnings("error")
def test_positions_of_points_without_size_are_not_warned_of() -> None:
    x, q = torch.tensor([[5.0, 0, 0], [1e7, 0, 0]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
    scene = pgccd.Scene([pgccd.Mesh.points([[0.0, 0.0, 0.0]])], mesh_index=[0, 0])
    assert len(pgccd.detect(scene, pgccd.RigidMotion.at_rest(x, q), min_separation=0.1)) == 0
