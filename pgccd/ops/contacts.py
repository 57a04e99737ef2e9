"""Operators for what follows from contacts. All take

mesh_set: as the stages.
bodies: mesh_index (N,) int32, position_t0, position_t1 (N, 3), orientation (N, 4), rotation (N, 3); or of bodies
    given by their vertices mesh_index, x_t0, x_t1 (X, 3), vertex_begin (N,) int64.
linear_path: whether vertices of rigid bodies move on straight lines instead of arcs.
incidence, most: of the meshes, see `pgccd.geometry.incidence`.
contacts: bodies (K, 2) int64, kind (K,), features (K, 2), coordinates (K, 2), toi (K,), point (K, 3), normal
    (K, 3).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops.library import operator


@operator
def closing_rates(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    incidence: Sequence[Tensor],
    most: int,
    contacts: Sequence[Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The rate (K,) at which the gap between the nearest points closes at toi, per step; whether the normal pointed to
    the wrong side (K,) uint8; how far the contact's point is from halfway between the nearest points of its features,
    and the sizes that were added for that, both (K,). NaN where a row names no features of the bodies.
    """
    toi = contacts[4]
    return tuple(torch.empty_like(toi, dtype=kind) for kind in (toi.dtype, torch.uint8, toi.dtype, toi.dtype))  # type: ignore[return-value]


@operator
def surface_normals(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    incidence: Sequence[Tensor],
    most: int,
    contacts: Sequence[Tensor],
) -> Tensor:
    """Unit normals (K, 3) of the surfaces, from i to j."""
    return torch.empty_like(contacts[6])


@operator
def certainly_recede(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    incidence: Sequence[Tensor],
    most: int,
    contacts: Sequence[Tensor],
    status: Tensor,
    slack: Tensor,
) -> Tensor:
    """(K,) uint8: contacts whose features, and the surfaces around them, certainly come closer by at most `slack`, (N,)
    of bodies, in the rest of the step. status: (K,) of the contacts.
    """
    return torch.empty_like(contacts[4], dtype=torch.uint8)
