"""Derivatives of contacts, by expressions of torch on their rows.

At a contact the gap g = n . (x_j - x_i) - d is zero, with the nearest points x of both features, the normal n and the
separation d. By the envelope theorem, coordinates and normal may be held fixed in the derivative of g, so d toi = -(dg
/ d input) / (dg / dt). The derivatives of the coordinates follow from the condition that the points are nearest; those
of point and normal follow from the coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Contacts whose gap closes at less than this part of the speed of their points graze.
_GRAZING = 1e-6
# Sums of coordinates from here on are on the third edge of a face: a rounding below 1.
_ON_THIRD_EDGE = 1.0 - 2.0**-51
# Features whose directions have a squared sine below this are parallel.
_PARALLEL = 1e-20


@dataclass
class Corners:
    """Corners c0, c1, c2 of both features of each contact at its toi. The point with coordinates (u, v) is c0 + u (c1 -
    c0) + v (c2 - c0). All corners of a vertex are the same. For an edge of i the third corner equals the first; for an
    edge of j, the second corner does.

    Args:
        position: (K, 2, 3, 3), with gradients.
        velocity: (K, 2, 3, 3), per step; without gradients.
        on_edges: (K,) bool: both features are edges.
        separation: (K,), with gradients.
    """

    position: Tensor
    velocity: Tensor
    on_edges: Tensor
    separation: Tensor


@dataclass
class Differentiated:
    """Expressions whose derivatives are those of the contacts' columns; their values are not.

    Attributes:
        toi: (K,).
        coordinates: (K, 2).
        point: (K, 3).
        normal: (K, 3).
        differentiable: (K,) bool: elsewhere all derivatives are 0.
    """

    toi: Tensor
    coordinates: Tensor
    point: Tensor
    normal: Tensor
    differentiable: Tensor


def differentiate(corners: Corners, sound: Tensor, coordinates: Tensor, normal: Tensor | None) -> Differentiated:
    """Derivatives of contacts.

    Args:
        corners: of the features.
        sound: (K,) bool: contacts that may have derivatives.
        coordinates: (K, 2) float64.
        normal: (K, 3) from the first feature to the second; None: it is found, such that the gap closes.
    """
    first, second = _directions(corners.on_edges, coordinates)
    span = corners.position[:, :, 1:] - corners.position[:, :, :1]  # (K, 2, 2, 3)
    span = span[:, 1] - span[:, 0]  # of the offset from i to j, by u and by v
    of_features = torch.linalg.cross(span[:, 0], span[:, 1])
    weights = _weights(coordinates)
    offset = _offset(corners.position, weights)
    velocity = _offset(corners.velocity, weights)
    inside = (first != 0.0).any(1) & (second != 0.0).any(1)
    apart = corners.separation.detach() > 0.0
    # The normal of the features does not depend on how small the offset is.
    by_features = inside | ~apart if normal is None else inside
    across = torch.where(by_features[:, None], of_features, offset)
    with torch.no_grad():
        length = across.norm(dim=1, keepdim=True)
        unit = across / torch.where(length > 0.0, length, 1.0)
        if normal is None:
            closing = torch.where(by_features, (unit * velocity).sum(1), -1.0)
            sign = torch.where(closing > 0.0, -1.0, 1.0)[:, None]
            unit = sign * unit
        else:
            sign = torch.where((unit * normal).sum(1) < 0.0, -1.0, 1.0)[:, None]
            unit = torch.where(by_features[:, None] & (length > 0.0), sign * unit, normal)
        rate = (unit * velocity).sum(1)
        # Without a separation the sign of the normal may be lost in rounding; the derivative does not depend on it.
        closing = torch.where(by_features & ~apart, rate.abs(), -rate)
        sound = sound & (closing > _GRAZING * velocity.norm(dim=1))
        inverse_rate = torch.where(sound, -1.0 / torch.where(sound, rate, 1.0), 0.0)
    gap = (unit * offset).sum(1) - corners.separation
    toi = _change(gap) * inverse_rate

    # What moves moves with the toi, too.
    mask = sound[:, None]
    position = corners.position + corners.velocity * toi[:, None, None, None]
    span = position[:, :, 1:] - position[:, :, :1]
    span = span[:, 1] - span[:, 0]
    change = _change_of_coordinates(span, _offset(position, weights), first, second)
    moved = torch.where(mask, change, 0.0)
    weights = _weights(coordinates.detach() + moved)
    point = 0.5 * (weights[:, :, None] * position.sum(1)).sum(1)
    of_features = torch.linalg.cross(span[:, 0], span[:, 1])
    across = torch.where(by_features[:, None], of_features, _offset(position, weights))
    turning = _change(across)
    turning = turning - unit * (unit * turning).sum(1, keepdim=True)
    has_direction = mask & (length > 0.0) & (by_features | apart)[:, None]
    turning = torch.where(has_direction, sign * turning / torch.where(length > 0.0, length, 1.0), 0.0)
    return Differentiated(toi, moved, torch.where(mask, point, 0.0), turning, sound)


def _weights(coordinates: Tensor) -> Tensor:
    """(K, 3): weights of the three corners."""
    return torch.cat([1.0 - coordinates.sum(1, keepdim=True), coordinates], dim=1)


def _offset(corners: Tensor, weights: Tensor) -> Tensor:
    """(K, 3): the point of the second feature less that of the first, by corners (K, 2, 3, 3) and weights (K, 3)."""
    return (weights[:, :, None] * (corners[:, 1] - corners[:, 0])).sum(1)


def _change(value: Tensor) -> Tensor:
    """Zero, with the gradient of the value."""
    return value - value.detach()


def _directions(on_edges: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
    """Two directions (K, 2) in which the coordinates may change; zero for those in which they are at a limit."""
    u, v = coordinates.unbind(1)
    along_u = torch.stack([torch.ones_like(u), torch.zeros_like(u)], 1)
    along_v, third = along_u.flip(1), along_u - along_u.flip(1)
    low_u, low_v = u <= 0.0, v <= 0.0
    high = u + v >= _ON_THIRD_EDGE
    free_u = torch.where(on_edges, ~low_u & (u < 1.0), ~low_u & ~high)
    free_v = torch.where(on_edges, ~low_v & (v < 1.0), ~low_v & ~high)
    is_third = ~on_edges & high & ~low_u & ~low_v
    first = torch.where(is_third[:, None], third, along_u * free_u[:, None])
    return first, along_v * free_v[:, None]


def _change_of_coordinates(span: Tensor, offset: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """(K, 2): zero, with the gradient of the coordinates at which the length of the offset is least.

    Args:
        span: (K, 2, 3): derivatives of the offset by u and v.
        offset: (K, 3).
        first, second: (K, 2): directions of the coordinates.
    """
    a, b = ((direction[:, :, None] * span).sum(1) for direction in (first, second))
    with torch.no_grad():
        aa, ab, bb = (a * a).sum(1), (a * b).sum(1), (b * b).sum(1)
        has_a, has_b = aa > 0.0, bb > 0.0
        aa, bb = torch.where(has_a, aa, 1.0), torch.where(has_b, bb, 1.0)
        determinant = aa * bb - ab * ab
        sound = determinant > _PARALLEL * aa * bb
        inverse = torch.where(sound, 1.0 / torch.where(sound, determinant, 1.0), 0.0)
    of_a, of_b = _change((a * offset).sum(1)), _change((b * offset).sum(1))
    by_a = (ab * of_b - bb * of_a) * inverse * has_a
    by_b = (ab * of_a - aa * of_b) * inverse * has_b
    return by_a[:, None] * first + by_b[:, None] * second
