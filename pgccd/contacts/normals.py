"""Normals of the surfaces at contacts, instead of those of the features that touch.

Where features nearly touch, the direction from one to the other may be any, as of a box that slides over the edge
between two coplanar triangles of a floor. The surface at the point has normals in the cone of the faces around it: at a
convex edge all between those of its two faces, elsewhere those of the faces alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pgccd.contacts.kinds import EDGE, FACE, VERTEX, Kind
from pgccd.contacts.sites import Sites, groups_of, reduced
from pgccd.geometry.incidence import Lists
from pgccd.motion.differentiable import sum_by_row
from pgccd.motion.paths import VertexMotion
from pgccd.motion.vectors import cross, dot, norm, unit_or_zero

Normals = Literal["features", "surface"]
NORMALS = ("features", "surface")

# Faces, and pairs of faces of both sides, that are examined together.
_MOST_FACES = 1 << 17
# Sines of angles below which faces count as coplanar, and points as in a plane.
_FLAT = 1e-5
# A point is at a corner of a face if it is nearer to it than this part of the distance to the farthest one.
_AT_CORNER = 2.0**-40
# A surface is on one side of a plane if it reaches this many times as far there as on the other.
_ONE_SIDED = 1e5


@dataclass
class _Side:
    """The surface of one side of K contacts around the nearest points.

    Attributes:
        side: 0 (i) or 1 (j).
        what, row: of `Sites.supports`.
        point: (K, 3), the nearest point, relative to the reference of the body.
        owner, face: of `Sites.faces_around` (m,).
        away: (m, 3, 3), corners of these faces, relative to the point.
        out: (K, 3), the normal of one of these faces that points out of a closed mesh; 0 of other meshes.
    """

    side: int
    what: Tensor
    row: Tensor
    point: Tensor
    owner: Tensor
    face: Tensor
    away: Tensor
    out: Tensor

    @classmethod
    def of(cls, sites: Sites, side: int) -> _Side:
        what, row = sites.supports(side)
        point = sites.nearest(side)
        owner, face = sites.faces_around(what, row)
        away = _corners(sites, side, point, owner, face)
        place = torch.arange(len(owner), device=owner.device)
        first = reduced(place, owner, len(sites), "amin", len(owner)).clamp(max=max(len(owner) - 1, 0))
        out = sites.incidence.outward[sites.mesh[:, side]][:, None] * _wound(away[first])
        return cls(side, what, row, point, owner, face, away, out)

    def over(self, offset: Tensor, noise: Tensor) -> Tensor:
        """(K,): 1 or -1: on which side of the nearest face that they are over offsets (K, 3) end, by the order of its
        corners, if they are more than `noise` (K,) from its plane; 0 without such a face.
        """
        wound, point = _wound(self.away), offset[self.owner]
        height = dot(wound, point)
        is_over = height.abs() > noise[self.owner]
        for k in range(3):
            start, end = self.away[:, k], self.away[:, (k + 1) % 3]
            inward = cross(wound, end - start)
            is_elsewhere = -dot(inward, start) > _FLAT * norm(inward) * norm(start)
            is_over = is_over & (is_elsewhere | (dot(inward, point) >= 0.0))
        above, below = (
            reduced(torch.where(is_over & (h > 0.0), h, torch.inf), self.owner, len(noise), "amin", torch.inf)
            for h in (height, -height)
        )
        return (above < below).double() - (below < above).double()


def _corners(sites: Sites, side: int, point: Tensor, owner: Tensor, face: Tensor) -> Tensor:
    """(m, 3, 3): corners of faces (m,) of one side, relative to a point (K, 3) of contacts (m,); one of them may be
    that point, and is zero then.
    """
    vertices = sites.incidence.faces[face].reshape(-1)
    corners = sites.arms(side, owner.repeat_interleave(3), vertices).view(-1, 3, 3) - point[owner][:, None]
    length = norm(corners)
    return torch.where((length > _AT_CORNER * length.amax(1, keepdim=True))[:, :, None], corners, 0.0)


def _wound(corners: Tensor) -> Tensor:
    """Unit normals (m, 3) by the order of corners (m, 3, 3); zero without an area."""
    return unit_or_zero(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def surface_normals(sites: Sites, normal: Tensor) -> Tensor:
    """(K, 3): normals of the surfaces from i to j; see `pgccd.detect`.

    Where vertices of many faces meet, hundreds of contacts have the same surfaces. These are examined once.

    Args:
        sites: the contacts.
        normal: (K, 3), of their features.
    """
    rows = torch.nonzero(sites.kind <= Kind.EE)[:, 0]
    if len(rows) == 0:
        return normal
    some, found = sites[rows], normal.clone()
    normal = normal[rows]
    normal = torch.where(some.is_reversed(normal)[:, None], -normal, normal)
    # Parallel edges that coincide have no normal.
    normal = torch.where((norm(normal) > 0.0)[:, None], normal, -unit_or_zero(some.velocity()))
    offset, noise = some.offset()
    # Otherwise no height above a face exceeds the noise.
    apart = norm(offset) > 0.5 * noise
    offset, noise = torch.where(apart[:, None], offset, 0.0), torch.where(apart, noise, 0.0)
    places = [some.bodies, some.toi, offset, noise]
    supports = [some.supports(side) for side in (0, 1)]
    faces = torch.stack([some.face_counts(*each) for each in supports], 1)
    for side in (0, 1):
        places += [*supports[side], some.nearest(side)]
    if isinstance(some.motion, VertexMotion):  # whose positions are relative to it
        places.append(some.point)
    left = torch.arange(len(rows), device=rows.device)
    for columns in (places, [*places, normal]):
        group, first = groups_of(*(column[left] for column in columns))
        is_done = torch.zeros_like(left, dtype=torch.bool)
        for members, begin, end in _parts(faces[left[first]], group):
            chosen, heads = left[members], left[first[begin:end]]
            result, is_sound = _of_groups(
                some[heads], offset[heads], noise[heads], normal[heads], normal[chosen], group[members] - begin
            )
            found[rows[chosen]], is_done[members] = result, is_sound
        left = left[~is_done]
        if len(left) == 0:
            break
    return found


def _parts(faces: Tensor, group: Tensor) -> Iterator[tuple[Tensor, int, int]]:
    """Groups of contacts that are examined together, so that memory is bounded: their contacts, ascending by group, and
    the range of groups.

    Args:
        faces: (G, 2), of each side.
        group: (K,) of each contact.
    """
    members = torch.argsort(group, stable=True)
    begin = torch.searchsorted(group[members], torch.arange(len(faces) + 1, device=group.device))
    total = (faces.prod(1) + faces.sum(1) * (1 + begin[1:] - begin[:-1])).cumsum(0)
    first = 0
    while first < len(faces):
        before = int(total[first - 1]) if first else 0
        last = max(first + 1, int(torch.searchsorted(total, before + _MOST_FACES, right=True)))
        yield members[int(begin[first]) : int(begin[last])], first, last
        first = last


def _of_groups(
    places: Sites, offset: Tensor, noise: Tensor, of_places: Tensor, normal: Tensor, group: Tensor
) -> tuple[Tensor, Tensor]:
    """(K, 3): normals of the surfaces, and whether they do not depend on the normal `of_places` (K,).

    Args:
        places: one contact of each group, whose surfaces are equal.
        offset, noise: (G, 3) and (G,), see `Sites.offset`.
        of_places: (G, 3), a normal of the features of each group.
        normal: (K, 3), of the features.
        group: (K,) of each contact.
    """
    sides = (_Side.of(places, 0), _Side.of(places, 1))
    surfaces = [_Surface.of(places, sides[k], sides[1 - k], offset, noise, of_places) for k in (0, 1)]
    one, other = surfaces
    is_sound = ~(one.is_guessed | other.is_guessed)[group] | (normal == of_places[group]).all(1)
    # Vertices that coincide have no direction of their own.
    coincide = (norm(offset) <= noise) & (sides[0].what == VERTEX) & (sides[1].what == VERTEX)
    mean = unit_or_zero(one.mean() + other.mean())
    has_mean = coincide & one.admits(mean) & other.admits(mean)
    normal = torch.where(has_mean[group][:, None], mean[group], normal)
    # A surface with few directions has the last word; of two that are flat there, the one with the larger face.
    is_larger = one.largest_face() > other.largest_face()
    last_is_one = one.is_rigid & (~other.is_rigid | is_larger) & (sides[1].what != FACE)
    last_is_one = last_is_one | (sides[0].what == FACE)
    row, first = groups_of(group, normal)
    group, normal = group[first], normal[first]
    if len(group) != len(noise):
        one, other = one.of_groups(group), other.of_groups(group)
    by_other = other.nearest(one.nearest(normal))
    by_one = one.nearest(other.nearest(normal))
    return torch.where(last_is_one[group][:, None], by_one, by_other)[row], is_sound


@dataclass
class _Surface:
    """Normals that the surface of one side may have.

    Attributes:
        side: 0 (i) or 1 (j): normals point out of i or into j.
        owner: (m,) contacts.
        normals: (m, 3), zero where a face has no area.
        away: (m, 3, 3) corners of the faces.
        edge_owner, along: (n,) contacts and (n, 3) unit directions of convex edges.
        edge_away: (n, 2, 3) of each the points of its faces that are not on it, relative to the contact; of an edge
            with one face twice the same.
        is_rigid: (K,) bool: no convex edge.
        is_guessed: (K,) bool: on which side the surface is, only the normal of the features says.
    """

    side: int
    owner: Tensor
    normals: Tensor
    away: Tensor
    edge_owner: Tensor
    along: Tensor
    edge_away: Tensor
    is_rigid: Tensor
    is_guessed: Tensor

    @classmethod
    def of(cls, sites: Sites, own: _Side, other: _Side, offset: Tensor, noise: Tensor, normal: Tensor) -> _Surface:
        outside = -1.0 if own.side == 1 else 1.0
        is_guessed = torch.zeros(len(sites), dtype=torch.bool, device=offset.device)

        def oriented(owner: Tensor, face: Tensor, corners: Tensor) -> Tensor:
            """Unit normals (m, 3) from i to j."""
            wound = _wound(corners)
            sign = _sign_out(sites, own, other, owner, face, wound, offset, noise)
            is_guessed[owner[(sign == 0.0) & (norm(wound) > 0.0)]] = True
            sign = torch.where(sign == 0.0, torch.sign(dot(outside * normal[owner], wound)), sign)
            return (outside * torch.where(sign == 0.0, 1.0, sign))[:, None] * wound

        normals = oriented(own.owner, own.face, own.away)
        edge_owner, edge = _edges_around(sites, own)
        along, apexes, is_convex = _convex(sites, own, edge_owner, edge, oriented, outside)
        kept = torch.nonzero(is_convex)[:, 0]
        edge_owner = edge_owner[kept]
        is_rigid = torch.ones(len(sites), dtype=torch.bool, device=offset.device).index_fill(0, edge_owner, False)
        edges = (edge_owner, along[kept], apexes[kept])
        return cls(own.side, own.owner, normals, own.away, *edges, is_rigid, is_guessed)

    def of_groups(self, group: Tensor) -> _Surface:
        """The surfaces of contacts (K,), each in one of the groups that these are of."""
        count, size = len(self.is_rigid), lambda owner: torch.arange(len(owner), device=owner.device)
        owner, faces = Lists.of(self.owner, size(self.owner), count).take(group)
        edge_owner, edges = Lists.of(self.edge_owner, size(self.edge_owner), count).take(group)
        columns = (owner, self.normals[faces], self.away[faces], edge_owner, self.along[edges], self.edge_away[edges])
        return _Surface(self.side, *columns, self.is_rigid[group], self.is_guessed[group])

    def admits(self, normal: Tensor) -> Tensor:
        """(K,) bool: some edge is convex, and all faces are behind the plane with the normal (K, 3)."""
        outside = -1.0 if self.side == 1 else 1.0
        behind = _is_behind(outside * normal[self.owner][:, None], self.away).all(1)
        all_behind = reduced(behind.double(), self.owner, len(normal), "amin", 1.0) > 0.0
        return all_behind & ~self.is_rigid & (norm(normal) > 0.0)

    def mean(self) -> Tensor:
        """(K, 3): mean of the normals of the faces around vertices, of unit length or zero, with the weights of Max
        (1999): those give the normal of a sphere if all vertices are on it.
        """
        corner = norm(self.away).argmin(1)
        a, b = (self.away.gather(1, ((corner + k) % 3)[:, None, None].expand(-1, 1, 3))[:, 0] for k in (1, 2))
        squares = dot(a, a) * dot(b, b)
        weight = norm(cross(a, b)) / torch.where(squares > 0.0, squares, 1.0)
        largest = reduced(weight, self.owner, len(self.is_rigid), "amax", 0.0)[self.owner]
        weight = weight / torch.where(largest > 0.0, largest, 1.0)
        return unit_or_zero(sum_by_row(weight[:, None] * self.normals, self.owner, len(self.is_rigid)))

    def largest_face(self) -> Tensor:
        """(K,): twice the area of the largest face around the nearest point."""
        double_area = norm(cross(self.away[:, 1] - self.away[:, 0], self.away[:, 2] - self.away[:, 0]))
        return reduced(double_area, self.owner, len(self.is_rigid), "amax", 0.0)

    def nearest(self, normal: Tensor) -> Tensor:
        """(K, 3): of the normals that this surface may have those nearest to `normal` (K, 3)."""
        count, outside = len(normal), -1.0 if self.side == 1 else 1.0
        is_kept = self.admits(normal)
        # In the plane across a convex edge.
        of_edge = normal[self.edge_owner]
        across = unit_or_zero(of_edge - dot(of_edge, self.along)[:, None] * self.along)
        is_sound = _is_behind(outside * across[:, None], self.edge_away).all(1) & (norm(across) > 0.0)
        candidates = torch.cat([self.normals, across])
        owner = torch.cat([self.owner, self.edge_owner])
        usable = torch.cat([norm(self.normals) > 0.0, is_sound])
        nearness = torch.where(usable, dot(normal[owner], candidates), -torch.inf)
        best = reduced(nearness, owner, count, "amax", -torch.inf)
        is_best = usable & (nearness == best[owner])
        place = torch.arange(len(owner), device=owner.device)
        first = reduced(torch.where(is_best, place, len(owner)), owner, count, "amin", len(owner))
        is_changed = ~is_kept & (first < len(owner))
        chosen = candidates[torch.where(is_changed, first, 0)] if len(owner) else normal
        return torch.where(is_changed[:, None], chosen, normal)


def _is_behind(normal: Tensor, points: Tensor) -> Tensor:
    """Whether points (..., 3) are behind the plane through the origin with this normal, or in it."""
    return dot(normal, points) <= _FLAT * norm(points)


def _edges_around(sites: Sites, own: _Side) -> tuple[Tensor, Tensor]:
    """Edges at the nearest points: the contact (n,) and the edge (n,)."""
    vertices, edges = (torch.nonzero(own.what == each)[:, 0] for each in (VERTEX, EDGE))
    place, of_vertices = sites.incidence.edges_of_vertex.take(own.row[vertices])
    return torch.cat([vertices[place], edges]), torch.cat([of_vertices, own.row[edges]])


def _convex(  # type: ignore[no-untyped-def]
    sites: Sites, own: _Side, owner: Tensor, edge: Tensor, oriented, outside: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Of edges (n,) the unit direction (n, 3), the points of the first two faces off it (n, 2, 3), and whether they are
    convex; of one face they are, of three or more not.
    """
    lists = sites.incidence.faces_of_edge
    begin, count = lists.begin[edge], lists.begin[edge + 1] - lists.begin[edge]
    last = max(len(lists.items) - 1, 0)
    faces = torch.stack([lists.items[(begin + k * (count > 1)).clamp(max=last)] for k in (0, 1)], 1)
    ends = sites.incidence.edges[edge]
    start, end = (sites.arms(own.side, owner, vertex) - own.point[owner] for vertex in ends.unbind(1))
    along = unit_or_zero(end - start)
    corners = [_corners(sites, own.side, own.point, owner, faces[:, k]) for k in (0, 1)]
    apexes = []
    for k in (0, 1):
        vertices = sites.incidence.faces[faces[:, k]]
        off = (vertices[:, :, None] != ends[:, None]).all(2).long().argmax(1)
        apexes.append(corners[k].gather(1, off[:, None, None].expand(-1, 1, 3))[:, 0])
    normal = outside * oriented(owner, faces[:, 0], corners[0])
    of_apex = apexes[1] - start
    distance = norm(of_apex - dot(of_apex, along)[:, None] * along)
    is_convex = (dot(normal, of_apex) < -_FLAT * distance) | (count == 1)
    return along, torch.stack(apexes, 1), is_convex & (count <= 2) & (norm(along) > 0.0)


