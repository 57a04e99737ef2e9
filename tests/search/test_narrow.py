"""The narrow phase on arbitrary candidates: pairs culled by the traversal do not touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.elementary import solve
from support.shapes import Bodies, approaching, tensors
from support.truth import assert_nothing_missed, end_positions, feature_indices, rigid_truth, rows_of

import pgccd
from pgccd.contacts.contacts import contacts_of

COLUMNS = 8


def everything(bodies: Bodies, pairs: torch.Tensor) -> torch.Tensor:
    """Every feature pair of every body pair as a candidate."""
    rows = []
    for row, (i, j) in enumerate(pairs.tolist()):
        a, b = bodies.meshes[i], bodies.meshes[j]
        counts = (
            (pgccd.Kind.VF_AB, len(a.vertices), len(b.faces)),
            (pgccd.Kind.VF_BA, len(a.faces), len(b.vertices)),
            (pgccd.Kind.EE, len(a.edges), len(b.edges)),
            (pgccd.Kind.EF_AB, len(a.edges), len(b.faces)),
            (pgccd.Kind.EF_BA, len(a.faces), len(b.edges)),
        )
        for kind, first, second in counts:
            grid = torch.cartesian_prod(torch.arange(first), torch.arange(second))
            rows.append(torch.cat([torch.tensor([[row, kind]]).expand(len(grid), 2), grid], dim=1))
    return torch.cat(rows).to(torch.int32).to(pairs.device)


def crowd(seed: int, count: int = 5, turn: float = 1.5) -> Bodies:
    rng = np.random.default_rng([1, seed])
    return approaching(rng, (0,) * count, tuple(rng.uniform(0.6, 1.5, count)), turn=turn, closeness=0.7)


def moving(bodies: Bodies, device: torch.device, kind: str) -> pgccd.MovingBodies:
    if kind != "deforming":
        return pgccd.MovingBodies.of(bodies.scene(device), bodies.motion(kind, device))  # type: ignore[arg-type]
    ends = [end_positions(bodies, b) for b in range(len(bodies.meshes))]
    x = tensors(*(np.concatenate([e[t] for e in ends]) for t in (0, 1)), device=device)
    return pgccd.MovingBodies.of(bodies.scene(device), pgccd.VertexMotion(*x))


@pytest.mark.parametrize("kind", ["rigid", "linear", "deforming"])
@pytest.mark.parametrize("separation", [0.0, 0.1])
def test_culling_loses_nothing(device: torch.device, kind: str, separation: float) -> None:
    """Reports on all feature pairs equal those on the traversal's candidates, bitwise."""
    bodies = crowd(0)
    moved = moving(bodies, device, kind)
    pairs = pgccd.broad.sweep(moved, separation)
    candidates, _ = pgccd.traverse.find_candidates(moved, pairs, separation)
    whole = everything(bodies, pairs)
    assert len(pairs) > 3 and 0 < len(candidates) < len(whole) / 2
    reports: tuple[Any, ...] = ("all", "first", "earliest", "any")
    for report in reports:
        few, many = (pgccd.narrow.find_contacts(moved, pairs, c, report, separation) for c in (candidates, whole))
        assert len(few) == len(many) == COLUMNS
        columns = range(1) if report == "any" else range(COLUMNS)
        assert all(torch.equal(few[c], many[c]) for c in columns), report
        assert len(few[0]) > 0


def test_rows_are_as_detect_gives_them(device: torch.device) -> None:
    bodies = crowd(1)
    moved = moving(bodies, device, "rigid")
    pairs = pgccd.broad.sweep(moved)
    rows = pgccd.narrow.find_contacts(moved, pairs, pgccd.traverse.find_candidates(moved, pairs)[0], "all")
    hits = pgccd.detect(bodies.scene(device), bodies.motion(device=device), "all")
    assert torch.equal(pairs[rows[0].long()], hits.pairs)
    columns = (hits.kind, hits.features, hits.status, hits.toi, hits.coordinates, hits.point, hits.normal)
    assert all(torch.equal(a, b) for a, b in zip(rows[1:], columns, strict=True))
    types = (torch.int8, torch.int32, torch.int8, *[torch.float64] * 4)
    assert tuple(c.dtype for c in columns) == types
    assert all(len(c) == len(hits) for c in columns) and hits.point.shape == hits.normal.shape == (len(hits), 3)


