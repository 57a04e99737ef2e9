"""Which bodies `enclosed` reports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support import solids
from support.shapes import tensors, unit_quaternions
from support.solids import Surface

import pgccd
from pgccd.geometry.solids import opening, vertices_of_components

# Rotations of a cube onto itself whose quaternions and matrices have no rounding errors.
EXACT_TURNS = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, -0.5]])
SPECK = (
    0.125 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
NESTED = [solids.ball(1, 3.0), solids.ball(1, 2.0), solids.ball(1, 1.0)]


def still(surfaces: list[Surface], device: torch.device | str, deforms: bool, **filters: Any) -> Any:
    """A scene of bodies at rest, and their motion."""
    scene = pgccd.Scene([pgccd.Mesh(*s) for s in surfaces], device=device, **filters)
    if deforms:
        x = tensors(np.concatenate([s[0] for s in surfaces]), device=device)[0]
        return scene, pgccd.VertexMotion(x, x)
    count = len(surfaces)
    poses = tensors(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), device=device)
    return scene, pgccd.RigidMotion.at_rest(*poses)


def inside(surfaces: list[Surface], device: torch.device | str = "cpu", deforms: bool = False) -> list[list[int]]:
    """Rows of `enclosed` for bodies at rest."""
    return pgccd.enclosed(*still(surfaces, device, deforms)).tolist()


@pytest.fixture(params=[False, True], ids=["rigid", "deforming"])
def deforms(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


def test_components() -> None:
    vertices, faces = solids.joined(solids.ball(2), solids.torus(), SPECK)
    assert vertices_of_components(faces).tolist() == [0, 162, 162 + 192]
    rng = np.random.default_rng(3)
    chain = np.stack([np.arange(500), np.arange(1, 501), np.arange(2, 502)], axis=1)
    order = rng.permutation(1200)
    chains = order[np.concatenate([chain, chain + 600])]
    assert vertices_of_components(chains).tolist() == sorted([order[:502].min(), order[600:1102].min()])


@pytest.mark.parametrize("turn", range(len(EXACT_TURNS)))
def test_lattice_points_in_a_box(device: torch.device, deforms: bool, turn: int) -> None:
    """Specks at all points of a lattice, of which some touch the box; their rays meet its vertices and edges."""
    outer = solids.voxels(np.ones((3, 3, 3)))
    places = np.argwhere(np.ones((6, 6, 6))) - 1.0
    expected = [[1 + k, 0] for k, x in enumerate(places) if (x > 0).all() and (x < 3).all()]
    if deforms:
        surfaces = [outer, *(solids.moved(SPECK, x) for x in places)]
        assert inside(surfaces, device, True) == expected
        return
    meshes = [pgccd.Mesh(*outer), pgccd.Mesh(*SPECK)]
    scene = pgccd.Scene(meshes, [0] + [1] * len(places), device)
    q = EXACT_TURNS[turn]
    position = np.concatenate([np.zeros((1, 3)), rotated(q, places)]) + 64.0
    poses = tensors(position, np.tile(q, (len(position), 1)), device=device)
    assert pgccd.enclosed(scene, pgccd.RigidMotion.at_rest(*poses)).tolist() == expected


def rotated(quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    w, v = quaternion[0], quaternion[1:]
    return points + 2 * np.cross(v, np.cross(v, points) + w * points)


def test_nested(device: torch.device, deforms: bool) -> None:
    assert inside(NESTED, device, deforms) == [[1, 0], [2, 0], [2, 1]]
    assert inside(NESTED[::-1], device, deforms) == [[0, 1], [0, 2], [1, 2]]
    # The boxes and spheres around them overlap, the bodies do not.
    assert inside([NESTED[0], solids.moved(NESTED[2], [2.4, 2.4, 2.4])], device, deforms) == []


def test_shapes_with_holes(device: torch.device, deforms: bool) -> None:
    torus, small = solids.torus(), solids.ball(0, 0.2)
    assert inside([torus, small, solids.moved(small, [2, 0, 0])], device, deforms) == [[2, 0]]
    hollow = solids.joined(solids.ball(1, 3.0), solids.inverted(solids.ball(1, 2.0)))
    assert inside([hollow, small, solids.moved(small, [0, 0, 2.45])], device, deforms) == [[2, 0]]


def test_several_pieces(device: torch.device, deforms: bool) -> None:
    small = solids.ball(0, 0.2)
    two = solids.joined(small, solids.moved(small, [10, 0, 0]))
    balls = [solids.ball(), solids.moved(solids.ball(), [10, 0, 0])]
    assert inside([two, balls[0]], device, deforms) == []  # the other piece is outside
    assert inside([two, solids.joined(*balls)], device, deforms) == [[0, 1]]
    assert inside([solids.joined(*balls), small, solids.moved(small, [5, 0, 0])], device, deforms) == [[1, 0]]


def test_triangles_may_face_inwards(device: torch.device, deforms: bool) -> None:
    assert inside([solids.inverted(NESTED[0]), NESTED[2]], device, deforms) == [[1, 0]]
    assert inside([solids.inverted(NESTED[0]), solids.inverted(NESTED[2])], device, deforms) == [[1, 0]]


def test_touching_bodies_are_contacts(device: torch.device, deforms: bool) -> None:
    outer = solids.box([0, 0, 0], [8, 8, 8])
    for lower, upper in (([0, 1, 1], [2, 2, 2]), ([2, 2, 6], [3, 3, 8]), ([0, 0, 0], [8, 8, 8])):
        scene, motion = still([outer, solids.box(lower, upper)], device, deforms)
        assert pgccd.enclosed(scene, motion).tolist() == []
        assert pgccd.collide(scene, motion).pairs.tolist() == [[0, 1]]


def test_no_pair_falls_between(device: torch.device, deforms: bool) -> None:
    """However near to the wall from inside, a body is enclosed or in contact."""
    gaps = 10.0 ** -np.arange(1.0, 18.0)
    inner = [solids.box([1, 1, 1], [2, 2, 2 - gap]) for gap in gaps]
    outer = [solids.box([0, 0, 0], [3, 3, 2])] * len(gaps)
    surfaces = [s for pair in zip(outer, inner, strict=True) for s in pair]
    world = np.repeat(np.arange(len(gaps)), 2).tolist()
    scene, motion = still(surfaces, device, deforms, world=world)
    if not deforms:
        q = (1 + 5e-4) * unit_quaternions(np.random.default_rng(6), 1).repeat(2 * len(gaps), axis=0)
        motion = pgccd.RigidMotion.at_rest(motion.position_t0, *tensors(q, device=device))
    within = pgccd.enclosed(scene, motion)[:, 1].tolist()
    touching = pgccd.collide(scene, motion, tolerance=0.0).pairs[:, 0].tolist()
    assert sorted(within + touching) == list(range(0, 2 * len(gaps), 2))
    # 2 - 1e-16 is 2; points of rigid bodies have errors of some 1e-13.
    assert (len(within) == 15) if deforms else (11 <= len(within) <= 15)


@pytest.mark.parametrize("offset", [0.0, 1e6, 1e12])
def test_far_from_the_origin(device: torch.device, deforms: bool, offset: float) -> None:
    """Bodies near one another; only where they are relative to each other counts."""
    at = np.full(3, offset)
    boxes = [solids.box(at + [0, 0, 0], at + [4, 4, 4]), solids.box(at + [1, 1, 1], at + [2, 2, 2])]
    boxes.append(solids.box(at + [3, 3, 5], at + [5, 5, 7]))
    meshes = [pgccd.Mesh(*solids.moved(b, -at), origin="centroid") for b in boxes]
    x, q = np.stack([m.origin.numpy() + at for m in meshes]), np.tile([1.0, 0, 0, 0], (3, 1))
    motion: Any = pgccd.RigidMotion.at_rest(*tensors(x, q, device=device))
    if deforms:
        x = tensors(np.concatenate([b[0] for b in boxes]), device=device)[0]
        motion = pgccd.VertexMotion(x, x)
    assert pgccd.enclosed(pgccd.Scene(meshes, device=device), motion).tolist() == [[1, 0]]


def crowd(device: torch.device | str) -> tuple[pgccd.Scene, pgccd.RigidMotion, list[list[int]]]:
    """Balls of very different sizes at random places and orientations, and which are certainly inside which. Pairs that
    may touch are in different worlds.
    """
    rng = np.random.default_rng(4)
    radii = np.array([4.0, 1.0, 0.25])
    meshes = [pgccd.Mesh(*solids.ball(2, r), origin=(0.3 * r, 0, r)) for r in radii]
    kind = rng.choice(3, 250, p=[0.1, 0.3, 0.6])
    orientation = unit_quaternions(rng, 250)
    centre = rng.uniform(-5, 5, (250, 3))
    origin = np.stack([rotated(q, meshes[k].origin.numpy()) for q, k in zip(orientation, kind, strict=True)])
    size = radii[kind]
    apart = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    within = apart + size[:, None] < 0.96 * size[None]  # all vertices are at the radius, all faces beyond 0.96 of it
    disjoint = apart > size[:, None] + size[None]
    keep: list[int] = []
    for k in range(250):
        if all(within[k, j] or within[j, k] or disjoint[k, j] for j in keep):
            keep.append(k)
    rows = np.array(keep)
    scene = pgccd.Scene(meshes, kind[rows].tolist(), device)
    motion = pgccd.RigidMotion.at_rest(*tensors((centre + origin)[rows], orientation[rows], device=device))
    return scene, motion, np.argwhere(within[np.ix_(rows, rows)]).tolist()


def test_crowd(device: torch.device) -> None:
    scene, motion, expected = crowd(device)
    assert pgccd.enclosed(scene, motion).tolist() == expected and len(expected) > 20


def test_only_the_start_counts(device: torch.device) -> None:
    scene, motion, expected = crowd(device)
    x, q = motion.position_t0, motion.orientation_t0
    later, turned = x + 3.0 * torch.rand_like(x), q[torch.randperm(len(q))]
    for path in ("rigid", "linear"):
        assert pgccd.enclosed(scene, pgccd.RigidMotion(x, q, later, turned, path)).tolist() == expected
    trajectory = pgccd.Trajectory(torch.stack([x, later]), torch.stack([q, turned]))
    assert pgccd.enclosed(scene, trajectory).tolist() == expected


def test_filters_and_margins(device: torch.device, deforms: bool) -> None:
    def rows(**columns: Any) -> list[list[int]]:
        return pgccd.enclosed(*still(NESTED, device, deforms, **columns)).tolist()

    everything = [[1, 0], [2, 0], [2, 1]]
    assert rows(margin=0.9) == rows(self_collision=True) == rows(static=[True, False, False]) == everything
    assert rows(world=[0, 1, 0]) == [[2, 0]]
    assert rows(static=[True, True, False]) == [[2, 0], [2, 1]]
    assert rows(group=[1, 2, 1], mask=[2, 1, 2]) == [[1, 0], [2, 1]]


def test_few_bodies(device: torch.device, deforms: bool) -> None:
    found = pgccd.enclosed(*still(NESTED[:1], device, deforms, self_collision=True))
    assert found.shape == (0, 2) and found.dtype == torch.int64 and found.device == torch.empty(0, device=device).device
    none = torch.empty(0, 3), torch.empty(0, 4)
    assert len(pgccd.enclosed(pgccd.Scene([pgccd.Mesh(*NESTED[0])], []), pgccd.RigidMotion.at_rest(*none))) == 0


def alone() -> pgccd.RigidMotion:
    """One body at rest."""
    return pgccd.RigidMotion.at_rest(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))


def test_open_meshes_are_refused(deforms: bool) -> None:
    vertices, faces = solids.ball()
    flipped = faces.copy()
    flipped[7] = flipped[7][::-1]
    cases = {"no triangle passes from vertex": faces[1:], "more than one triangle passes from vertex": flipped}
    cases["more than one triangle"] = np.concatenate([faces, faces[:1]])
    for fault, wrong in cases.items():
        scene, motion = still([NESTED[0], (vertices, wrong)], "cpu", deforms)
        with pytest.raises(ValueError, match=f"^scene: body 1: expected a watertight mesh, but in mesh 1 {fault}"):
            pgccd.enclosed(scene, motion)
    # Meshes that no body uses do not matter.
    unused = pgccd.Scene([pgccd.Mesh(vertices, faces[1:]), pgccd.Mesh(*NESTED[0])], [1])
    assert len(pgccd.enclosed(unused, alone())) == 0
    named = pgccd.Mesh(vertices, faces[1:])
    named.name = "lid"
    with pytest.raises(ValueError, match=r"mesh 0 \('lid'\)"):
        pgccd.enclosed(
            pgccd.Scene([named]), pgccd.RigidMotion.at_rest(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
        )


def test_openings() -> None:
    _, faces = solids.torus()
    assert opening(faces) is None and opening(faces[:, ::-1]) is None
    assert opening(faces[1:]) is not None
    assert opening(np.array([[0, 1, 2], [0, 2, 1]])) is None  # both sides of one triangle


@pytest.mark.parametrize(
    ("scene", "motion", "message"),
    [(None, None, "scene"), (pgccd.Scene([pgccd.Mesh(*NESTED[0])]), None, "motion"), (1, torch.zeros(1, 3), "scene")],
)
def test_wrong_arguments(scene: Any, motion: Any, message: str) -> None:
    with pytest.raises(TypeError, match=f"^{message}: expected"):
        pgccd.enclosed(scene, motion)


@pytest.mark.cuda
def test_cuda_gives_the_rows_of_the_cpu() -> None:
    found = [pgccd.enclosed(*crowd(device)[:2]) for device in ("cpu", "cuda")]
    assert torch.equal(found[0], found[1].cpu()) and len(found[0]) > 20
