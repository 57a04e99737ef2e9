"""Normals of surfaces against samples of all those that the faces around a point admit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from support.resting import sheet
from support.surfaces import contacts_at, surface_normals
from torch import Tensor

import pgccd

SHAPES = ("flat", "convex", "concave", "any", "rim", "fin")
# A needle whose tip is its vertex 0, at the origin; it extends along z.
NEEDLE = pgccd.Mesh(
    [[0.0, 0, 0], [0.02, 0, 1], [-0.01, 0.02, 1], [-0.01, -0.02, 1]], [[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]]
)


@dataclass
class Case:
    """A needle that stands on a point of faces around a vertex at the origin, all seen from z > 0.

    Attributes:
        mesh: its vertex 0 is the one at the origin.
        face, coordinates: the point of contact, in the face, on an edge, or at the vertex.
        around: the faces at the point, (m, 3, 3), relative to it.
        edges: of each edge at the point, the direction and the faces' third corners, relative to the point.
        normal: of the features, from the surface to the needle.
        offset: from the surface to the needle.
    """

    mesh: pgccd.Mesh
    face: int
    coordinates: tuple[float, float]
    around: Tensor
    edges: list[tuple[Tensor, Tensor]]
    normal: Tensor
    offset: Tensor


def faces_around_a_vertex(shape: str, random: torch.Generator) -> tuple[Tensor, list[list[int]]]:
    """Vertices and faces."""
    count = int(torch.randint(4, 8, (), generator=random))
    angles = 2.0 * math.pi / count * (torch.arange(count) + 0.6 * torch.rand(count, generator=random).double())
    heights = torch.rand(count, generator=random).double()
    heights = {"flat": 0.0 * heights, "convex": 0.0 * heights - 0.5, "concave": 0.0 * heights + 0.5}.get(
        shape, heights - 0.6
    )
    ring = torch.stack([torch.cos(angles), torch.sin(angles), heights], 1)
    # Corners of a convex cone stay on it at any distance from the tip.
    points = torch.cat([torch.zeros(1, 3).double(), ring * (0.5 + torch.rand(count, 1, generator=random).double())])
    faces = [[0, 1 + k, 1 + (k + 1) % count] for k in range(count)]
    if shape == "rim":
        points, faces = points[:4], faces[:2]
    if shape == "fin":  # below the others, so that none can stand on it
        middle = 0.5 * points[1] + torch.tensor([0.0, 0.0, -1.0]).double()
        points = torch.cat([points, middle[None]])
        faces.append([0, 1, len(points) - 1])
    return points, faces


def case(shape: str, support: str, random: torch.Generator) -> Case:
    points, faces = faces_around_a_vertex(shape, random)
    mesh = pgccd.Mesh(points, faces)
    face = 0 if shape == "fin" else int(torch.randint(2, (), generator=random)) * (len(faces) - 1)
    coordinates = {"vertex": (0.0, 0.0), "edge": (0.375, 0.0), "face": (0.375, 0.25)}[support]
    a, b, c = points[faces[face]]
    point = a + coordinates[0] * (b - a) + coordinates[1] * (c - a)
    second = faces[face][1]
    at = {"vertex": list(range(len(faces))), "edge": [k for k, f in enumerate(faces) if second in f], "face": [face]}
    around = torch.stack([points[faces[k]] - point for k in at[support]])
    others = {"vertex": range(1, len(points)), "edge": [second], "face": []}[support]
    edges = []
    for end in others:
        thirds = [points[v] - point for f in faces if end in f for v in f if v not in (0, end)]
        edges.append((torch.nn.functional.normalize(points[end], dim=0), torch.stack(thirds)))
    normal = torch.randn(3, generator=random, dtype=torch.float64)
    normal[2] = 0.5 + normal[2].abs()
    offset = torch.randn(3, generator=random, dtype=torch.float64) * 1e-14
    offset = [0.0 * offset, offset, torch.tensor([0.0, 0.0, 0.01]).double()][
        int(torch.randint(3, (), generator=random))
    ]
    return Case(mesh, face, coordinates, around, edges, torch.nn.functional.normalize(normal, dim=0), offset)


def found(cases: list[Case], is_first: bool) -> Tensor:
    """Normals from the surface to the needle; the surface is i or j, and all are turned."""
    count, side = len(cases), 0 if is_first else 1
    turn = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.7, 0.4]).double(), dim=0)
    matrix = matrix_of(turn)
    scene = pgccd.Scene(
        [NEEDLE, *(each.mesh for each in cases)],
        [k for row in range(1, count + 1) for k in ((row, 0) if is_first else (0, row))],
    )
    position = torch.zeros(count, 2, 3, dtype=torch.float64)
    for row, each in enumerate(cases):
        a, b, c = each.mesh.vertices[each.mesh.faces[each.face].long()]
        u, v = each.coordinates
        position[row, 1 - side] = matrix @ (a + (u * (b - a) + v * (c - a)) + each.offset)
    rotation = turn.expand(2 * count, 4).contiguous()
    sign = 1.0 if is_first else -1.0
    hits = contacts_at(
        torch.arange(2 * count).view(-1, 2),
        kind=torch.full((count,), int(pgccd.Kind.VF_BA if is_first else pgccd.Kind.VF_AB), dtype=torch.int8),
        features=torch.tensor([[each.face, 0] if is_first else [0, each.face] for each in cases], dtype=torch.int32),
        coordinates=torch.tensor([each.coordinates for each in cases], dtype=torch.float64),
        toi=torch.zeros(count, dtype=torch.float64),
        point=position[:, 1 - side],
        normal=sign * torch.stack([each.normal for each in cases]) @ matrix.T,
    )
    motion = pgccd.RigidMotion.at_rest(position.view(-1, 3), rotation)
    return sign * surface_normals(scene, motion, hits) @ matrix


def matrix_of(q: Tensor) -> Tensor:
    """(3, 3) of a unit quaternion."""
    w, v = q[0], q[1:]
    skew = torch.linalg.cross(torch.eye(3).double(), v.expand(3, 3))
    return torch.eye(3).double() + 2.0 * (w * skew + skew @ skew)


class Admitted:
    """The normals that the faces of a case admit: of faces (m, 3), of arcs about convex edges, and of a cone."""

    def __init__(self, each: Case) -> None:
        self.around = each.around.flatten(0, 1)
        a, b, c = each.around.unbind(1)
        of_faces = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
        #: Of upright faces either may be taken.
        self.either = of_faces[of_faces[:, 2].abs() < 0.3]
        self.of_faces = (of_faces * torch.sign(of_faces[:, 2:]))[of_faces[:, 2].abs() >= 0.3]
        self.convex = [(along, thirds) for along, thirds in each.edges if is_convex(along, thirds)]
        self.is_manifold = all(len(thirds) <= 2 for _, thirds in each.edges)
        self.has_cone = bool(self.convex) and len(each.edges) > 1

    def samples(self) -> Tensor:
        """(n, 3): those on the upper side of the faces. Edges of three faces admit but these."""
        found = [self.of_faces]
        angle = torch.linspace(-math.pi, math.pi, 4001, dtype=torch.float64)[:, None]
        for along, thirds in self.convex:
            aside, up = across(along)
            circle = torch.cos(angle) * aside + torch.sin(angle) * up
            circle = circle[(circle @ thirds.T <= 0.0).all(1)]
            if len(thirds) == 1:  # of an open edge those on the upper side of its face
                of_face = torch.nn.functional.normalize(torch.linalg.cross(along, thirds[0]), dim=0)
                circle = circle[(circle @ of_face) * of_face[2] >= 0.0] if of_face[2].abs() >= 0.3 else circle[:0]
            found.append(circle)
        if self.has_cone and self.is_manifold:
            found.append(UPWARDS[(UPWARDS @ self.around.T <= 0.0).all(1)])
        return torch.cat(found)

    def contains(self, normal: Tensor) -> bool:
        """Up to rounding, and 1e-5 of faces."""
        exact = torch.cat([self.of_faces, self.either, -self.either])
        if (exact - normal).norm(dim=1).min() < 1e-12:
            return True
        if self.has_cone and (self.around @ normal).max() <= 2e-5:
            return True
        arcs = (abs(float(along @ normal)) < 1e-12 and (thirds @ normal).max() <= 2e-5 for along, thirds in self.convex)
        return any(arcs)


def across(along: Tensor) -> tuple[Tensor, Tensor]:
    """Two directions across an edge, the second one upwards."""
    aside = torch.nn.functional.normalize(torch.linalg.cross(along, torch.tensor([0.0, 0.0, 1.0]).double()), dim=0)
    return aside, torch.linalg.cross(aside, along)


def is_convex(along: Tensor, thirds: Tensor) -> bool:
    """Whether an edge has one face, or two between which there is more than half of the space, that above included."""
    if len(thirds) != 2:
        return len(thirds) == 1
    aside, up = across(along)
    left, right = torch.atan2(-(thirds @ aside), thirds @ up).sort().values.tolist()  # 0: upwards
    return right - left > math.pi + 1e-4 if left < 0.0 < right else False


def _sphere(count: int) -> Tensor:
    place = torch.arange(count, dtype=torch.float64) + 0.5
    z, around = 1.0 - 2.0 * place / count, place * math.pi * (1.0 + math.sqrt(5.0))
    across = torch.sqrt(1.0 - z * z)
    return torch.stack([across * torch.cos(around), across * torch.sin(around), z], 1)


UPWARDS = _sphere(20000)[:10000]


@pytest.mark.parametrize("support", ["vertex", "edge", "face"])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_nearest_that_the_faces_admit(shape: str, support: str) -> None:
    random = torch.Generator().manual_seed(11)
    cases = [case(shape, support, random) for _ in range(20)]
    changed = 0
    of_second, of_first = (found(cases, is_first) for is_first in (False, True))
    for row, each in enumerate(cases):
        admitted = Admitted(each)
        nearest = float((admitted.samples() @ each.normal).max())
        # As the second body the needle has the last word, and does not admit those beside it.
        for normal in (of_second[row], of_first[row])[: 2 if of_second[row, 2] > 0.03 else 1]:
            assert float(normal.norm()) == pytest.approx(1.0, abs=1e-12)
            assert admitted.contains(normal), row
            # Vertices that coincide have no normal of their own to be near to.
            is_free = support == "vertex" and float(each.offset.norm()) < 1e-12 and admitted.has_cone
            assert is_free or float(normal @ each.normal) >= nearest - 1e-6, row
            changed += float(normal @ each.normal) < 1.0 - 1e-9
    assert changed > 5


@pytest.mark.parametrize("subdivisions", [1, 2, 3])
def test_spheres_that_meet_at_vertices(subdivisions: int) -> None:
    """The normal is along the line of centres, whatever features the search names."""
    mesh = pgccd.Mesh.icosphere(1.3, subdivisions=subdivisions)
    vertices = mesh.vertices[torch.randperm(len(mesh.vertices), generator=torch.Generator().manual_seed(1))[:40]]
    count = len(vertices)
    x = torch.stack([0.0 * vertices, 2.5 * vertices], 1).view(-1, 3)
    v = torch.stack([0.0 * vertices, -vertices], 1).view(-1, 3)
    q = torch.tensor([[1.0, 0, 0, 0]]).expand(2 * count, 4)
    scene = pgccd.Scene([mesh], [0] * (2 * count), world=torch.arange(count).repeat_interleave(2))
    motion = pgccd.RigidMotion.from_velocity(x, q, v, 0.0 * v, 1.0)
    hits = pgccd.detect(scene, motion, normals="surface", tolerance=0.0)
    assert len(hits) == count
    torch.testing.assert_close(hits.normal, vertices / 1.3, rtol=0.0, atol=1e-12)
    features = pgccd.detect(scene, motion, tolerance=0.0)
    assert ((features.normal - vertices / 1.3).norm(dim=1) > 0.02).any()


def test_of_two_flat_surfaces_the_larger_face_decides() -> None:
    """Edges within flat faces that cross at an angle, as where bodies intersect, in both orders."""
    floor, plate = ridge(0, 0.0, 10.0), ridge(1, 0.0, 0.1)
    tilted = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]]).double()
    plate = pgccd.Mesh(plate.vertices @ tilted.T, plate.faces)
    for meshes in ([floor, plate], [plate, floor]):
        normal = edges_meet(meshes, (0.0, -0.5, 0.8))
        torch.testing.assert_close(normal.abs(), torch.tensor([0.0, 0.0, 1.0]).double())


def ridge(axis: int, height: float, length: float = 1.0) -> pgccd.Mesh:
    """Two faces at an edge along x or y, whose middle is the origin; their other corners are at a height above it."""
    ends, corners = torch.zeros(2, 2, 3, dtype=torch.float64).unbind(0)
    ends[:, axis], corners[:, 1 - axis] = torch.tensor([[-length, length], [-1.0, 1.0]]).double().unbind(0)
    corners[:, 2] = height
    return pgccd.Mesh(torch.cat([ends, corners]), [[0, 1, 2], [1, 0, 3]])


def meeting(
    kind: int,
    meshes: list[pgccd.Mesh],
    features: list[int],
    coordinates: tuple[float, float],
    normal: tuple[float, float, float],
    offset: Tensor | float = 0.0,
    travel: tuple[float, float, float] = (0.0, 0.0, 0.0),
    toi: float = 0.0,
) -> Tensor:
    """The surface's normal at one contact, at the origins of both meshes, of which the second one moves."""
    arrival = torch.stack([torch.zeros(3).double(), torch.zeros(3).double() + offset])
    change = torch.tensor([[0.0, 0.0, 0.0], travel], dtype=torch.float64)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    motion = pgccd.RigidMotion(arrival - toi * change, upright, arrival + (1.0 - toi) * change, upright)
    hits = contacts_at(
        torch.tensor([[0, 1]]),
        kind=torch.tensor([kind], dtype=torch.int8),
        features=torch.tensor([features], dtype=torch.int32),
        coordinates=torch.tensor([coordinates], dtype=torch.float64),
        toi=torch.tensor([toi], dtype=torch.float64),
        point=torch.zeros(1, 3, dtype=torch.float64),
        normal=torch.tensor([normal], dtype=torch.float64),
    )
    return surface_normals(pgccd.Scene(meshes), motion, hits)[0]