def test_brute_force_candidates_against_the_oracle(device: torch.device) -> None:
    bodies = crowd(2, 2)
    pairs = torch.tensor([[0, 1]], device=device)
    moved = moving(bodies, device, "rigid")
    pair, *columns = pgccd.narrow.find_contacts(moved, pairs, everything(bodies, pairs), "all")
    hits = contacts_of((pairs[pair.long()], *columns), "all", pgccd.Stats())
    truth = rigid_truth(bodies)
    assert len(truth.contacts) > 0
    assert_nothing_missed(rows_of(hits), truth)


def test_deforming_rows_are_the_elementary_ones(device: torch.device) -> None:
    """Equal bits from the elementary test on the same paths."""
    bodies = crowd(3, 2)
    pairs = torch.tensor([[0, 1]], device=device)
    moved = moving(bodies, device, "deforming")
    rows = pgccd.narrow.find_contacts(moved, pairs, everything(bodies, pairs), "all", 0.01, 1e-7)
    ends = [end_positions(bodies, b) for b in (0, 1)]
    faces = (bodies.meshes[0].faces.long().numpy(), bodies.meshes[1].faces.long().numpy())
    for kind in (pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE):
        whole = everything(bodies, pairs)[:, 1:].tolist()
        keys = [tuple(k) for k in whole if k[0] == kind]
        first, second = (1, 0) if kind == pgccd.Kind.VF_BA else (0, 1)
        index = feature_indices(faces, keys, kind)
        start, end = (np.concatenate([ends[first][t][index[0]], ends[second][t][index[1]]], axis=1) for t in (0, 1))
        status, toi, coordinates = solve(start, end, kind != pgccd.Kind.EE, 0.01, 1e-7, device=device)
        touching = np.flatnonzero(status != pgccd.Status.FREE)
        mine = (rows[1] == int(kind)).cpu()
        assert [keys[k][1:] for k in touching] == [tuple(f) for f in rows[2].cpu()[mine].tolist()]
        assert np.array_equal(toi[touching], rows[4].cpu()[mine].numpy())
        assert np.array_equal(coordinates[touching], rows[5].cpu()[mine].numpy())
        assert len(touching) > 0


def test_tolerance_only_adds_near_misses(device: torch.device) -> None:
    bodies = crowd(4)
    scene, motion = bodies.scene(device), bodies.motion(device=device)
    tables = []
    for tolerance in (1e-9, 1e-4, 1e-2, 0.1):
        hits = pgccd.detect(scene, motion, "all", tolerance=tolerance)
        keys = torch.cat([hits.pairs, hits.kind[:, None].long(), hits.features.long()], dim=1).tolist()
        tables.append(dict(zip(map(tuple, keys), hits.toi.tolist(), strict=True)))
    for tight, loose in zip(tables, tables[1:], strict=False):
        assert tight.keys() <= loose.keys()
        assert all(loose[key] <= tight[key] for key in tight)
    assert len(tables[0]) < len(tables[-1])


def test_no_candidates(device: torch.device) -> None:
    moved = moving(crowd(5), device, "rigid")
    none = torch.zeros((0, 4), dtype=torch.int32, device=device)
    reports: tuple[Any, ...] = ("all", "first", "earliest", "any")
    for report in reports:
        rows = pgccd.narrow.find_contacts(moved, torch.tensor([[0, 1]], device=device), none, report)
        assert [tuple(r.shape) for r in rows] == [(0,), (0,), (0, 2), (0,), (0,), (0, 2), (0, 3), (0, 3)]


def test_names_of_the_outcomes() -> None:
    assert pgccd.Kind.names() == {0: "VF_AB", 1: "VF_BA", 2: "EE", 3: "EF_AB", 4: "EF_BA", 5: "INSIDE"}
    assert pgccd.Status.names() == {0: "FREE", 1: "TOUCH", 2: "UNRESOLVED"}
    # Subclasses of int are constants to torch.compile, whatever they are compared with.
    assert type(pgccd.Kind.EE) is int and type(pgccd.Status.FREE) is int
