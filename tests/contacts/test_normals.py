"""Normals of surfaces: exact on flat floors, those of features at convex edges, of a face at concave ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from support.resting import KINDS, Kind, box, joined, sheet, sliding
from torch import Tensor

import pgccd
from pgccd.runtime.sizes import Capacity

CUBE = box((0.5, 0.5, 0.5))
FLOORS = {
    "box": box((10, 10, 0.5), (0, 0, -0.5)),
    "sheet": sheet(8, 8.0),
    "sheet, turned over": sheet(8, 8.0, turned_over=True),
}
# Gap at rest, separation.
RESTS = [(0.0, 0.0), (1e-9, 0.0), (1e-4, 2e-4)]


def both(scene: pgccd.Scene, motion: pgccd.RigidMotion | pgccd.VertexMotion, separation: float = 0.0) -> list[Tensor]:
    """Normals of features and of surfaces, of all contacts; all other columns are equal."""
    of_features = pgccd.detect(scene, motion, "all", separation)
    of_surfaces = pgccd.detect(scene, motion, "all", separation, normals="surface")
    for name, column in of_features.columns.items():
        assert name == "normal" or torch.equal(column, of_surfaces.columns[name]), name
    return [of_features.normal.cpu(), of_surfaces.normal.cpu()]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize(("gap", "separation"), RESTS)
def test_a_flat_floor_has_one_normal(
    kind: Kind, floor: str, gap: float, separation: float, device: torch.device
) -> None:
    scene, motion = sliding(kind, [CUBE, FLOORS[floor]], (0, 0, 0.5 + gap), (5.1, 0.3, 0.0), device)
    of_features, of_surfaces = both(scene, motion, separation)
    down = torch.tensor([0.0, 0.0, -1.0]).double()
    if gap == 1e-9 and kind != "rigid":  # straight paths are free to the last bit
        assert len(of_surfaces) == 0
        return
    assert len(of_surfaces) > 10 and (of_surfaces == down).all()
    assert (of_features[:, 2] > -0.99).any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_flat_floor_in_any_direction(kind: Kind) -> None:
    turn = tuple(np.array([0.4, -0.7, 0.3, 0.5]) / math.sqrt(0.99))
    scene, motion = sliding(kind, [CUBE, FLOORS["sheet"]], (0, 0, 0.5 + 1e-4), (5.1, 0.3, 0.0), orientation=turn)
    of_features, of_surfaces = both(scene, motion, 2e-4)
    assert len(of_surfaces) > 10
    assert (of_surfaces - of_surfaces[0]).abs().max() < 1e-13
    assert (of_features - of_surfaces[0]).abs().max() > 0.1


def test_on_the_inside_of_a_closed_mesh(device: torch.device) -> None:
    room = box((8.0, 8.0, 4.0), (0, 0, 4.0))  # its normals by the order of the corners point out of it
    for gap, separation in RESTS:
        scene, motion = sliding("rigid", [CUBE, room], (0, 0, 0.5 + gap), (5.1, 0.3, 0.0), device)
        _, of_surfaces = both(scene, motion, separation)
        assert len(of_surfaces) > 3 and (of_surfaces == torch.tensor([0.0, 0.0, -1.0]).double()).all()


@pytest.mark.parametrize("seed", range(8))
def test_beside_an_edge_in_the_plane_of_its_faces(seed: int) -> None:
    """A rod through a closed floor comes near a diagonal of it: rounding does not tell on which side of the floor."""
    q = torch.nn.functional.normalize(
        torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64), dim=0
    )
    meshes = [box((0.1, 0.1, 1.0)), box((2.0, 2.0, 0.5), (0.0, 0.0, -0.5))]
    scene, motion = sliding("rigid", meshes, (-0.5, 0.53, 0.0), (0.6, -0.1, 0.0), orientation=tuple(q.tolist()))
    of_features, of_surfaces = (
        pgccd.detect(scene, motion, "all", 0.1, normals=normals)  # type: ignore[call-overload]
        for normals in ("features", "surface")
    )
    edge = int((meshes[1].edges == torch.tensor([1, 7])).all(1).nonzero())
    up = 2.0 * torch.stack([q[1] * q[3] + q[0] * q[2], q[2] * q[3] - q[0] * q[1], 0.5 - q[1] ** 2 - q[2] ** 2])
    rows = (of_features.kind == pgccd.Kind.EE) & (of_features.features[:, 1] == edge)
    rows &= ((of_features.normal @ up).abs() < 1e-9) & (of_features.toi > 0.0)
    assert rows.any() and (of_surfaces.normal[rows] + up).abs().max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_convex_edges_keep_theirs(kind: Kind, device: torch.device) -> None:
    """A cube on its edge falls across the edge of another one, and bodies of all shapes on one another."""
    ridge = pgccd.Mesh(CUBE.vertices @ _about(0, math.pi / 4).T, CUBE.faces)
    across = pgccd.Mesh(CUBE.vertices @ (_about(2, 1.1) @ _about(0, math.pi / 4)).T, CUBE.faces)
    scene, motion = sliding(kind, [across, ridge], (0.05, 0.02, 1.5), (0.0, 0.0, -0.2), device)
    hits = pgccd.detect(scene, motion)
    assert hits.kind.tolist() == [pgccd.Kind.EE]
    assert hits == pgccd.detect(scene, motion, normals="surface")


def test_tips_keep_theirs(device: torch.device) -> None:
    """The normal between two tips, which lies inside the cones of both, is that of the vertices."""
    tip = pgccd.Mesh.icosphere(0.5, 0)
    at = tip.vertices[0] / tip.vertices[0].norm()
    aside = torch.linalg.cross(at, torch.tensor([0.3, -0.5, 0.2]).double())
    apart = 1.01 * at + 0.001 * aside
    q = torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64)
    x = torch.stack([-0.0 * apart, apart])
    opposite = pgccd.Mesh(-tip.vertices, tip.faces.flip(1))
    scene = pgccd.Scene([tip, opposite], device=device)
    motion = pgccd.RigidMotion(x.to(device), q.to(device), (0.9 * x).to(device), q.to(device))
    of_features, of_surfaces = (
        pgccd.detect(scene, motion, min_separation=0.005, normals=n) for n in ("features", "surface")
    )
    assert len(of_features) == 1 and 0.01 < float(of_features.toi[0]) < 0.9
    assert float((of_features.normal[0].cpu() - at).norm()) > 0.01
    assert of_surfaces == of_features


def test_first_contacts_of_convex_bodies_have_the_same_normals() -> None:
    random = torch.Generator().manual_seed(3)
    shapes = [CUBE, pgccd.Mesh.icosphere(0.6, 1), box((0.8, 0.3, 0.2))]
    count = 200
    x0 = torch.randn(2 * count, 3, generator=random, dtype=torch.float64) * 0.1
    x0[1::2] += 2.5 * torch.nn.functional.normalize(torch.randn(count, 3, generator=random, dtype=torch.float64))
    q = torch.nn.functional.normalize(torch.randn(2 * count, 4, generator=random, dtype=torch.float64))
    spin = 0.5 * torch.randn(2 * count, 3, generator=random, dtype=torch.float64)
    x1 = 0.1 * torch.randn(2 * count, 3, generator=random, dtype=torch.float64)
    scene = pgccd.Scene(shapes, [0, 1, 2, 0, 1, 2, 2, 1] * (count // 4), world=torch.arange(count).repeat_interleave(2))
    motion = pgccd.RigidMotion.from_rotation(x0, q, x1, spin)
    of_features = pgccd.detect(scene, motion)
    of_surfaces = pgccd.detect(scene, motion, normals="surface")
    assert len(of_features) > 150
    assert (of_features.normal - of_surfaces.normal).abs().max() < 1e-5


def test_a_crease_has_the_normals_of_its_faces(device: torch.device) -> None:
    """A box near the edge between a floor and a wall."""
    points = [[-4.0, -4, 0], [-4, 4, 0], [2, 4, 0], [2, -4, 0], [2, 4, 4], [2, -4, 4]]
    crease = pgccd.Mesh(points, [[0, 3, 2], [0, 2, 1], [3, 5, 4], [3, 4, 2]])
    scene, motion = sliding("rigid", [CUBE, crease], (0.0, 0.1, 0.7), (1.4, 0.0, -0.1), device)
    of_features, of_surfaces = both(scene, motion, 0.25)
    faces = [torch.tensor([0.0, 0.0, -1.0]).double(), torch.tensor([1.0, 0.0, 0.0]).double()]
    is_face = [(of_surfaces == face).all(1) for face in faces]
    assert is_face[0].any() and is_face[1].any() and (is_face[0] | is_face[1]).all()
    assert (of_features[:, 0] * of_features[:, 2]).abs().max() > 0.1


def test_the_side_where_features_touch_exactly(device: torch.device) -> None:
    """The centre of floor and wall together is on the other side of the box, but the wall is in front of it."""
    room = joined(FLOORS["box"], box((0.5, 10, 3), (5, 0, 3)))
    scene, motion = sliding("rigid", [CUBE, room], (0, 0, 0.5 + 1e-5), (8.0, 0, 0), device)
    of_features = pgccd.detect(scene, motion, nonzero_toi=True)
    of_surfaces = pgccd.detect(scene, motion, nonzero_toi=True, normals="surface")
    assert of_features.normal.tolist() == [[-1.0, 0.0, 0.0]]
    assert of_surfaces.normal.tolist() == [[1.0, 0.0, 0.0]]


def test_reports_and_trajectories(device: torch.device) -> None:
    scene, motion = sliding("rigid", [CUBE, FLOORS["box"]], (0, 0, 0.5), (5.1, 0.3, 0), device)
    assert isinstance(motion, pgccd.RigidMotion)
    x = torch.stack([motion.position_t0, motion.position_t1])
    trajectory = pgccd.Trajectory(x, motion.orientation_t0.expand(2, -1, -1).contiguous())
    for path in (motion, trajectory):
        for report in ("first", "earliest", "all"):
            hits = pgccd.detect(scene, path, report, normals="surface")  # type: ignore[call-overload]
            assert (hits.normal.cpu() == torch.tensor([0.0, 0.0, -1.0]).double()).all() and len(hits)


@pytest.mark.cuda
@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_same_bits_on_a_gpu(path: str) -> None:
    random = torch.Generator().manual_seed(5)
    count = 100
    x = 1.5 * torch.rand(count, 3, generator=random, dtype=torch.float64)
    q = torch.nn.functional.normalize(torch.randn(count, 4, generator=random, dtype=torch.float64))
    v, w = torch.randn(2, count, 3, generator=random, dtype=torch.float64)
    columns = []
    for device in ("cpu", "cuda"):
        scene = pgccd.Scene([pgccd.Mesh.icosphere(0.2, 2), box((0.2, 0.2, 0.1))], [0, 1] * (count // 2), device=device)
        motion = pgccd.RigidMotion.from_velocity(*(t.to(device) for t in (x, q, v, w)), dt=0.3, path=path)  # type: ignore[arg-type]
        columns.append(pgccd.detect(scene, motion, "all", 1e-2, normals="surface").to("cpu"))
    assert len(columns[0]) > 100 and columns[0] == columns[1]


def test_refusals() -> None:
    scene, motion = sliding("rigid", [CUBE, FLOORS["box"]], (0, 0, 0.5), (5.1, 0.3, 0))
    assert isinstance(motion, pgccd.RigidMotion)
    with pytest.raises(ValueError, match=r"normals: expected one of \['features', 'surface'\], got 'smooth'"):
        pgccd.detect(scene, motion, normals="smooth")  # type: ignore[call-overload]
    with pytest.raises(ValueError, match=r"normals: contacts in a given capacity have those of the .features."):
        pgccd.detect(scene, motion, normals="surface", capacity=Capacity.of(8, 100, 100))
    wanting = pgccd.RigidMotion.from_rotation(
        motion.position_t0.clone().requires_grad_(), motion.orientation_t0, motion.position_t1, motion.rotation
    )
    with pytest.raises(ValueError, match=r"normals: 'surface' have no gradients"):
        pgccd.detect(scene, wanting, normals="surface")


def _about(axis: int, angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.eye(3, dtype=torch.float64)
    one, other = [k for k in range(3) if k != axis]
    turn[one, one] = turn[other, other] = c
    turn[one, other], turn[other, one] = -s, s
    return turn
