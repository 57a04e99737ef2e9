"""Rows arrive at their destinations, complete and in order, for any dtype; with both ways of sending."""

from __future__ import annotations

from random import Random

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.ranks import World

from pgccd.distributed import Cells, Comm
from pgccd.distributed.comm.exchange import Columns, make_route, pack, replace_rows, unpack
from pgccd.distributed.comm.torch_comm import TorchComm
from pgccd.distributed.halo.migrate import IdChecksum, migrate
from pgccd.distributed.partition.decomposition import Decomposition


def columns_of(rank: int, count: int) -> Columns:
    generator = torch.Generator().manual_seed(rank)
    return {
        "id": 1000 * rank + torch.arange(count),
        "flag": torch.rand(count, generator=generator) < 0.5,
        "pair": torch.randint(99, (count, 2), generator=generator, dtype=torch.int32),
        "byte": torch.randint(99, (count, 3), generator=generator).to(torch.uint8),
        "matrix": torch.rand((count, 2, 2), generator=generator, dtype=torch.float64),
        "nothing": torch.empty((count, 0)),
    }


def test_packing_is_lossless() -> None:
    for count in (0, 1, 17):
        columns = columns_of(3, count)
        rows = torch.arange(count).flip(0)
        whole = unpack(pack(columns, rows), columns)
        for name, column in columns.items():
            assert whole[name].dtype == column.dtype and torch.equal(whole[name], column[rows])


@given(st.sets(st.integers(0, 60)), st.randoms(use_true_random=False))
def test_replacing_rows_is_sorting(ids: set[int], random: Random) -> None:
    former = sorted(random.sample(sorted(ids), random.randint(0, len(ids))))
    added = random.sample(sorted(ids - set(former)), random.randint(0, len(ids) - len(former)))
    removed = sorted(random.sample(range(len(former)), random.randint(0, len(former))))
    parts = [{"id": torch.tensor(rows, dtype=torch.int64), "x": 0.5 * torch.tensor(rows)} for rows in (former, added)]
    packed = pack(parts[1], torch.arange(len(added)))
    changed = replace_rows(parts[0], torch.tensor(removed, dtype=torch.int64), packed)
    assert changed["id"].tolist() == sorted(set(former) - {former[row] for row in removed} | set(added))
    assert torch.equal(changed["x"], 0.5 * changed["id"])


def send_about(comm: Comm, neighbours_above: int, device: str = "cpu") -> None:
    comm.neighbours_above = neighbours_above
    for seed in range(4):
        # Every rank can compute the rows that every other rank sends: none, some to itself, or some twice.
        def plan(rank: int, seed: int = seed) -> tuple[torch.Tensor, torch.Tensor]:
            generator = torch.Generator().manual_seed(100 * seed + rank)
            count = 0 if (rank + seed) % 3 == 0 else 20
            rows = torch.randint(9, (count,), generator=generator)
            return rows, torch.randint(comm.size, (count,), generator=generator)

        rows, destination = plan(comm.rank)
        mine = {name: column.to(device) for name, column in columns_of(comm.rank, 9).items()}
        route = make_route(comm, rows.to(device), destination.to(device))
        under_way = route.forward(mine)
        received = under_way.wait()
        expected, source = [], []
        for rank in range(comm.size):
            their_rows, their_destination = plan(rank)
            chosen = their_rows[their_destination == comm.rank]
            expected.append({name: column[chosen] for name, column in columns_of(rank, 9).items()})
            source += [rank] * len(chosen)
        assert route.source.tolist() == source
        for name in mine:
            assert torch.equal(received[name].cpu(), torch.cat([part[name] for part in expected])), name
        # Back again, in the order in which they were sent.
        returned = route.back({"twice": 2 * received["id"]}).wait()["twice"]
        assert torch.equal(returned, 2 * mine["id"][route.rows])


@pytest.mark.parametrize("neighbours_above", [32, 0], ids=["all to all", "neighbours"])
def test_rows_arrive(world: World, neighbours_above: int) -> None:
    world(send_about, neighbours_above)


def hand_over(comm: Comm) -> int:
    """Every rank can compute the rows of each rank."""
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, comm.size, cells=3)
    generator = torch.Generator().manual_seed(8)
    count, total = 300, 0
    position = torch.rand((count, 3), dtype=torch.float64, generator=generator)
    replica_rank = torch.randint(comm.size, (count,), generator=generator)
    for _ in range(3):
        mine = torch.nonzero(replica_rank == comm.rank)[:, 0]
        columns = {
            "mood": mine % 3 == 0,
            "id": 7 * mine - 500,
            "x": position[mine],
            "nothing": torch.empty(len(mine), 0),
        }
        moved = migrate(Decomposition(comm, partition), columns, columns["x"])
        found, arrived = moved.columns, moved.arrived
        owner = partition.owner_of(position)
        kept = torch.nonzero(owner == comm.rank)[:, 0]
        assert list(found) == list(columns)
        assert torch.equal(found["id"], 7 * kept - 500) and torch.equal(found["mood"], kept % 3 == 0)
        assert torch.equal(found["x"], position[kept]) and found["nothing"].shape == (len(kept), 0)
        assert arrived == int(((owner == comm.rank) & (replica_rank != comm.rank)).sum())
        total += arrived
        replica_rank = owner
        position = torch.rand((count, 3), dtype=torch.float64, generator=generator) ** 2
    return total


