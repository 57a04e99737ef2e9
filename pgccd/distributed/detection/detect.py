"""Detection on many ranks: every pair of bodies is tested by exactly one rank."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from pgccd import ops
from pgccd.detection.contacts import CollidingPairs, Contacts
from pgccd.detection.parts import Part, contacts_of_step, search_seconds
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.detection.share import Build, Options, OwnSearch, PartEstimates, Share
from pgccd.distributed.halo.capacity import HaloCapacity
from pgccd.distributed.halo.centres import centres_of
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.vertices import Vertices
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.rebalancing import Places
from pgccd.runtime.stages import StageClock


@dataclass(frozen=True)
class Detection:
    """Contacts that one rank found in one step."""

    share: Share  #: its parts have been searched
    contacts: Contacts | CollidingPairs  #: as rows of the held bodies

    @property
    def held(self) -> Held:
        return self.share.held

    @cached_property
    def pairs(self) -> Tensor:
        """(P, 2) int64: the PCS as rows of the held bodies, the one with the smaller id first."""
        return torch.cat([part.in_step(_pairs_of(part)) for part in self.share.parts])

    def places(self, position: Tensor) -> Places:
        """The positions of the work, given the positions (N, 3) of the rank's own bodies."""
        parts = self.share.parts
        lower = [ops.swept_boxes(*centres_of(part.bodies), *self.share.kept)[0] for part in parts]
        of_pairs = [_corners(corner, _pairs_of(part)) for part, corner in zip(parts, lower, strict=True)]
        of_contacts = [_corners(at, part.find().pairs) for part, at in zip(parts, lower, strict=True)]
        return Places(position, torch.cat(of_pairs), torch.cat(of_contacts))


def _pairs_of(part: Part) -> Tensor:
    return part.pairs[: part.find().stats.pcs]


def _corners(lower: Tensor, pairs: Tensor) -> Tensor:
    return torch.maximum(lower[pairs[:, 0]], lower[pairs[:, 1]])


def detect_distributed(
    decomposition: Decomposition,
    own: Columns,
    build: Build,
    options: Options,
    clock: StageClock,
    estimates: PartEstimates | None = None,
    capacity: HaloCapacity | None = None,
    vertices: Vertices | None = None,
) -> Detection:
    """Finds the contacts of this rank's share of pairs; every pair is in the share of exactly one rank.

    Arguments as for `OwnSearch`.
    """
    asked = decomposition, own, build, options, clock
    search = OwnSearch(*asked, estimates or PartEstimates(), capacity, vertices)
    share = search.start().with_ghosts()
    found = contacts_of_step(share.parts)
    clock.add(search_seconds(found.stats))
    if options.report == "earliest" and isinstance(found, Contacts):
        found = found.earliest(*share.held.id[found.pairs].unbind(dim=1))
    return Detection(share, replace(found, stats=replace(found.stats, bodies=len(share.held))))
