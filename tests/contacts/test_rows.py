"""What all results as columns can do: rows are selected, concatenated, moved, copied, stored and compared."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from support.reports import detected
from support.same_bits import assert_same

import pgccd
from pgccd.auditing.results import Passages

REPORTS = ("any", "first", "all")


def row_of_boxes(device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Twelve boxes in a row, in two worlds of neighbours; each moves against the next one."""
    count = 12
    scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], [0] * count, device, world=torch.arange(count) // 6)
    x = 1.5 * torch.arange(count, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.02, 0.03]).double()
    moved = x + torch.linspace(0.5, 1.4, count).double()[:, None] * torch.tensor([1.0, 0.1, 0.0]).double()
    q = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1)
    moved[::2], moved[1::2] = moved[::2], x[1::2]
    return scene, pgccd.RigidMotion(x, q, moved, q).to(device)


def results(device: torch.device) -> dict[str, Any]:
    """A result of every kind with several rows."""
    scene, motion = row_of_boxes(device)
    x, q = motion.position_t0, motion.orientation_t0
    trajectory = pgccd.Trajectory(torch.stack([x, motion.position_t1, x]), torch.stack([q] * 3))
    found = {report: detected(scene, motion, report) for report in REPORTS}
    found["trajectory"] = pgccd.detect(scene, trajectory, "all")
    found["distance"] = pgccd.distance(scene, motion, cutoff=0.5)
    far = pgccd.RigidMotion(x, q, x + torch.tensor([30.0, 40.0], device=device).repeat(6)[:, None] * x.sign(), q)
    audit = pgccd.audit(scene, [(far.position_t0, q), (motion.position_t1, q), (far.position_t0, q)])
    found["touching"] = audit.touching
    return found


NAMES = ("any", "first", "all", "trajectory", "distance", "touching")


