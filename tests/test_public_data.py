"""Public ground truth (Wang et al. 2021; Belgrod et al. 2023): 0 missed, and no more false positives than recorded
here.

Runs if the environment variable PGCCD_CCD_DATA names a folder with `queries/NAME.{vf,ee}.npz` (points (n, 8, 3): the
four points at t0, then at t1; collides (n,)) and `scenes/NAME.npz` (vertices_t0, vertices_t1, faces, edges, vf_pairs,
ee_pairs, vf_collides, ee_collides).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from support.elementary import solve

import pgccd

DATA = Path(os.environ.get("PGCCD_CCD_DATA", ""))
NONE = "PGCCD_CCD_DATA is not set"
pytestmark = pytest.mark.skipif("PGCCD_CCD_DATA" not in os.environ, reason=NONE)


def names(pattern: str) -> list[str]:
    found = sorted(p.name for p in DATA.glob(pattern)) if "PGCCD_CCD_DATA" in os.environ else []
    return found or ["none"]


# Present false positives at tolerance 1e-6; more is a regression.
QUERY_FALSE_POSITIVES = {"erleben-cube-cliff-edges.vf.npz": 1}
SCENE_FALSE_POSITIVES: dict[str, int] = {}


@pytest.mark.parametrize("name", names("queries/*.npz"))
def test_queries(name: str) -> None:
    with np.load(DATA / "queries" / name) as file:
        points, collides = file["points"], file["collides"]
    status, toi, _ = solve(points[:, :4], points[:, 4:], ".vf." in name)
    assert int((collides & (status == pgccd.Status.FREE)).sum()) == 0, "missed"
    false_positives = int((~collides & (status != pgccd.Status.FREE)).sum())
    unresolved = int((status == pgccd.Status.UNRESOLVED).sum())
    print(f"{name}: {len(points)} queries, {false_positives} false positives, {unresolved} unresolved")  # noqa: T201
    assert false_positives <= QUERY_FALSE_POSITIVES.get(name, 0)


def load_scene(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / "scenes" / name) as file:
        return dict(file)


def pair_points(scene: dict[str, np.ndarray], is_face: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at both ends, and truth, of a scene's list of pairs."""
    key = "vf" if is_face else "ee"
    first, second = scene[f"{key}_pairs"].T
    index = [first[:, None] if is_face else scene["edges"][first], scene["faces" if is_face else "edges"][second]]
    vertices = np.concatenate(index, axis=1)
    return scene["vertices_t0"][vertices], scene["vertices_t1"][vertices], scene[f"{key}_collides"]


@pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])
@pytest.mark.parametrize("name", names("scenes/*.npz"))
def test_scene_pairs(name: str, is_face: bool) -> None:
    start, end, collides = pair_points(load_scene(name), is_face)
    status, _, _ = solve(start, end, is_face)
    assert int((collides & (status == pgccd.Status.FREE)).sum()) == 0, "missed"
    false_positives = int((~collides & (status != pgccd.Status.FREE)).sum())
    unresolved = int((status == pgccd.Status.UNRESOLVED).sum())
    key = f"{name}.{'vf' if is_face else 'ee'}"
    print(f"{key}: {len(start)} pairs, {false_positives} false positives, {unresolved} unresolved")  # noqa: T201
    assert false_positives <= SCENE_FALSE_POSITIVES.get(key, 0)


def components(faces: np.ndarray, count: int) -> np.ndarray:
    """(count,) label of each vertex, the smallest vertex of its connected component."""
    label = np.arange(count)
    while True:
        least = label[faces].min(axis=1)
        smaller = label.copy()
        for corner in range(3):
            np.minimum.at(smaller, faces[:, corner], least)
        smaller = smaller[smaller]
        if np.array_equal(smaller, label):
            return label
        label = smaller


