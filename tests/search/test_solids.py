"""Bodies inside of solids: contacts of kind INSIDE against exact winding numbers, in every report and form."""

from __future__ import annotations

import copy
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from oracle.winding import winding_numbers
from support import solids
from support.shapes import tensors, unit_quaternions
from support.solids import Surface

import pgccd
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.solids import opening, vertices_of_components

INSIDE = pgccd.Kind.INSIDE
UPRIGHT = [1.0, 0.0, 0.0, 0.0]
SPECK = (
    0.125 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
# Quaternions whose rotations of points with few digits have no rounding errors.
EXACT_TURNS = [UPRIGHT, [0, 1, 0, 0], [0, 0, 0, 1], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, -0.5]]
# About the direction of the rays, which then pass vertices to within rounding.
TURNS = np.array([*EXACT_TURNS, *([np.cos(a), np.sin(a), 0, 0] for a in (0.3, 1.1, 2.6))])


def meshes_of(*surfaces: Surface, solid: Any = True) -> list[pgccd.Mesh]:
    return [pgccd.Mesh(*each, solid=solid) for each in surfaces]


def at_rest(
    meshes: list[pgccd.Mesh], deforms: bool, device: torch.device | str = "cpu", places: Any = None, **columns: Any
) -> Any:
    """A scene of unturned bodies at places (N, 3), and their motion."""
    scene = pgccd.Scene(meshes, device=device, **columns)
    index = scene.mesh_index.tolist()
    x = np.zeros((len(index), 3)) if places is None else np.asarray(places, float)
    if deforms:
        parts = [meshes[k].vertices.numpy() + place for k, place in zip(index, x, strict=True)]
        vertices = tensors(np.concatenate(parts), device=device)[0]
        return scene, pgccd.VertexMotion(vertices, vertices)
    return scene, pgccd.RigidMotion.at_rest(*tensors(x, np.tile(UPRIGHT, (len(x), 1)), device=device))


def rows(hits: pgccd.Contacts) -> list[tuple[list[int], int, list[int]]]:
    return list(zip(hits.pairs.tolist(), hits.kind.tolist(), hits.features.tolist(), strict=True))


