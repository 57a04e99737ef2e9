"""Motions: rotation vectors, arcs and their trigonometry against mpmath; steps of several turns."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import strategies
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import rigid
from support.shapes import Bodies, approaching, bumpy, directions, tensors, unit_quaternions
from support.truth import assert_rigid_rows_close, rows_of

import pgccd
from pgccd import ops

U = 2.0**-53
ROOT_HALF = 0.5**0.5


def rotations(q0: np.ndarray, q1: np.ndarray, device: torch.device | str = "cpu") -> np.ndarray:
    """Rotation vectors (n, 3) computed by the constructor."""
    zero = np.zeros((len(q0), 3))
    return pgccd.RigidMotion(*tensors(zero, q0, zero, q1, device=device)).rotation.cpu().numpy()


def exact(q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Rotation vectors computed by the oracle, to a few ulps."""
    bounds = rigid.rotation_between(q0, q1)
    return 0.5 * (bounds.lo + bounds.hi)


def test_rotation_between_is_accurate(device: torch.device) -> None:
    rng = np.random.default_rng(0)
    q0 = unit_quaternions(rng, 400)
    angle = np.concatenate([10.0 ** rng.uniform(-12, 0, 200), rng.uniform(0, np.pi - 1e-3, 200)])[:, None]
    turn = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * directions(rng, 400)], axis=1)
    q1 = np.array([strategies.motions.product(t, q) for t, q in zip(turn, q0, strict=True)])
    q1 *= rng.choice([-1.0, 1.0], (400, 1))  # the same orientations
    found = rotations(q0, q1, device)
    # Absolute error of a few ulps, as of the quaternions, whose entries are of order one.
    assert np.abs(found - exact(q0, q1)).max() <= 16 * U
    assert (np.linalg.norm(found, axis=1) <= np.pi * (1 + 4 * U)).all()


def test_whole_range_of_the_arctangent(device: torch.device) -> None:
    # About one axis the error of the angle is that of the library's own arctangent.
    half = np.concatenate([np.linspace(0, np.pi / 2, 500, endpoint=False), 10.0 ** np.linspace(-300, 0, 200)])
    q1 = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    q0 = np.tile([1.0, 0, 0, 0], (len(half), 1))
    found = rotations(q0, q1, device)
    truth = [2 * mpmath.atan2(s, c) for c, s in q1[:, [0, 3]].tolist()]
    assert (found[:, :2] == 0).all()
    error = [abs(mpmath.mpf(a) - b) for a, b in zip(found[:, 2].tolist(), truth, strict=True)]
    assert max(error) <= 8 * U
    relative = [e / b for e, b in zip(error, truth, strict=True) if b > mpmath.mpf("1e-150")]
    assert max(relative) <= 16 * U, "small angles keep their digits"


def test_half_turns() -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    q1 = np.concatenate([np.zeros((6, 1)), axes], axis=1)
    still = np.tile([1.0, 0, 0, 0], (6, 1))
    # About the vector part of q1 conj(q0), including its sign.
    assert np.abs(rotations(still, q1) - np.pi * axes).max() <= 4 * U * np.pi
    assert np.abs(rotations(q1, still) + np.pi * axes).max() <= 4 * U * np.pi
    diagonal = np.array([[0.0, ROOT_HALF, ROOT_HALF, 0.0]])
    assert np.abs(rotations(still[:1], diagonal) - np.pi * diagonal[:, 1:]).max() <= 8 * U


def test_no_turn_and_lengths() -> None:
    q = unit_quaternions(np.random.default_rng(1), 20)
    assert np.abs(rotations(q, q)).max() <= 4 * U
    assert np.abs(rotations(q, -q)).max() <= 4 * U
    q1 = unit_quaternions(np.random.default_rng(2), 20)
    # A nearly unit quaternion represents the orientation of the exact unit one.
    assert np.abs(rotations(q * (1 + 5e-4), q1 * (1 - 5e-4)) - rotations(q, q1)).max() <= 16 * U
    single = rotations(q.astype(np.float32), q1.astype(np.float32))
    assert np.abs(single - exact(q.astype(np.float32).astype(float), q1.astype(np.float32).astype(float))).max() < 1e-14


@given(strategies.unit_quaternions(), strategies.unit_quaternions())
@settings(max_examples=200)
def test_any_pair_of_orientations(q0: np.ndarray, q1: np.ndarray) -> None:
    found = rotations(q0[None], q1[None])[0]
    truth = exact(q0, q1)
    # At half a turn, to rounding, both directions are equally short.
    other = truth - 2 * np.pi * truth / max(float(np.linalg.norm(truth)), 1e-300)
    near_half = np.linalg.norm(truth) > np.pi - 64 * U
    assert min(np.abs(found - truth).max(), np.abs(found - other).max() if near_half else np.inf) <= 16 * U