def test_bodies_change_hands_with_all_they_have(world: World) -> None:
    arrived = world(hand_over)
    assert (sum(arrived) > 0) == (len(arrived) > 1)


def reduce_values(comm: Comm) -> None:
    big = torch.tensor([2**62 + comm.rank, -comm.rank])
    gathered = comm.all_gather(big)
    assert gathered.tolist() == [[2**62 + rank, -rank] for rank in range(comm.size)]
    # Sums wrap modulo 2^64, as hashes require.
    assert int(comm.sum(big)[0]) % 2**64 == sum(2**62 + rank for rank in range(comm.size)) % 2**64
    assert float(comm.sum(torch.tensor([0.5], dtype=torch.float64))) == 0.5 * comm.size
    assert comm.min(torch.tensor([2**62 + comm.rank, -comm.rank])).tolist() == [2**62, 1 - comm.size]
    least = comm.min(torch.tensor([0.1 / (1 + comm.rank), torch.inf], dtype=torch.float64))
    assert least.dtype == torch.float64 and least.tolist() == [0.1 / comm.size, torch.inf]
    assert comm.any(comm.rank == comm.size - 1) and not comm.any(False)
    of_ranks = [{"rank": rank} for rank in range(comm.size)]
    assert comm.gather_objects({"rank": comm.rank}) == (of_ranks if comm.rank == 0 else [])
    assert comm.broadcast_object(["of", 2**64 - 1, float("inf"), "\u00e9", None, comm.rank])[:5] == [
        *["of", 2**64 - 1, float("inf"), "\u00e9", None]
    ]
    # Values of different lengths, and pages of them.
    words = ["x" * 40_000 * rank for rank in range(comm.size)]
    assert comm.gather_objects(words[comm.rank]) == (words if comm.rank == 0 else [])
    for values in (torch.arange(5, dtype=torch.uint8), torch.rand((3, 2), dtype=torch.float64), torch.ones(0, 7) > 0):
        given = values.clone() if comm.rank == 0 else None
        sent = comm.broadcast(given)
        assert sent.dtype == values.dtype and sent.shape == values.shape
        assert given is None or torch.equal(sent, given)
    assert comm.exchange_counts(10 * comm.rank + torch.arange(comm.size)).tolist() == [
        10 * rank + comm.rank for rank in range(comm.size)
    ]
    rows = torch.stack([torch.arange(comm.size), torch.full((comm.size,), -comm.rank)], dim=1)
    assert comm.exchange_counts(rows).tolist() == [[comm.rank, -rank] for rank in range(comm.size)]
    # Of a rank without neighbours.
    for shape in ((0,), (0, 2)):
        assert comm.exchange_counts(torch.zeros(shape, dtype=torch.int64), []).shape == shape
    comm.barrier()


def test_reductions(world: World) -> None:
    world(reduce_values)


def test_the_census_sees_lost_doubled_and_exchanged_bodies() -> None:
    all_ids = IdChecksum.of(torch.arange(10))
    parts = [IdChecksum.of(torch.tensor([0, 2, 4, 6, 8])), IdChecksum.of(torch.tensor([9, 7, 5, 3, 1]))]
    IdChecksum.total(parts).require(all_ids)
    for wrong in ([0, 2, 4, 6], [0, 2, 4, 6, 8, 8], [0, 2, 4, 6, 6]):
        with pytest.raises(RuntimeError, match="migration: expected 10 bodies"):
            IdChecksum.total([IdChecksum.of(torch.tensor(wrong)), parts[1]]).require(all_ids)


class Graph:
    closed = False

    def close(self) -> None:
        self.closed = True


def test_graphs_of_messages_are_closed_before_the_connection(ranks: World) -> None:
    ranks.run(2, close_graphs)  # type: ignore[attr-defined]


def close_graphs(comm: Comm) -> None:
    assert isinstance(comm, TorchComm)
    kept, freed = Graph(), Graph()
    seen: list[bool] = []
    same = TorchComm(comm._group, on_close=lambda: seen.append(kept.closed))
    same.close_before(kept)
    same.close_before(freed)
    del freed
    same.close()
    assert seen == [True]
