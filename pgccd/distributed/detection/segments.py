"""Trajectories on many ranks: one step with a copy of each body per segment, in separate worlds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.contacts.trajectories import TrajectoryContacts, time_along
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.report import earliest_for_all, tell_owners
from pgccd.distributed.detection.share import Share
from pgccd.distributed.guard import of_all_ranks
from pgccd.search import narrow

_MOST_WORLDS, _MOST_IDS = 2**31, 2**62


@dataclass(frozen=True)
class Segments:
    """Numbering of the copies in all segments, the same on all ranks."""

    count: int  #: number of segments
    ids: int  #: ids per segment: body `id` of segment k has the id k * ids + id
    worlds: int  #: worlds per segment

    @classmethod
    def agreed(cls, comm: Comm, count: int, own: Columns) -> Segments:
        """Agrees with the other ranks on the numbering.

        Args:
            comm: between the ranks.
            count: number of segments, the same on all ranks.
            own: columns of this rank's bodies.

        Raises:
            ValueError: there are too many; on all ranks.
        """
        world = own.get("world", own["id"][:0])
        most = [int(column.max()) if len(column) else 0 for column in (own["id"], world)]
        of_ranks = comm.all_gather(torch.tensor(most))
        ids, worlds = (1 + largest for largest in of_ranks.amax(dim=0).tolist())
        if count * ids >= _MOST_IDS or count * worlds >= _MOST_WORLDS:
            limits = f"ids up to {ids - 1} and worlds up to {worlds - 1}"
            raise of_all_ranks(ValueError(f"motion: {count} segments are too many for {limits}"))
        return cls(count, ids, worlds)

    def repeat(self, own: Columns) -> Columns:
        """The columns of the bodies of all segments, concatenated."""
        bodies, device = len(own["id"]), own["id"].device
        columns = self.repeat_rows(own)
        segment = torch.arange(self.count, device=device).repeat_interleave(bodies)
        columns["id"] = columns["id"] + self.ids * segment
        world = columns.get("world", torch.zeros(len(segment), dtype=torch.int32, device=device))
        columns["world"] = world + (self.worlds * segment).to(torch.int32)
        return columns

    def repeat_rows(self, columns: Columns) -> Columns:
        """Columns (N, ...) of bodies, for the bodies of all segments."""
        return {name: torch.cat([column] * self.count) for name, column in columns.items()}

    def contacts_for_owners(
        self, comm: Comm, found: Share, report: narrow.Report, payload: Columns
    ) -> TrajectoryContacts:
        """The contacts of the bodies that this rank owns, as `pgccd.detect` returns them for a trajectory.

        Args:
            comm: between the ranks.
            found: contacts of the bodies of all segments by `report`; for "earliest", the first contacts.
            report: as for `pgccd.detect`.
            payload: columns of the bodies of all segments that contacts carry.
        """
        if report == "earliest":
            return self._along(earliest_for_all(comm, found, self.ids, payload))
        contacts = tell_owners(found, payload)
        assert isinstance(contacts, Contacts)
        along = self._along(contacts)
        return along if report == "all" else along[_first_of_pairs(along.pairs)]

    def pairs_for_owners(self, found: Share, payload: Columns) -> CollidingPairs:
        """The colliding pairs of the bodies that this rank owns, as `pgccd.collide` returns them for a trajectory.

        Args:
            found: colliding pairs of the bodies of all segments.
            payload: as for `contacts_for_owners`.
        """
        pairs = tell_owners(found, payload)
        assert isinstance(pairs, CollidingPairs)
        pairs = replace(pairs, pairs=self._in_segments(pairs.pairs)[1])
        return pairs[_first_of_pairs(pairs.pairs)]

    def _along(self, contacts: Contacts) -> TrajectoryContacts:
        """From contacts of the bodies of all segments."""
        segment, pairs = self._in_segments(contacts.pairs)
        columns: dict[str, Any] = contacts.columns | {"pairs": pairs, "segment": segment}
        return TrajectoryContacts(
            **columns,
            time=time_along(segment, contacts.toi, self.count),
            stats=contacts.stats,
            payload=contacts.payload,
            _is_of_rank=contacts._is_of_rank,
            _is_earliest=contacts._is_earliest,
        )

    def _in_segments(self, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """The segments (K,) of pairs (K, 2) of the bodies of all segments, and the pairs of ids (K, 2)."""
        segment = torch.div(pairs[:, 0], self.ids, rounding_mode="floor")
        return segment, pairs - self.ids * segment[:, None]


def _first_of_pairs(pairs: Tensor) -> Tensor:
    """The first row of each pair of `pairs` (K, 2), in the order of the pairs."""
    # Stable: the first segment of each pair comes first.
    by_second = torch.argsort(pairs[:, 1], stable=True)
    order = by_second[torch.argsort(pairs[by_second, 0], stable=True)]
    pairs = pairs[order]
    is_first = torch.ones(len(pairs), dtype=torch.bool, device=pairs.device)
    is_first[1:] = (pairs[1:] != pairs[:-1]).any(dim=1)
    return order[is_first]
