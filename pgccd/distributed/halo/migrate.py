"""Migration: a body whose position is in a cell of another rank moves to that rank, with all its columns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.exchange import Columns, Route, replace_rows, unpack
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.halo.vertices import Vertices
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.attempts import TooSmall, until_it_fits
from pgccd.runtime.hashing import row_hash

# Ids generated at a time.
_BLOCK = 1 << 22


def leaving_and_invalid(decomposition: Decomposition, position: Tensor, id: Tensor) -> Tensor:
    """(2,) int64 on the device: numbers of bodies that would leave this rank, and of bodies with an invalid position.

    Args:
        decomposition: of space.
        position: (N, 3) of the bodies' origins.
        id: (N,) int64, negative for padding.
    """
    return ops.leaving_and_invalid(position, id, *decomposition.subdomain)


def migrate(
    decomposition: Decomposition, columns: Columns, position: Tensor, vertices: Vertices | None = None
) -> Moved:
    """Sends every body to the owner of the cell that contains its position.

    Counts are exchanged with neighbours only; or with all ranks, if a body of any rank moves further (at the start, or
    when the partition has changed).

    Args:
        decomposition: of space.
        columns: of this rank's bodies, including "id" (N,) int64, ascending. Any dtypes and widths, equal on all ranks.
        position: (N, 3) of the bodies' origins.
        vertices: of the bodies; requires a column "vertex_count" (N,) int64.

    Example:
        >>> moved = migrate(decomposition, {"id": id, "position": x, "mood": mood}, x)
    """
    if decomposition.comm.size == 1:
        return Moved(columns, 0, vertices)

    def attempt(among: Decomposition) -> tuple[Tensor, Route] | TooSmall[Decomposition]:
        rows, by_destination, counts = ops.leaving_bodies(position, *among.subdomain, among.neighbours.size)
        if among.is_beyond(counts):
            return TooSmall(among.of_all_ranks())
        sent, received = among.neighbours.agree(counts)
        leaving = sum(sent)
        return rows[:leaving], Route(among.neighbours, by_destination[:leaving], sent, received)

    rows, route = until_it_fits(attempt, decomposition)
    id_first = {"id": columns["id"], **columns}  # rows are merged by the first column
    packed = route.send(id_first).wait()
    changed = replace_rows(id_first, rows, packed)
    if vertices is not None:
        arrived = unpack(packed, id_first)
        vertices = _with_bodies(vertices, columns["id"], rows, route, arrived)
    return Moved({name: changed[name] for name in columns}, sum(route.received), vertices)


@dataclass(frozen=True)
class Moved:
    """The own bodies after a migration."""

    columns: Columns  #: by ascending id
    arrived: int  #: number of bodies from other ranks
    vertices: Vertices | None


def _with_bodies(vertices: Vertices, id: Tensor, removed: Tensor, route: Route, arrived: Columns) -> Vertices:
    """The vertices of the remaining and arrived bodies, by ascending id."""
    both = Vertices.join(vertices, vertices.send(route, arrived["vertex_count"]))
    stays = torch.ones(len(id), dtype=torch.bool, device=id.device)
    stays[removed] = False
    came = torch.arange(len(arrived["id"]), device=id.device) + len(id)
    bodies = torch.cat([torch.nonzero(stays)[:, 0], came])
    return both.take(bodies[torch.argsort(torch.cat([id, arrived["id"]])[bodies])])


def id_range(comm: Comm, count: int) -> tuple[int, int]:
    """This rank's equal share [first, end) of the ids 0 to count - 1."""
    return comm.rank * count // comm.size, (comm.rank + 1) * count // comm.size


@dataclass(frozen=True)
class IdChecksum:
    """Number of bodies and an order-independent hash of their ids, which migration must preserve."""

    count: int
    ids: int  #: modulo 2^64

    @classmethod
    def of(cls, id: Tensor) -> IdChecksum:
        """The checksum of one rank's bodies (N,) int64."""
        return cls(len(id), row_hash([id]))

    @classmethod
    def of_range(cls, comm: Comm, count: int) -> IdChecksum:
        """The checksum of the ids 0 to count - 1, computed by all ranks."""
        first, end = id_range(comm, count)
        begins = range(first, end, _BLOCK)
        return cls.total([cls.of(torch.arange(begin, min(end, begin + _BLOCK))) for begin in begins])._of_all(comm)

    @classmethod
    def of_ranks(cls, comm: Comm, id: Tensor) -> IdChecksum:
        """The checksum of all ranks' bodies, of which this rank has `id` (N,) int64."""
        return cls.of(id)._of_all(comm)

    def _of_all(self, comm: Comm) -> IdChecksum:
        """The sum of this checksum over the ranks."""
        signed = self.ids - 2**64 if self.ids >= 2**63 else self.ids
        count, ids = comm.sum(torch.tensor([self.count, signed])).tolist()  # modulo 2^64
        return IdChecksum(count, ids % 2**64)

    @classmethod
    def total(cls, parts: list[IdChecksum]) -> IdChecksum:
        """The sum of several parts."""
        return cls(sum(part.count for part in parts), sum(part.ids for part in parts) % 2**64)

    def require(self, expected: IdChecksum) -> None:
        """Raises RuntimeError unless this checksum equals the expected one, with no body lost or duplicated."""
        if self != expected:
            raise RuntimeError(
                f"migration: expected {expected.count} bodies with id hash {expected.ids:016x}, "
                f"there are {self.count} with {self.ids:016x}"
            )