@pytest.mark.parametrize("name", NAMES)
def test_rows(name: str, device: torch.device) -> None:
    hits = results(device)[name]
    count = len(hits)
    assert count > 2
    assert hits == hits.clone() == hits.to("cpu").to(device) == hits[:] and hits != hits[1:]
    assert type(hits).from_state_dict(hits.state_dict()) == hits
    parts = [hits[:1], hits[1:1], hits[1:]]
    both = type(hits).cat(parts)
    assert type(both) is type(hits) and both == hits
    assert type(hits).cat([hits, hits])[count:] == hits and type(hits).cat((hits,)) == hits
    first = next(iter(hits.columns))
    if name != "touching":
        other = replace(hits, **{first: getattr(hits, first) + 1})
        assert other != hits
    for wrong, problem in (
        ([], "results: expected at least one"),
        (hits, "results: expected at least one in a list"),
        ([hits, 3], r"results\[1\]: expected "),
        ([hits, hits.columns], r"results\[1\]: expected "),
        ([hits, hits.to("meta")], r"results\[1\]: is on meta"),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^{problem}"):
            type(hits).cat(wrong)


def test_statistics_of_concatenated_contacts(device: torch.device) -> None:
    scene, motion = row_of_boxes(device)
    hits = pgccd.detect(scene, motion)
    pairs = pgccd.broad.find_pairs(pgccd.MovingBodies.of(scene, motion))
    half = len(pairs) // 2
    parts = [pgccd.detect(scene, motion, pairs=some) for some in (pairs[:half], pairs[half:])]
    both = pgccd.Contacts.cat(parts)
    assert both == hits and len(parts[0]) and len(parts[1])
    for name in ("bodies", "pcs", "candidates", "contacts", "unresolved"):
        assert getattr(both.stats, name) == getattr(hits.stats, name), name
    for by in ("scene", "world", "body"):
        assert torch.equal(both.first_toi(by), hits.first_toi(by))  # type: ignore[arg-type]
    # What one part leaves out, all do.
    earliest = pgccd.Contacts.cat([pgccd.detect(scene, motion, "earliest"), hits])
    assert bool((earliest.first_toi("body") <= hits.first_toi("body")).all())
    with pytest.raises(ValueError, match='^report: "earliest" leaves out'):
        _ = earliest.starts_intersecting


def test_only_contacts_of_the_same_bodies_are_concatenated(device: torch.device) -> None:
    scene, motion = row_of_boxes(device)
    hits = pgccd.detect(scene, motion)
    few = pgccd.detect(scene[torch.arange(6)], motion[torch.arange(6)])
    with pytest.raises(ValueError, match=r"^results\[1\]: is of 6 bodies, the first one of 12"):
        pgccd.Contacts.cat([hits, few])
    for world in (None, 1 - scene.world):
        other = pgccd.Scene(scene.meshes, scene.mesh_index, world=world)
        with pytest.raises(ValueError, match=r"^results\[1\]: is of bodies in other worlds than the first one"):
            pgccd.Contacts.cat([hits, pgccd.detect(other, motion)])
    same = pgccd.Scene(scene.meshes, scene.mesh_index, world=scene.world.clone())
    assert len(pgccd.Contacts.cat([hits, pgccd.detect(same, motion)])) == 2 * len(hits)
    with pytest.raises(ValueError, match=r"^results\[1\]: has payload \['tag'\], the first one \[\]"):
        pgccd.Contacts.cat([hits, replace(hits, payload={"tag": hits.pairs})])
    with pytest.raises(TypeError, match=r"^results\[1\]: expected Contacts, got .*CollidingPairs"):
        pgccd.Contacts.cat([hits, pgccd.collide(scene, motion)])  # type: ignore[list-item]
    with pytest.raises(TypeError, match=r"^results\[0\]: expected "):
        Passages.cat([hits])  # type: ignore[list-item]


def test_gradients_are_concatenated() -> None:
    scene, motion = row_of_boxes(torch.device("cpu"))
    x = motion.position_t0.clone().requires_grad_()
    q = motion.orientation_t0
    wanting = pgccd.RigidMotion(x, q, motion.position_t1, q)
    with_gradient, plain = pgccd.detect(scene, wanting), pgccd.detect(scene, motion)
    both = pgccd.Contacts.cat([plain, with_gradient])
    assert both.differentiable.tolist() == [False] * len(plain) + with_gradient.differentiable.tolist()
    assert bool(with_gradient.differentiable.any())
    both.toi.sum().backward()
    assert x.grad is not None and bool((x.grad != 0.0).any())


@pytest.mark.parametrize("report", REPORTS)
def test_padded_results_are_moved_and_copied(report: str, device: torch.device) -> None:
    scene, motion = row_of_boxes(device)
    hits = detected(scene, motion, report, capacity=pgccd.Capacity.of(40))
    for other in (hits.clone(), hits.to("cpu")):
        assert_same(other.trim().to(device), hits.trim())
        assert other.count.data_ptr() != hits.count.data_ptr() or other.count.device == hits.count.device
        for by in ("scene", "world", "body"):
            assert torch.equal(other.may_collide(by).to(device), hits.may_collide(by))
            assert report == "any" or torch.equal(other.first_toi(by).to(device), hits.first_toi(by))
    kept = hits.clone()
    hits.counts.zero_()
    hits.pairs.zero_()
    assert int(kept.counts.max()) > 0 and int(kept.pairs.max()) > 0


@pytest.mark.parametrize("along", [False, True])
def test_resolutions_are_moved_and_copied(along: bool, device: torch.device) -> None:
    scene, motion = row_of_boxes(device)
    x, q = motion.position_t0, motion.orientation_t0
    path: Any = pgccd.Trajectory(torch.stack([x, motion.position_t1]), torch.stack([q] * 2)) if along else motion
    resolved: Any = pgccd.resolve(scene, path)
    assert bool((resolved.fraction < 1.0).any())
    for other in (resolved.clone(), resolved.to("cpu")):
        assert type(other) is type(resolved) and other.rounds == resolved.rounds
        for name, column in resolved.columns.items():
            assert torch.equal(getattr(other, name).to(device), column), name
        steps = zip(other.segments, resolved.segments, strict=True) if along else [(other.motion, resolved.motion)]
        for made, expected in steps:
            assert made is not expected or device.type == "cpu"
            for name, column in expected.columns().items():
                assert torch.equal(made.columns()[name].to(device), column), name
    fraction = resolved.fraction.clone()
    resolved.clone().fraction.zero_()
    assert torch.equal(resolved.fraction, fraction)
    assert resolved == resolved and resolved != resolved.clone()