@pytest.mark.parametrize("name", names("scenes/*.npz"))
def test_contacts_between_components(name: str) -> None:
    """The scene's connected components as deforming bodies: every true contact between two of them is found."""
    scene = load_scene(name)
    faces, edges = scene["faces"].astype(np.int64), scene["edges"].astype(np.int64)
    label = components(faces, len(scene["vertices_t0"]))
    parts, body_of_face = np.unique(label[faces[:, 0]], return_inverse=True)
    body_of = {int(part): k for k, part in enumerate(parts)}
    local = np.full(len(label), -1)
    meshes, rows = [], []
    face_of: list[np.ndarray] = []
    for k, part in enumerate(parts):
        mine = np.flatnonzero(label == part)
        local[mine] = np.arange(len(mine))
        face_of.append(np.flatnonzero(body_of_face == k))
        meshes.append(pgccd.Mesh(scene["vertices_t0"][mine], local[faces[face_of[-1]]]))
        rows.append(mine)
    order = np.concatenate(rows)
    motion = pgccd.VertexMotion(*(torch.from_numpy(scene[key][order]) for key in ("vertices_t0", "vertices_t1")))
    hits = pgccd.detect(pgccd.Scene(meshes), motion, "all", tolerance=1e-6)

    # Contacts in the scene's numbering: (kind, first, second), vertex first, edges by their two vertices.
    found = set()
    global_edges = [rows[k][m.edges.numpy()] for k, m in enumerate(meshes)]
    for (i, j), kind, (a, b) in zip(hits.pairs.tolist(), hits.kind.tolist(), hits.features.tolist(), strict=True):
        if kind == pgccd.Kind.EE:
            pair = sorted([tuple(sorted(global_edges[i][a].tolist())), tuple(sorted(global_edges[j][b].tolist()))])
            found.add(("ee", *pair))
        elif kind == pgccd.Kind.VF_AB:
            found.add(("vf", int(rows[i][a]), int(face_of[j][b])))
        else:
            found.add(("vf", int(rows[j][b]), int(face_of[i][a])))
    assert len(found) == len(hits), "a contact is listed twice"

    true, listed_free = set(), set()
    for (v, f), collides in zip(scene["vf_pairs"].tolist(), scene["vf_collides"].tolist(), strict=True):
        if body_of.get(int(label[v])) != body_of_face[f]:
            (true if collides else listed_free).add(("vf", v, f))
    for (a, b), collides in zip(scene["ee_pairs"].tolist(), scene["ee_collides"].tolist(), strict=True):
        ends = [tuple(sorted(edges[e].tolist())) for e in (a, b)]
        if label[ends[0][0]] != label[ends[1][0]]:
            (true if collides else listed_free).add(("ee", *sorted(ends)))
    extra = found - true
    summary = f"{len(parts)} bodies, {len(true)} true contacts, {len(found)} found, {len(true - found)} missed, "
    print(f"{name}: {summary}{len(extra)} extra ({len(extra - listed_free)} not listed)")  # noqa: T201
    assert true - found == set(), "missed"
    assert len(extra) <= SCENE_FALSE_POSITIVES.get(f"{name}.bodies", 0)
    assert hits.stats.unresolved <= len(hits) // 100


@pytest.mark.parametrize("name", names("scenes/*.npz"))
def test_contacts_of_one_body(name: str, device: torch.device) -> None:
    """The whole scene as one body that collides with itself: exactly the true contacts of the list."""
    scene = load_scene(name)
    mesh = pgccd.Mesh(scene["vertices_t0"], scene["faces"])
    ends = [torch.from_numpy(scene[key]).to(device) for key in ("vertices_t0", "vertices_t1")]
    bodies = pgccd.Scene([mesh], device=device, self_collision=True)
    hits = pgccd.detect(bodies, pgccd.VertexMotion(*ends), "all", tolerance=1e-6)

    # One number per row from kind, first, second. The scene numbers edges differently from the mesh.
    vertices = len(scene["vertices_t0"])
    of_mesh, of_scene = (
        np.sort(e, axis=1) @ np.array([vertices, 1]) for e in (mesh.edges.long().numpy(), scene["edges"])
    )
    renumbered = np.searchsorted(of_mesh, of_scene)
    assert np.array_equal(of_mesh[renumbered], of_scene)
    key = np.array([2**60, 2**30, 1])
    vf, ee = (
        scene["vf_pairs"][scene["vf_collides"]],
        np.sort(renumbered[scene["ee_pairs"]], axis=1)[scene["ee_collides"]],
    )
    rows = [np.insert(pairs, 0, kind, axis=1) for kind, pairs in ((pgccd.Kind.VF_AB, vf), (pgccd.Kind.EE, ee))]
    true = np.concatenate(rows).astype(np.int64) @ key
    found = torch.cat([hits.kind.long()[:, None], hits.features.long()], dim=1).cpu().numpy() @ key
    assert len(np.unique(found)) == len(found), "a contact is listed twice"

    missed, extra = np.setdiff1d(true, found), np.setdiff1d(found, true)
    per_contact = hits.stats.candidates / max(1, len(true))
    print(f"{name}: {len(true)} true contacts, {len(found)} found, {len(missed)} missed, {len(extra)} extra", end=", ")  # noqa: T201
    print(f"{per_contact:.1f} candidates a true contact")  # noqa: T201
    assert len(missed) == 0
    assert len(extra) <= SCENE_FALSE_POSITIVES.get(f"{name}.self", 0)
    assert hits.stats.unresolved <= len(hits) // 100