@pytest.fixture(params=[False, True], ids=["rigid", "deforming"])
def deforms(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.mark.parametrize("report", ["first", "all", "earliest"])
def test_a_speck_in_a_box(report: Any, deforms: bool, device: torch.device) -> None:
    meshes = meshes_of(solids.box([-2] * 3, [2] * 3), SPECK)
    for order, features in ((meshes, [-1, 0]), (meshes[::-1], [0, -1])):
        scene, motion = at_rest(order, deforms, device, [[0.5, 0.25, 1.0]] * 2)
        hits = pgccd.detect(scene, motion, report)
        assert rows(hits) == [([0, 1], INSIDE, features)]
        assert hits.toi.tolist() == [0.0] and hits.status.tolist() == [pgccd.Status.TOUCH]
        assert hits.point.tolist() == [[0.5, 0.25, 1.0]] and hits.normal.isnan().all()
        assert pgccd.approach_rates(scene, motion, hits).isnan().all()
        if report != "earliest":
            assert rows(pgccd.approaching(scene, motion, hits)) == rows(hits)
        assert pgccd.collide(scene, motion).pairs.tolist() == [[0, 1]]
        padded = pgccd.detect(scene, motion, report, capacity=pgccd.Capacity.of(2))
        assert rows(padded.trim()) == rows(hits)
        assert len(pgccd.detect(scene, motion, report, initial="assume_free")) == 0


def test_only_what_is_marked_and_asked_for(deforms: bool) -> None:
    box, speck = solids.box([-2] * 3, [2] * 3), SPECK
    surface, solid = meshes_of(box, solid=False)[0], meshes_of(box)[0]
    inner = pgccd.Mesh(*speck)
    assert not len(pgccd.detect(*at_rest([surface, inner.as_solid()], deforms)))
    assert len(pgccd.detect(*at_rest([solid, inner], deforms))) == 1
    for columns in (
        {"exclude": [[0, 1]]},
        {"world": [0, 1]},
        {"static": [True, True]},
        {"group": [1, 2], "mask": [1, 2]},
    ):
        assert not len(pgccd.detect(*at_rest([solid, inner], deforms, **columns)))
    # Of two solids only the larger one contains the other.
    assert rows(pgccd.detect(*at_rest([solid, inner.as_solid()], deforms))) == [([0, 1], INSIDE, [-1, 0])]


def test_pieces_shells_and_cavities(deforms: bool) -> None:
    """A piece inside of a solid suffices; shells that overlap count once; a cavity is outside."""
    balls = [solids.ball(1, radius) for radius in (3.0, 2.0, 1.0)]
    hollow = solids.joined(balls[0], solids.inverted(balls[1]))
    twice = solids.joined(balls[0], solids.moved(balls[0], [0.25, 0.125, 0.0]))
    far = solids.joined(solids.moved(SPECK, [9.0, 0, 0]), SPECK)
    assert not len(pgccd.detect(*at_rest(meshes_of(hollow, balls[2]), deforms)))
    assert len(pgccd.detect(*at_rest(meshes_of(twice, balls[2]), deforms))) == 1
    assert rows(pgccd.detect(*at_rest(meshes_of(hollow, far), deforms))) == []
    assert rows(pgccd.detect(*at_rest(meshes_of(twice, far), deforms))) == [([0, 1], INSIDE, [-1, 4])]
    # A ball in the shell of the hollow one.
    shell = solids.moved(solids.ball(1, 0.25), [2.4, 0.0, 0.0])
    assert len(pgccd.detect(*at_rest(meshes_of(hollow, shell), deforms))) == 1
    several = solids.joined(SPECK, solids.moved(SPECK, [0.5, 0, 0]))
    hits = pgccd.detect(*at_rest(meshes_of(balls[0], several), deforms), "all")
    assert rows(hits) == [([0, 1], INSIDE, [-1, 0]), ([0, 1], INSIDE, [-1, 4])]


def test_surfaces_that_touch_come_first(deforms: bool) -> None:
    """A cube that rests in another one, against its wall, and one that reaches through it."""
    outer, inner = meshes_of(solids.box([-2] * 3, [2] * 3), solids.box([-1, -0.25, -0.25], [1, 0.25, 0.25]))
    for x, kinds in ((1.0, {0, 1, 2}), (1.5, {3, 4})):
        hits = pgccd.detect(*at_rest([outer, inner], deforms, places=[[0, 0, 0], [x, 0.125, 0.0625]]), "all")
        assert hits.toi.tolist() == [0.0] * len(hits)
        assert set(hits.kind.tolist()) >= {INSIDE} and set(hits.kind.tolist()) & kinds
        first = pgccd.detect(*at_rest([outer, inner], deforms, places=[[0, 0, 0], [x, 0.125, 0.0625]]))
        assert first.kind.tolist() == [int(hits.kind.min())]


@pytest.mark.parametrize("shear", [np.eye(3), [[1, 2, 0], [0, 1, 0], [1, -1, 1]]], ids=["straight", "sheared"])
@pytest.mark.parametrize("turn", range(len(TURNS)))
def test_rays_through_vertices_and_along_edges_and_faces(shear: Any, turn: int, deforms: bool) -> None:
    """Cubes on a lattice: from their midpoints and from empty lattice points rays meet vertices, edges and squares."""
    rng = np.random.default_rng([2, turn])
    made = 0
    while made < 4:
        filled = rng.random((3, 3, 3)) < rng.uniform(0.2, 0.8)
        filled[0, 0, 0] = True
        vertices, faces = solids.voxels(filled)
        if opening(faces) is not None:
            continue
        made += 1
        cube = np.argwhere(np.ones((5, 5, 5))) - 1
        truth = np.pad(filled, 1)[tuple((cube + 1).T)]
        around = np.stack([np.pad(filled, 2)[tuple((cube + 1 + s).T)] for s in np.argwhere(np.ones((2, 2, 2)))])
        alike = (around == around[0]).all(axis=0)  # off the surface
        points = np.concatenate([cube + 0.5, cube[alike]])
        truth = np.concatenate([truth, around[0][alike]])
        # Small enough to be off the surface, so that one corner tells.
        speck = pgccd.Mesh(0.125 * SPECK[0] @ np.asarray(shear).T, SPECK[1])
        meshes = [pgccd.Mesh(vertices @ np.asarray(shear).T, faces, solid=True), speck]
        places = points @ np.asarray(shear).T
        turned = _matrix(TURNS[turn])
        count = len(points)
        scene = pgccd.Scene(meshes, [0] + [1] * count, static=[False] + [True] * count)
        if deforms:
            parts = [meshes[0].vertices.numpy(), *(speck.vertices.numpy() + place for place in places)]
            x = tensors(np.concatenate(parts) @ turned.T)[0]
            motion: Any = pgccd.VertexMotion(x, x)
        else:
            position = np.concatenate([np.zeros((1, 3)), places @ turned.T])
            motion = pgccd.RigidMotion.at_rest(*tensors(position, np.tile(TURNS[turn], (count + 1, 1))))
        hits = pgccd.detect(scene, motion, "all", tolerance=0.0)
        found = np.zeros(count, dtype=bool)
        found[hits.pairs[hits.kind == INSIDE, 1].numpy() - 1] = True
        touching = np.zeros(count, dtype=bool)
        touching[hits.pairs[hits.kind != INSIDE, 1].numpy() - 1] = True
        assert not touching.any()
        assert np.array_equal(found, truth)


def _matrix(q: np.ndarray) -> Any:
    """The rotation of a quaternion, in its numbers: floats or fractions."""
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    r = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.array(r) / n


def _exactly(values: np.ndarray) -> Any:
    return np.vectorize(Fraction, otypes=[object])(values)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (40.0, -7.0, 3.0)], ids=["centred", "far origin"])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_against_exact_winding_numbers(scale: float, origin: Any) -> None:
    """Turned solids and small bodies in several pieces, in rationals."""
    rng = np.random.default_rng([17, int(np.log10(scale)) + 9])
    shapes = [solids.torus(around=12, across=6), solids.joined(solids.ball(1), solids.inverted(solids.ball(1, 0.5)))]
    shapes.append(solids.joined(solids.ball(1), solids.moved(solids.ball(1), [0.7, 0.2, 0.1])))
    pieces = solids.joined((0.2 * SPECK[0], SPECK[1]), solids.moved((0.2 * SPECK[0], SPECK[1]), [0.3, 0.1, 0]))
    surfaces = [(scale * vertices, faces) for vertices, faces in [*shapes, pieces]]
    meshes = [pgccd.Mesh(*each, origin=scale * np.asarray(origin), solid=True) for each in surfaces]
    count = 90
    scene = pgccd.Scene(meshes, [0, 1, 2] + [3] * count, static=[False] * 3 + [True] * count, world=[0] * (3 + count))
    orientation = unit_quaternions(rng, 3 + count)
    place = scale * rng.uniform(-2.0, 2.0, (3 + count, 3)) * [1, 1, 0.5]
    place[:3] = scale * np.array([[0.3, 0.1, 0.0], [4.0, 0, 0], [-4.0, 0, 0]])
    place[3:] += place[rng.integers(0, 3, count)]
    position = place - np.stack([_matrix(q) @ mesh_centre for q, mesh_centre in _centres(scene, orientation)])
    motion = pgccd.RigidMotion.at_rest(*tensors(position, orientation))
    hits = pgccd.detect(scene, motion, "all")
    touching = set(map(tuple, hits.pairs[hits.kind != INSIDE].tolist()))
    inside = hits[hits.kind == INSIDE]
    found = set(map(tuple, torch.cat([inside.pairs, inside.features[:, 1:].long()], 1).tolist()))
    seen = 0
    for solid in range(3):
        corners = scene.meshes.meshes[solid].vertices.numpy()[surfaces[solid][1]]
        turn, at = _matrix(_exactly(orientation[solid])), _exactly(position[solid])
        first = vertices_of_components(surfaces[3][1])
        for body in range(3, 3 + count):
            if (solid, body) in touching:
                continue
            vertices = _exactly(scene.meshes.meshes[3].vertices.numpy()[first])
            own = vertices @ _matrix(_exactly(orientation[body])).T + _exactly(position[body])
            expected = winding_numbers((own - at) @ turn, corners) != 0
            for vertex, is_in in zip(first.tolist(), expected.tolist(), strict=True):
                assert ((solid, body, vertex) in found) == is_in
                seen += is_in
    assert seen > 10 and len(touching) > 1


