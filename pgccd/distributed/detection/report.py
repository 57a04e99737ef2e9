"""Transfer of contacts from the rank that found them to the owners of their bodies."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.contacts import CollidingPairs, Contacts, earliest_row
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.distributed.comm.exchange import Columns, first_row, make_route, take_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.ids import rows_of
from pgccd.distributed.detection.share import Share

# What `sum_per_body` adds.
_SUMMED = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
# Prefix of payload among the columns of contacts that are sent.
_PAYLOAD = "payload."


def tell_owners(found: Share, payload: Columns | None = None) -> Contacts | CollidingPairs:
    """All contacts of the bodies that this rank owns, in global ids, sorted by id. Both owners of a pair are neighbours
    of the rank that tested it: they sent it ghosts.

    Args:
        found: contacts of the pairs that this rank tested.
        payload: columns of the own bodies (N, ...) that contacts carry; those of ghosts have been sent with them.
    """
    columns = columns_for_owners(found, found.contacts.columns | _payload_of_pairs(found, payload))
    return _contacts_of(found, columns, _is_of_rank=found.held.route.neighbours.comm.size > 1)


def columns_for_owners(found: Share, columns: Columns) -> Columns:
    """Columns (K, ...) of the contacts of the bodies that this rank owns, as `tell_owners` returns contacts.

    Args:
        found: contacts of the pairs that this rank tested.
        columns: of these; "pairs" as rows of the held bodies.
    """
    owner = found.held.owner[columns["pairs"]]
    columns = columns | {"pairs": found.held.id[columns["pairs"]]}
    everything = torch.arange(len(owner), device=owner.device)
    second = everything[owner[:, 0] != owner[:, 1]]
    rows, destination = torch.cat([everything, second]), torch.cat([owner[:, 0], owner[second, 1]])
    received = make_route(found.held.route.neighbours, rows, destination).forward(columns).wait()
    return take_rows(received, _canonical_order(received["pairs"]))


def earliest_for_all(comm: Comm, found: Share, ids: int | None = None, payload: Columns | None = None) -> Contacts:
    """The first contact of the scene, on every rank; ties are broken by the smallest pair.

    Args:
        comm: between the ranks.
        found: contacts of the pairs that this rank tested, at least the earliest one.
        ids: for a trajectory, the number of ids per segment, see `segments`; earlier segments come first.
        payload: as for `tell_owners`.
    """
    columns = _in_global_ids(found) | _payload_of_pairs(found, payload)
    i, j = columns["pairs"].unbind(dim=1)
    segment = torch.zeros_like(i) if ids is None else torch.div(i, ids, rounding_mode="floor")
    row = earliest_row(segment, columns["toi"], i, j)
    columns = {name: column[row] for name, column in columns.items()}
    # Floats >= 0 have the same order as their bits.
    order = torch.stack([segment[row], columns["toi"].view(torch.int64), i[row], j[row]], dim=1)
    earliest = _contacts_of(found, first_row(comm, order, columns), _is_earliest=True)
    assert isinstance(earliest, Contacts)
    return earliest


def _in_global_ids(found: Share) -> Columns:
    return found.contacts.columns | {"pairs": found.held.id[found.contacts.pairs]}


def _payload_of_pairs(found: Share, payload: Columns | None) -> Columns:
    """The payload of both bodies of each contact, (K, 2, ...), by names that differ from those of contacts."""
    if not payload:
        return {}
    pairs, of_ghosts = found.contacts.pairs, [found.held.ghosts[name] for name in payload]
    of_bodies = ops.take_rows(list(payload.values()), of_ghosts, pairs.reshape(-1))
    return {
        _PAYLOAD + name.removeprefix("."): column.view(len(pairs), 2, *column.shape[1:])
        for name, column in zip(payload, of_bodies, strict=True)
    }


def _contacts_of(found: Share, columns: Columns, **flags: Any) -> Contacts | CollidingPairs:
    """Contacts of their columns and those of `_payload_of_pairs`."""
    of_contacts: dict[str, Any] = {name: column for name, column in columns.items() if not name.startswith(_PAYLOAD)}
    payload = {name.removeprefix(_PAYLOAD): columns[name] for name in columns if name.startswith(_PAYLOAD)}
    return type(found.contacts)(**of_contacts, **flags, stats=found.contacts.stats, payload=payload)


def _canonical_order(pairs: Tensor) -> Tensor:
    """Ordered by first id, then second; contacts of one pair come from one rank, in order."""
    by_second = torch.argsort(pairs[:, 1], stable=True)
    return by_second[torch.argsort(pairs[by_second, 0], stable=True)]


def first_toi_of(id: Tensor, hits: Contacts) -> Tensor:
    """(N,) float64: the first toi of bodies, or the first `time` of a trajectory; inf without a contact.

    Args:
        id: (N,) int64 global ids, ascending.
        hits: with `pairs` in global ids.

    Raises:
        TypeError: `hits` are not contacts.
    """
    if not isinstance(hits, Contacts):
        raise TypeError(f"hits: expected pgccd.Contacts, got {arguments.describe(hits)}")
    first = torch.full((len(id),), torch.inf, dtype=torch.float64, device=id.device)
    time = hits.time if isinstance(hits, TrajectoryContacts) else hits.toi
    row, toi = rows_of(id, hits.pairs.reshape(-1)), time.repeat_interleave(2)
    own = row >= 0
    first = first.scatter_reduce(0, row[own], toi[own], "amin")
    # Others may have contacts as early as the earliest one of the scene, but no earlier ones.
    return first.clamp(max=time.amin()) if hits._is_earliest and len(time) else first


def sum_per_body(id: Tensor, hits: Contacts | CollidingPairs, values: Tensor) -> Tensor:
    """(N, ...): for each body, the sum of its values over its contacts, in their order; 0 without a contact.

    Args:
        id: (N,) int64 global ids, ascending.
        hits: with `pairs` in global ids.
        values: (K, 2, ...) floating-point numbers of 16 bits or more: of i and of j.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    if not isinstance(hits, (Contacts, CollidingPairs)):
        raise TypeError(f"hits: expected pgccd.Contacts, got {arguments.describe(hits)}")
    if not isinstance(values, Tensor) or values.layout != torch.strided or values.dtype not in _SUMMED:
        raise TypeError(f"values: expected a tensor of floating-point numbers, got {arguments.describe(values)}")
    if values.shape[:2] != (len(hits), 2) or values.device != id.device:
        expected = f"({len(hits)}, 2, ...) on {id.device}"
        raise ValueError(f"values: expected {expected}, got {tuple(values.shape)} on {values.device}")
    row = rows_of(id, hits.pairs.reshape(-1))
    order = torch.argsort(row, stable=True)
    order = order[int((row < 0).sum()) :]  # the others are of bodies of other ranks
    count = torch.zeros_like(id).scatter_add_(0, row[order], torch.ones_like(order))
    mine = values.reshape(len(row), math.prod(values.shape[2:]))[order]
    # Each sum is made term by term: `index_add_` would add in any order on a GPU.
    total = torch.segment_reduce(mine, "sum", lengths=count, axis=0, unsafe=True, initial=0.0)
    return total.view(len(id), *values.shape[2:])