def _sign_out(
    sites: Sites,
    own: _Side,
    other: _Side,
    owner: Tensor,
    face: Tensor,
    wound: Tensor,
    offset: Tensor,
    noise: Tensor,
) -> Tensor:
    """(m,): 1 where the normals `wound` (m, 3) of faces (m,) of the surface of one side point to where the other
    surface is, -1 where they point away: by the nearest points, on a closed mesh by the face that they are over; where
    they coincide by the other surface around the point, if it is on one side; then by the order of corners of a closed
    mesh, this one or the other. 0: neither tells.
    """
    towards = offset if own.side == 0 else -offset
    height = dot(towards[owner], wound)
    sign = torch.where(height.abs() > noise[owner], torch.sign(height), 0.0)
    reach = [_reach(other, owner, wound, len(sites), sign_of) for sign_of in (1.0, -1.0)]
    is_above, is_below = reach[0] > _ONE_SIDED * reach[1], reach[1] > _ONE_SIDED * reach[0]
    sign = torch.where(sign == 0.0, is_above.double() - is_below.double(), sign)
    solid = sites.incidence.outward[sites.mesh[:, own.side]][owner]
    # Beside an edge the other surface is behind the plane of one face, though not within the solid.
    over = own.over(towards, noise)[owner]
    sign = torch.where((over != 0.0) & (solid != 0.0), over, sign)
    sign = torch.where(sign == 0.0, solid, sign)
    facing = -dot(other.out[owner], wound)
    return torch.where((sign == 0.0) & (facing.abs() > 0.5), torch.sign(facing), sign)


def _reach(other: _Side, owner: Tensor, direction: Tensor, count: int, sign: float) -> Tensor:
    """(m,): how far the other surface around contacts (m,) extends from the nearest point in directions (m, 3)."""
    # Pairs of a direction and a face of the same contact.
    order = torch.argsort(other.owner, stable=True)
    begin = torch.searchsorted(other.owner[order], torch.arange(count + 1, device=owner.device))
    length = begin[owner + 1] - begin[owner]
    row = torch.repeat_interleave(length)
    within = torch.arange(len(row), device=row.device) - (length.cumsum(0) - length)[row]
    away = other.away[order[begin[owner[row]] + within]]
    height = (sign * dot(direction[row][:, None], away)).amax(1)
    return reduced(height, row, len(owner), "amax", 0.0)
