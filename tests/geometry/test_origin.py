"""Origins of meshes: placement by a pose, centre of rotation, and bounds that are never too small."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.cases import mostly_slow
from support.origins import STILL, about_z, all_contacts, beam, moved_to, product, recentred, turn_of
from support.same_bits import assert_same
from support.shapes import Bodies, bumpy, directions, tensors, tetrahedron, turned, unit_quaternions
from support.truth import assert_nothing_missed, assert_rigid_rows_close, rigid_truth, rows_of

import pgccd


def test_what_a_mesh_says_of_its_origin() -> None:
    vertices, faces = beam(np.linspace(0.0, 2.0, 5), 0.1)
    plain = pgccd.Mesh(vertices, faces)
    assert plain.origin.tolist() == [0.0, 0.0, 0.0]
    assert np.array_equal(plain.vertices.numpy(), vertices)
    assert torch.equal(plain.centre_offset, plain.centre)
    assert plain.reach == pytest.approx(plain.radius + float(plain.centre.norm()), rel=1e-14)
    joint = pgccd.Mesh(vertices, faces, [0.0, 0.05, 0.0])
    assert np.array_equal(joint.vertices.numpy(), vertices - [0.0, 0.05, 0.0])
    assert torch.equal(joint.centre, plain.centre) and joint.radius == pytest.approx(plain.radius, rel=1e-15)
    assert torch.equal(joint.centre_offset, plain.centre - joint.origin)
    centred = pgccd.Mesh(vertices, faces, "centroid")
    assert torch.equal(centred.origin, plain.centre)
    assert not centred.centre_offset.any() and centred.reach == centred.radius
    assert pgccd.MeshSet([centred]).is_centred and not pgccd.MeshSet([centred, joint]).is_centred
    for mesh in (plain, joint, centred):
        used = mesh.vertices[mesh.faces.unique().long()]
        assert float(used.norm(dim=1).max()) <= mesh.reach
        assert float((used - mesh.centre_offset).norm(dim=1).max()) <= mesh.radius


def test_the_centre_of_mass_does_not_depend_on_the_tessellation() -> None:
    even = beam(np.linspace(-0.5, 0.5, 11), 0.1)
    skewed = beam(np.concatenate([[-0.5], np.linspace(0.3, 0.5, 40)]), 0.1)
    far = np.array([1e3, -2e3, 5e2])
    for shift in (np.zeros(3), far):
        for vertices, faces in (even, skewed):
            for orientation in (faces, faces[:, ::-1]):
                mesh = pgccd.Mesh(vertices + shift, orientation, "center_of_mass")
                assert np.abs(mesh.origin.numpy() - shift).max() < 1e-12
    assert float(pgccd.Mesh(*skewed, "centroid").origin[0]) > 0.3
    # Two tetrahedra of volumes 1 and 8.
    small = tetrahedron()
    corners = np.concatenate([small.vertices.numpy(), 2.0 * small.vertices.numpy() + [9.0, 0.0, 0.0]])
    both = pgccd.Mesh(corners, np.concatenate([small.faces.numpy(), small.faces.numpy() + 4]), "center_of_mass")
    assert np.abs(both.origin.numpy() - [8.0, 0.0, 0.0]).max() < 1e-12


@pytest.mark.parametrize("distance", [1.5, 1.9])
def test_a_link_about_its_joint_meets_the_ball_in_its_way(distance: float, device: torch.device) -> None:
    vertices, faces = beam(np.array([0.0, 2.0]), 0.1)
    ball = bumpy(np.random.default_rng(0), 3, height=0.0, size=0.07)
    at = distance * np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0])
    hits = {}
    for origin in ("joint", "centroid"):
        link = pgccd.Mesh(vertices, faces, [0.0, 0.0, 0.0] if origin == "joint" else "centroid")
        start, end = (turned(about_z(a)[None], link.origin.numpy()[None])[0] for a in (0.0, np.pi / 2))
        position_t0, position_t1, q0, q1 = tensors(
            np.stack([start, at]), np.stack([end, at]), np.stack([STILL, STILL]), np.stack([about_z(np.pi / 2), STILL])
        )
        scene = pgccd.Scene([link, ball], device=device)
        poses = (c.to(device) for c in (position_t0, q0, position_t1, q1))
        hits[origin] = pgccd.detect(scene, pgccd.RigidMotion(*poses))
    assert len(hits["joint"]) == 1
    # The face is 0.05 from the joint's axis, the ball's centre 0.07 from the face.
    truth = 45.0 - np.degrees(np.arcsin(0.12 / distance))  # 40.4 degrees, at 1.5
    assert 90.0 * float(hits["joint"].toi[0]) == pytest.approx(truth, abs=0.03)
    # About its SBV centre the same link, between the same poses, takes another path and cuts the corner.
    if distance > 1.8:
        assert len(hits["centroid"]) == 0
    else:
        assert abs(90.0 * float(hits["centroid"].toi[0]) - truth) > 0.3


def test_a_spinning_box_meets_the_same_balls_however_it_is_meshed(device: torch.device) -> None:
    rng = np.random.default_rng(3)
    even, skewed = np.linspace(-0.5, 0.5, 3), np.concatenate([[-0.5], np.linspace(0.3, 0.5, 30)])
    ball = bumpy(rng, 1, height=0.0, size=0.02)
    count = 300
    place = np.concatenate([np.zeros((1, 3)), rng.uniform(-0.6, 0.6, (count, 3)) * [1.0, 1.0, 0.1]])
    place[1:, 1] += np.copysign(0.08, place[1:, 1])  # outside the box at t0
    spin = np.zeros((count + 1, 3))
    spin[0, 2] = 2.0
    turn, still = tensors(spin, np.zeros_like(spin), device=device)
    position, orientation = tensors(place, np.tile(STILL, (count + 1, 1)), device=device)
    motion = pgccd.RigidMotion.from_velocity(position, orientation, still, turn, dt=1.0)
    found = []
    for breaks in (even, skewed):
        box = pgccd.Mesh(*beam(breaks, 0.1), "center_of_mass")
        index = torch.tensor([0] + [1] * count)
        scene = pgccd.Scene([box, ball], index, device=device, group=1 + index, mask=2 - index)
        hits = pgccd.detect(scene, motion)
        assert not hits.pairs[:, 0].any()
        found.append(dict(zip(hits.pairs[:, 1].tolist(), hits.toi.tolist(), strict=True)))
    assert len(found[0]) > 30 and found[0].keys() == found[1].keys()
    assert max(abs(found[0][j] - found[1][j]) for j in found[0]) < 1e-4


def _pair(rng: np.random.Generator, reach: float, turn: float, along: bool) -> Bodies:
    """Two bodies that come near each other at t = 1/2, with origins `reach` radii away; with `along` they turn about an
    axis through origin and body, otherwise at a speed that moves them by a few radii at most.
    """
    # At large distances the oracle is slow; use small meshes.
    meshes = [bumpy(rng, 0), bumpy(rng, 0)] if reach < 1e6 else [tetrahedron(), tetrahedron(0.8)]
    radii = [mesh.radius for mesh in meshes]
    away = directions(rng, 2)
    orientation = unit_quaternions(rng, 2)
    if along:
        axis = turned(orientation, away)
        rotation = turn * axis
        # Screw motions: they turn about their axes and move along them.
        orientation = np.array([product(turn_of(-0.5 * w), q) for w, q in zip(rotation, orientation, strict=True)])
        travel = axis * rng.uniform(-1.5, 1.5, (2, 1))
    else:
        rotation = directions(rng, 2) * min(turn, 3.0 / max(reach, 1e-9))
        travel = rng.normal(size=(2, 3))
    meeting = (0.6 if reach < 1e6 else 0.4) * (radii[0] + radii[1]) * directions(rng, 1)[0]
    near = Bodies(meshes, np.stack([np.zeros(3), meeting]) - 0.5 * travel, orientation, travel, rotation)
    return moved_to(near, [reach * radius * u for radius, u in zip(radii, away, strict=True)])


@pytest.mark.parametrize("reach", mostly_slow([0.0, 1.0, 10.0, 1e3, 1e6], [1.0, 1e3]))
@pytest.mark.parametrize("turn", [1.0, 6.0])
@pytest.mark.parametrize("along", [False, True], ids=["swing", "screw"])
def test_arcs_about_any_origin_agree_with_the_oracle(
    reach: float, turn: float, along: bool, device: torch.device
) -> None:
    bodies = _pair(np.random.default_rng([int(reach), int(turn), along]), reach, turn, along)
    rows, truth = rows_of(all_contacts(bodies, device)), rigid_truth(bodies)
    assert_nothing_missed(rows, truth)
    # 4 errors of a point on each of two bodies, and 64 units of the extent, instead of the tolerance.
    noise = (8 * (256 + 8 * turn) + 64 * 18) * 2.0**-53 * max(mesh.reach for mesh in bodies.meshes)
    within = max(1e-6 * min(mesh.radius for mesh in bodies.meshes), 1.1 * noise)
    assert_rigid_rows_close(rows, bodies, within + 1e-12 * (reach + 10.0))
    assert len(truth.contacts) > (10 if reach < 1e6 else 0)


@pytest.mark.parametrize("turn", [20.0, pytest.param(40.0, marks=pytest.mark.slow)])
def test_many_turns_about_a_joint(turn: float, device: torch.device) -> None:
    contacts = 0
    for seed in range(1 if turn < 40.0 else 2):
        rng = np.random.default_rng([seed, int(turn)])
        mesh, other = bumpy(rng, 0), bumpy(rng, 0)
        link = recentred(mesh, np.array([3.0, 0.0, 0.0]))
        place = 3.0 * directions(rng, 1)[0] * [1.0, 1.0, 0.1]
        bodies = Bodies(
            [link, other],
            np.stack([[0.0, 0.0, -1.0], place]),
            np.stack([STILL, STILL]),
            np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]),
            np.array([[0.0, 0.0, turn], [0.0, 0.0, 0.0]]),
        )
        rows, truth = rows_of(all_contacts(bodies, device)), rigid_truth(bodies)
        assert_nothing_missed(rows, truth)
        assert_rigid_rows_close(rows, bodies, 1e-6)
        contacts += len(truth.contacts)
    assert contacts > 10


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_all_broad_phases_and_no_broad_phase_agree(path: str, device: torch.device) -> None:
    rng = np.random.default_rng(8)
    count = 150
    meshes = [recentred(bumpy(rng, 0), r * directions(rng, 1)[0]) for r in (0.0, 0.5, 2.0, 30.0)]
    meshes.append(pgccd.Mesh(meshes[0].vertices, meshes[0].faces, "centroid"))
    index = rng.integers(0, len(meshes), count)
    columns = tensors(
        rng.uniform(0.0, 14.0, (count, 3)),
        unit_quaternions(rng, count),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)) * 0.6,
        device=device,
    )
    motion = pgccd.RigidMotion.from_velocity(*columns, dt=1.0, path=path)  # type: ignore[arg-type]
    scene = pgccd.Scene(meshes, torch.tensor(index), device=device)
    every = torch.combinations(torch.arange(count, device=device), 2)
    truth = pgccd.detect(scene, motion, "all", pairs=every)
    assert len(truth) > 100
    for broad_phase in ("sweep", "grid", "lbvh"):
        hits = pgccd.detect(scene, motion, "all", broad_phase=broad_phase)  # type: ignore[call-overload]
        assert_same(hits, truth)
        assert hits.stats.pcs < len(every) // 2
    first = pgccd.detect(scene, motion)
    least: dict[tuple[int, ...], float] = {}
    for pair, toi in zip(truth.pairs.tolist(), truth.toi.tolist(), strict=True):
        least[tuple(pair)] = min(toi, least.get(tuple(pair), 2.0))
    assert {tuple(p): t for p, t in zip(first.pairs.tolist(), first.toi.tolist(), strict=True)} == least


def test_straight_vertex_paths_are_those_of_the_end_poses(device: torch.device) -> None:
    """With path="linear" a rigid body equals the deforming one with its end positions, for any origin."""
    rng = np.random.default_rng(12)
    total = 0
    for reach in (0.0, 2.0, 100.0):
        bodies = _pair(rng, reach, 1.0, along=False)
        hits = all_contacts(bodies, device, "linear")
        poses = [(bodies.position_t0, bodies.orientation_t0)]
        turn = np.array([product(turn_of(w), q) for w, q in zip(bodies.rotation, bodies.orientation_t0, strict=True)])
        poses.append((bodies.position_t1, turn))
        ends = [
            np.concatenate(
                [
                    p + turned(np.tile(q, (len(m.vertices), 1)), m.vertices.numpy())
                    for m, p, q in zip(bodies.meshes, *at, strict=True)
                ]
            )
            for at in poses
        ]
        same = pgccd.detect(bodies.scene(device), pgccd.VertexMotion(*tensors(*ends, device=device)), "all")
        keys = [set(rows_of(h)) for h in (hits, same)]
        assert len(keys[0] ^ keys[1]) <= 1 + len(keys[0]) // 50
        total += len(keys[0])
    assert total > 20


def test_the_normal_of_a_touch_leads_from_body_to_body(device: torch.device) -> None:
    """For any origin: here each lies beyond the other body."""
    shape = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    upper = pgccd.Mesh(shape, faces, [0.0, 0.0, -8.0])
    lower = pgccd.Mesh(-shape, faces, [0.0, 0.0, 8.0])  # their bases coincide
    start, orientation, turn = tensors(
        np.array([[0.0, 0.0, -8.0], [0.0, 0.0, 8.0]]),
        np.stack([STILL, STILL]),
        np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.25]]),
        device=device,
    )
    for path in ("rigid", "linear"):
        motion = pgccd.RigidMotion.from_rotation(start, orientation, start, turn, path)  # type: ignore[arg-type]
        hits = pgccd.detect(pgccd.Scene([upper, lower], device=device), motion, "all")
        assert len(hits) > 3
        resting = hits.normal[hits.normal[:, 2].abs() > 0.9]
        assert len(resting) and (resting[:, 2] < 0.0).all()