def test_sine_and_cosine_over_many_turns() -> None:
    # The simulator's operator turns a body by fraction * angular velocity: sine and cosine of half that angle.
    rng = np.random.default_rng(3)
    angle = np.concatenate(
        [rng.uniform(-1, 1, 300) * 10.0 ** rng.uniform(-8, 6, 300), np.arange(1, 200) * np.pi / 2, [0.0, 1e6, -1e6]]
    )
    count = len(angle)
    state = (torch.zeros(count, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.zeros(count, 3))
    spin = torch.zeros(count, 3, dtype=torch.float64)
    spin[:, 2] = 2 * torch.from_numpy(angle)
    rows = [torch.arange(count), *(x.double() for x in state), spin]
    rows += [torch.zeros(count, dtype=torch.int64)] * 2
    turned = ops.simulate_respond(rows, torch.ones(count, dtype=torch.float64))[1].numpy()
    with mpmath.workdps(40):
        error = [
            max(abs(mpmath.mpf(q[0]) - mpmath.cos(a)), abs(mpmath.mpf(q[3]) - mpmath.sin(mpmath.mpf(a))))
            for q, a in zip(turned.tolist(), angle.tolist(), strict=True)
        ]
    assert max(error) <= 5 * U  # 2 ulps of sine and cosine, and the normalisation


@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.3, 3.0, 12.0, 60.0])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_positions_along_arcs_through_contacts(device: torch.device, turn: float, offset: float) -> None:
    for seed in range(3):
        bodies = approaching(np.random.default_rng([seed, int(turn)]), turn=turn, offset=offset, closeness=0.7)
        # Tight enough for the reported positions to test the arcs themselves.
        hits = pgccd.detect(bodies.scene(device), bodies.motion(device=device), report="all", tolerance=1e-12)
        rows = rows_of(hits)
        assert_rigid_rows_close(
            rows, bodies, 1e-12 + 1e-13 * (1 + turn) + 1e-15 * offset
        )  # the oracle's enclosures widen with the angle
        assert (hits.status == pgccd.Status.UNRESOLVED).float().mean() < 0.05 or not rows
        if turn < 60:
            assert len(rows) > 0


@pytest.mark.parametrize("turn", [4.0, 60.0, 500.0])
def test_points_of_contact_against_mpmath(turn: float) -> None:
    bodies = approaching(np.random.default_rng(11), turn=turn, closeness=0.7)
    hits = pgccd.detect(bodies.scene(), bodies.motion(), report="all", tolerance=1e-12)
    is_vertex = (hits.kind == pgccd.Kind.VF_AB) & (hits.status == pgccd.Status.TOUCH)
    assert int(is_vertex.sum()) > 5
    for row in is_vertex.nonzero().flatten()[:20].tolist():
        vertex = bodies.meshes[0].vertices[hits.features[row, 0]].numpy()
        pose = (c[0] for c in (bodies.position_t0, bodies.orientation_t0, bodies.position_t1, bodies.rotation))
        truth = rigid.position(vertex, *pose, float(hits.toi[row]))
        error = max(abs(mpmath.mpf(a) - b) for a, b in zip(hits.point[row].tolist(), truth, strict=True))
        assert error < 2e-12


def test_more_than_half_a_turn_sweeps_all_the_way_round() -> None:
    # A long bar turning by 270 degrees hits a small body at 200 degrees; the shorter way would never reach it.
    bar = pgccd.Mesh(
        [[0, 0, 0.0], [3, 0.05, 0], [3, -0.05, 0], [3, 0, 0.05]],
        [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
        origin="centroid",
    )
    small = bumpy(np.random.default_rng(5), 0, size=0.1)
    there = np.radians(200)
    offset = bar.centre.numpy()
    bodies = Bodies(
        [bar, small],
        np.stack([offset, offset + 2.0 * np.array([np.cos(there), np.sin(there), 0.0])]),
        np.tile([1.0, 0, 0, 0], (2, 1)),
        np.zeros((2, 3)),
        np.array([[0, 0, np.radians(270)], [0, 0, 0]]),
    )
    hits = pgccd.detect(bodies.scene(), bodies.motion())
    # The bar's tip is 0.75 from its centre, its other end 2.25: the long end sweeps over the small body.
    assert len(hits) == 1 and 0 < hits.toi[0] < 1
    turn = bodies.rotation[0, 2] / 2
    q1 = np.array([[np.cos(turn), 0, 0, np.sin(turn)], [1.0, 0, 0, 0]])
    poses = tensors(bodies.position_t0, bodies.orientation_t0, bodies.position_t1, q1)
    shorter = pgccd.RigidMotion(*poses)
    assert shorter.rotation[0, 2] == pytest.approx(-np.pi / 2)
    assert not torch.equal(pgccd.detect(bodies.scene(), shorter).toi, hits.toi)


@given(strategies.pose_motions(scale=1.0), st.sampled_from([0.5, 1.0, 1e-3]))
@settings(max_examples=50)
def test_from_velocity(step: strategies.PoseMotion, dt: float) -> None:
    velocity = (step.end.position - step.start.position) / dt
    columns = tensors(*(x[None] for x in (step.start.position, step.start.orientation, velocity, step.rotation / dt)))
    motion = pgccd.RigidMotion.from_velocity(*columns, dt)
    assert np.allclose(motion.position_t1.numpy()[0], step.end.position, rtol=1e-12, atol=1e-12)
    assert np.allclose(motion.rotation.numpy()[0], step.rotation, rtol=1e-15, atol=1e-300)
    assert motion.body_count == 1 and motion.path == "rigid"


def test_at_rest(device: torch.device) -> None:
    rng = np.random.default_rng(12)
    x, q = tensors(1e6 * rng.normal(size=(500, 3)), unit_quaternions(rng, 500) * (1 + 5e-4), device=device)
    motion = pgccd.RigidMotion.at_rest(x.float(), q)
    assert motion.body_count == 500 and motion.path == "rigid" and motion.device == x.device
    assert torch.equal(motion.position_t0, x.float().double()) and torch.equal(motion.position_t1, motion.position_t0)
    assert torch.equal(motion.orientation_t0, q) and not bool(motion.rotation.any())
    ends = [motion.at(t) for t in (0.0, 1.0)]
    assert all(torch.equal(start, end) for start, end in zip(*ends, strict=True))