def edges_meet(meshes: list[pgccd.Mesh], normal: tuple[float, float, float], **options: Any) -> Tensor:
    edges = [mesh.edges.tolist().index([0, 1]) for mesh in meshes]
    return meeting(pgccd.Kind.EE, meshes, edges, (0.5, 0.5), normal, **options)


UPPER, LOWER = ridge(0, 1.0, 0.1), ridge(1, -1.0)


@pytest.mark.parametrize("height", [0.0, 0.3])
def test_of_two_edges_the_one_that_is_not_convex_decides(height: float) -> None:
    """An edge above a flat or concave one, in both orders."""
    valley, above = ridge(1, height), torch.tensor([0.0, 0.0, 0.05]).double()
    # The normals of both its faces are as near.
    of_face = torch.nn.functional.normalize(torch.tensor([height, 0.0, 1.0]).double(), dim=0)
    on_first = edges_meet([valley, UPPER], (0.0, 0.0, 1.0), offset=above)
    on_second = edges_meet([UPPER, valley], (0.0, 0.0, -1.0), offset=-above)
    assert on_first[2] > 0.0 > on_second[2]
    torch.testing.assert_close(on_first.abs(), of_face)
    torch.testing.assert_close(on_second.abs(), of_face)


def test_of_a_face_and_a_flat_vertex_the_face_decides() -> None:
    """A small face askew above a sheet, in both orders."""
    floor = sheet(2, 1.0)
    corners = torch.tensor([[0.1, 0.0, 0.02], [-0.05, 0.08, -0.01], [-0.05, -0.08, -0.01]], dtype=torch.float64)
    small, normal = pgccd.Mesh(corners, [[0, 1, 2]]), torch.tensor([-0.2, 0.0, 1.0]).double()
    normal = torch.nn.functional.normalize(normal, dim=0)
    third, middle = (1.0 / 3.0, 1.0 / 3.0), int(floor.vertices.norm(dim=1).argmin())
    on_first = meeting(pgccd.Kind.VF_BA, [small, floor], [0, middle], third, (0.0, 0.0, -1.0), -0.05 * normal)
    on_second = meeting(pgccd.Kind.VF_AB, [floor, small], [middle, 0], third, (0.0, 0.0, 1.0), 0.05 * normal)
    torch.testing.assert_close(on_first, -normal)
    torch.testing.assert_close(on_second, normal)