def _centres(scene: pgccd.Scene, orientation: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """By how much bodies are away from their origins, to put them where they are wanted."""
    centres = [mesh.centre_offset.numpy() for mesh in scene.meshes.meshes]
    return [(q, centres[k]) for q, k in zip(orientation, scene.mesh_index.tolist(), strict=True)]


def test_nearer_to_a_face_than_doubles_tell() -> None:
    """A corner 2^-70 from the face of a turned solid, on either side: the sign is that of exact numbers."""
    turn = np.array([0.6, 0.0, 0.0, 0.8])
    cube = pgccd.Mesh(*solids.box([-1, -1, -1], [1, 1, 1]), solid=True)
    for side, expected in ((-1.0, True), (1.0, False)):
        corner = np.array([1.0, 0.25, 0.125]) + [side * 2.0**-30, 0, 0]
        spike = np.array([[0, 0, 0], [-side * -0.5, 0.1, 0], [side * 0.5, -0.1, 0.1], [side * 0.5, 0, -0.1]])
        if expected:
            spike[:, 0] = -np.abs(spike[:, 0])
        mesh = pgccd.Mesh(spike, SPECK[1])
        q = np.array([turn, turn])
        position = np.array([[0, 0, 0], _matrix(turn) @ corner])
        scene = pgccd.Scene([cube, mesh])
        hits = pgccd.detect(scene, pgccd.RigidMotion.at_rest(*tensors(position, q)), "all", tolerance=0.0)
        assert bool((hits.kind == INSIDE).any()) == expected


def test_what_follows_from_it(device: torch.device) -> None:
    """Distances, resolution, audits, `enclosed` and gradients of a body that starts inside of a solid and leaves it."""
    meshes = meshes_of(solids.box([-2] * 3, [2] * 3), SPECK)
    scene = pgccd.Scene(meshes, device=device)
    x = tensors([[0.0, 0, 0], [0, 0, 0]], device=device)[0].requires_grad_()
    q = tensors([UPRIGHT] * 2, device=device)[0]
    motion = pgccd.RigidMotion(x, q, x + tensors([[0.0, 0, 0], [5.0, 0, 0]], device=device)[0], q)
    hits = pgccd.detect(scene, motion, "all")
    assert INSIDE in hits.kind.tolist()
    assert not hits.differentiable[hits.kind == INSIDE].any()
    (hits.toi.sum() + hits.point.sum() + pgccd.approach_rates(scene, motion, hits).nansum()).backward()
    assert x.grad is not None and x.grad.isfinite().all()
    start = x.detach()
    motion = pgccd.RigidMotion(start, q, start + tensors([[0.0, 0, 0], [5.0, 0, 0]], device=device)[0], q)
    resolved = pgccd.resolve(scene, motion)
    assert resolved.fraction.tolist() == [0.0, 0.0] and resolved.touching_at_start.tolist() == [[0, 1]]
    near = pgccd.distance(scene, motion, cutoff=0.5)
    assert near.pairs.tolist() == [[0, 1]] and near.inside.tolist() == [True] and near.converged.all()
    assert (near.lower.tolist(), near.upper.tolist(), near.time.tolist()) == ([0.0], [0.0], [0.0])
    still = pgccd.RigidMotion.at_rest(motion.position_t0, motion.orientation_t0)
    assert pgccd.distance(scene, still, cutoff=0.5).inside.tolist() == [True]  # though surfaces are further apart
    surface = pgccd.Scene([mesh.as_solid(False) for mesh in meshes], device=device)
    assert len(pgccd.distance(surface, still, cutoff=0.5)) == 0
    pairs = torch.tensor([[0, 1], [0, 1]], device=device)
    apart = pgccd.distance(surface, still, pairs=pairs)
    assert apart.inside.tolist() == [False, False] and float(apart.lower.min()) > 1.0
    assert pgccd.distance(scene, still, pairs=pairs).points.tolist() == [[[0.0] * 3] * 2] * 2
    for each in (scene, surface):
        assert pgccd.enclosed(each, still).tolist() == [[1, 0]]
        frames = [(motion.position_t0, q), (motion.position_t1, q)]
        found = pgccd.audit(each, frames)
        assert (len(found.passages), len(found.touching), len(found.enclosed)) == (0, 0, 1)
    path = pgccd.Trajectory(torch.stack([motion.position_t0, motion.position_t1]), torch.stack([q, q]))
    assert pgccd.detect(scene, path).kind.tolist() == [INSIDE]
    assert pgccd.distance(scene, path, cutoff=1.0).inside.tolist() == [True]


def test_marks_of_meshes() -> None:
    box, sheet = pgccd.Mesh.box([1.0, 2.0, 3.0]), ([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert not box.solid and box.as_solid().solid and not box.as_solid().as_solid(False).solid
    assert pgccd.Mesh.box([1.0, 1, 1], solid=True).solid and pgccd.Mesh.icosphere(1.0, solid="auto").solid
    assert pgccd.Mesh.cylinder(1.0, 1.0, solid="auto").solid
    inwards = pgccd.Mesh(box.vertices, box.faces.flip(1), solid="auto")
    assert not inwards.solid and inwards.as_solid().solid
    assert not pgccd.Mesh(*sheet, solid="auto").solid
    both_sides = pgccd.Mesh(sheet[0], [[0, 1, 2], [0, 2, 1]], solid="auto")
    assert not both_sides.solid  # closed, but without a volume
    with pytest.raises(ValueError, match="solid: .*no triangle passes from vertex 1 to vertex 0"):
        pgccd.Mesh(*sheet, solid=True)
    for wrong in ("yes", 1, None):
        with pytest.raises(TypeError, match='solid: expected True, False or "auto"'):
            pgccd.Mesh(box.vertices, box.faces, solid=wrong)  # type: ignore[arg-type]
    again = pgccd.Mesh.from_state_dict(box.as_solid().state_dict())
    assert again.solid and "solid" in repr(again)
    old = box.state_dict()
    del old["solid"]
    assert not pgccd.Mesh.from_state_dict(old).solid
    assert meshes_digest([box]) != meshes_digest([box.as_solid()])
    assert meshes_digest([box]) == meshes_digest([box.as_solid(False)])
    assert copy.deepcopy(box.as_solid()).solid
    assert pgccd.Scene.from_state_dict(pgccd.Scene([box.as_solid()]).state_dict()).meshes.meshes[0].solid


def test_candidates_of_what_is_no_solid_are_refused() -> None:
    solid, speck = meshes_of(solids.box([-2] * 3, [2] * 3), SPECK)
    pairs = torch.tensor([[0, 1]])
    for meshes, sound in (([solid, speck], True), ([solid.as_solid(False), speck], False)):
        scene, motion = at_rest(meshes, False)
        bodies = pgccd.MovingBodies.of(scene, motion)
        candidates = torch.tensor([[0, 6, 0, 2]], dtype=torch.int32)
        if sound:
            found = pgccd.narrow.find_contacts(bodies, pairs, candidates, "all")
            assert found[1].tolist() == [INSIDE] and found[2].tolist() == [[-1, 2]]
        else:
            with pytest.raises(ValueError, match="candidates"):
                pgccd.narrow.find_contacts(bodies, pairs, candidates, "all")
