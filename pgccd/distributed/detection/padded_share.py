"""One rank's share of a step, as in `share`, in fixed capacities, without synchronising, so that the step can be part
of a CUDA graph. Unused rows are padding: id -1 and negative radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from pgccd import ops
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.checks import check_separation, operator_tolerance
from pgccd.detection.parts import Part, find_part, pairs_of_step
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.detection.body_columns import bodies_of, of_checked, take_bodies
from pgccd.distributed.detection.share import Build, OfHeld, Options, PartEstimates, Share
from pgccd.distributed.halo.capacity import HaloCapacity, PaddedHalo, padded_count, padded_counts
from pgccd.distributed.halo.centres import centres_of
from pgccd.distributed.halo.held import Held
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion
from pgccd.runtime.side_stream import SideStream

T = TypeVar("T")

# Bodies that have left their rank's cells, and stay until migration, reach far into those of others.
_NEAR_SLACK = 2
# Spare rows for arriving bodies: this fraction of the own bodies, plus a constant.
_OWN_SHARE, _OWN_MORE = 16, 256


def can_replay(comm: Comm, device: torch.device) -> bool:
    """Whether a step of a rank can be a CUDA graph, messages included."""
    return device.type == "cuda" and (comm.size == 1 or comm.goes_with_the_stream)


def rows_with_slack(count: int) -> int:
    """Rows of a graph for `count` own bodies."""
    return count + count // _OWN_SHARE + _OWN_MORE


@dataclass(frozen=True)
class ShareCapacity:
    """Padded counts of bodies; two ranks compute equal values from the last step for what they exchange."""

    halo: HaloCapacity
    near: int  #: own bodies near ghosts or at the boundary
    common: list[int]  #: bodies held both by this rank and by each neighbour

    @classmethod
    def after(cls, share: Share, neighbours: Neighbourhood, common: Sequence[int] = ()) -> ShareCapacity:
        """Capacities for a step like the one with this share, with `common` bodies in common with each neighbour."""
        rows = share.parts[-1].rows
        near = 0 if rows is None else len(rows) - share.held.ghost_count
        halo, of_near = HaloCapacity.of(share.held, neighbours), padded_count(_NEAR_SLACK * near)
        return cls(halo, of_near, padded_counts(common, neighbours))


@dataclass(frozen=True)
class PaddedShare(Generic[T]):
    """The enqueued searches of one rank's step."""

    held: Held
    of_held: T  #: the result of the function of this name
    parts: list[Part]
    pairs: Tensor | None  #: (P, 2) int64: see `pairs_of_step`; if wanted
    failed: Tensor  #: (1,) int64, nonzero if a capacity was exceeded or a pose is invalid


def search_padded_share(
    decomposition: Decomposition,
    own: Columns,
    build: Build,
    options: Options,
    estimates: PartEstimates,
    capacity: ShareCapacity,
    discard: Tensor,
    slack: float,
    of_held: OfHeld[T],
    wants_pairs: bool = False,
) -> PaddedShare[T]:
    """Sends ghosts and enqueues both searches. Does not synchronise if messages are sent on the stream.

    Args:
        decomposition, build, options, estimates: as for `OwnSearch`; the motion is rigid.
        own: columns of this rank's own bodies, "id" ascending, then padding with id -1 and a valid pose.
        capacity: of the halo and of own bodies near ghosts or at the boundary.
        discard, slack: see `find_part`.
        of_held: enqueues work that other ranks wait for, concurrent with the search of own pairs.
        wants_pairs: whether the pairs of the whole step are needed.
    """
    kept = check_separation(options.min_separation), operator_tolerance(options.tolerance)
    subdomain, device = decomposition.subdomain, own["id"].device
    bodies = MovingBodies.of(*_build_padded(build, own), wait=False)
    centres, asked = centres_of(bodies), (options.query, options.broad_phase)
    if decomposition.comm.size == 1:
        part = find_part(bodies, *asked, None, discard, estimate=estimates.own, slack=slack)
        held = Held.alone(decomposition.neighbours, own)
        made = of_held(held, centres, kept, decomposition)
        return PaddedShare(held, made, [part], part.pairs, bodies._first_faults()[-1:])
    where = *kept, *subdomain
    reach, boundary, count = ops.boundary_bodies(centres, *where)
    of_pairs = *kept, reach, *subdomain
    side = SideStream(device, options.overlap)
    with side:
        halo = PaddedHalo(decomposition, capacity.halo, own, centres, kept, boundary, count).start()
        halo.send()
    own_part = find_part(bodies, *asked, None, discard, None, estimates.own, slack, elsewhere=reach)
    own_pairs_found = side.mark()
    own_part.begin()
    with side:
        held = halo.padded()
        for name, column in held.ghosts.items():
            if name.startswith("orientation"):
                _set_unit(column, held.ghosts["id"] < 0)
        ghosts = of_checked(*_build_padded(build, held.ghosts))
        near, near_count = ops.near_ghosts(centres, reach, centres_of(ghosts), *where)
        near = _first_rows(near[: capacity.near], near_count)
        rows = torch.cat([near, torch.arange(held.own_count, len(held), device=device)])
        columns = take_bodies(bodies, ghosts, rows)
        columns["radius"] = torch.where(rows < 0, -torch.inf, columns["radius"])
        _set_unit(columns["orientation_t0"], rows < 0)
        at_boundary = bodies_of(bodies, columns)

        def owned_at_boundary(pairs: Tensor) -> tuple[Tensor, Tensor]:
            return ops.owned_pairs(pairs, rows, held.id, centres_of(at_boundary), *of_pairs)

        found = find_part(at_boundary, *asked, owned_at_boundary, discard, rows, estimates.with_ghosts, slack)
        with side.sharing():
            found.begin()
        made = of_held(held, centres_of(ghosts), kept, decomposition)
        found.first_contacts()
        side.wait(own_pairs_found)
        pairs = pairs_of_step([own_part, found]) if wants_pairs else None
        failed = halo.overflow + (near_count > capacity.near) + bodies._first_faults()[-1:]
    side.join()
    return PaddedShare(held, made, [own_part, found], pairs, failed)


def _build_padded(build: Build, columns: Columns) -> tuple[Scene, RigidMotion]:
    """Scene and motion; padding gets a negative radius, so no pair contains it."""
    scene, motion = build(columns)
    assert isinstance(motion, RigidMotion)
    scene._leave_out(columns["id"] < 0)
    return scene, motion


def _set_unit(orientation: Tensor, is_padding: Tensor) -> None:
    """Makes rows of padding, which are zeros, unit quaternions. A pose without one has no swept sphere: the NaN that is
    computed instead would not be left out by broad phases, and hide pairs of others.
    """
    orientation[:, 0].masked_fill_(is_padding, 1.0)


def _first_rows(rows: Tensor, count: Tensor) -> Tensor:
    """The first `count` (1,) of rows (K,), then -1."""
    return torch.where(torch.arange(len(rows), device=rows.device) < count, rows, -1)