def test_edges_that_coincide_were_apart_before() -> None:
    """Convex edges that met: the normal of the wrong side is turned round; parallel edges have none, but a velocity."""
    down, up = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
    assert edges_meet([UPPER, LOWER], up, travel=up, toi=0.5).tolist() == list(down)
    assert edges_meet([UPPER, LOWER], down, travel=up, toi=0.5).tolist() == list(down)
    along = edges_meet([ridge(1, 1.0), LOWER], (0.0, 0.0, 0.0), travel=(-0.6, 0.0, 0.8))
    torch.testing.assert_close(along, torch.tensor([0.6, 0.0, -0.8]).double())


@pytest.mark.parametrize("is_inside", [True, False])
def test_beside_an_edge_of_a_solid(is_inside: bool) -> None:
    """A blade that is in front of one face, and behind the plane of the other one, where the surface is convex."""
    section = [(0.0, 0.0), (-1.0, 1.0), (0.0, -1.0), (1.0, 1.0)] if is_inside else [(0, 0), (-1, -1), (0, -2), (1, -1)]
    points = [[x, y, z] for y in (-1.0, 1.0) for x, z in section]
    sides = [face for k in range(4) for m in [(k + 1) % 4] for face in ([k, k + 4, m], [m, k + 4, m + 4])]
    solid = pgccd.Mesh(points, [*sides, [0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]])
    for x, z in ((-0.5, -0.25), (-0.5, 0.25), (0.5, -0.25), (0.5, 0.25)):
        offset = torch.tensor([-x, 0.0, -z], dtype=torch.float64)
        corners = [[0.2 * x + s * z, 0.0, 0.2 * z - s * x] for s in (0.02, -0.02)]
        blade = pgccd.Mesh([[0.0, -0.1, 0.0], [0.0, 0.1, 0.0], *corners], [[0, 1, 2], [1, 0, 3]])
        edges = [mesh.edges.tolist().index(ends) for mesh, ends in ((blade, [0, 1]), (solid, [0, 4]))]
        normal = torch.nn.functional.normalize(offset, dim=0)
        expected = torch.tensor([-x, 0.0, 0.5 if is_inside else -0.5], dtype=torch.float64) / math.sqrt(0.5)
        from_blade = meeting(pgccd.Kind.EE, [blade, solid], edges, (0.5, 0.5), normal.tolist(), offset)
        torch.testing.assert_close(from_blade, expected)
        # In the other order the blade has the last word.
        to_blade = meeting(pgccd.Kind.EE, [solid, blade], edges[::-1], (0.5, 0.5), (-normal).tolist(), -offset)
        assert float(to_blade @ expected) < -0.3
