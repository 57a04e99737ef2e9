"""Random sequences of all that a `World` can do, compared after each with a table of the bodies in one process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pgccd
from pgccd.distributed import BalanceOptions, Bisection, Comm, World, WorldOptions
from support.ranks import to_all
from support.reports import detected, of_contacts, stepped
from support.shapes import tetrahedron

Columns = dict[str, Tensor]
# Of the machine, from one run to the next.
_KEPT = ("deforming", "options", "partition", "cells", "next_id", "table", "steps_made", "exclude")
SIDE = 4.0
DEFAULTS: dict[str, tuple[Any, torch.dtype]] = {
    "group": (-1, torch.int64),
    "mask": (-1, torch.int64),
    "world": (0, torch.int32),
    "static": (0, torch.bool),
    "margin": (0.0, torch.float64),
    "self_collision": (False, torch.bool),
}
MESHES = [
    pgccd.Mesh.box([1.0, 0.6, 0.3]),
    tetrahedron(0.5),
    pgccd.Mesh.box([0.25, 0.25, 0.25]),
]


def same_bits(found: Tensor, expected: Tensor) -> bool:
    """Whether columns of any dtype are equal, NaN and the signs of zeros included."""
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if not found.numel():
        return True
    one, other = (column.contiguous().view(-1).view(torch.uint8) for column in (found, expected))
    return torch.equal(one, other)


class Machine:
    """A world and the table that it should have; the same random choices on all ranks."""

    def __init__(self, comm: Comm, seed: int, folder: str | None = None, resume: dict[str, Any] | None = None) -> None:
        self.comm, self.seed = comm, seed
        self.rng, self.excluding = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        rng = self.rng
        if resume is None:
            self.deforming = bool(rng.integers(3) == 0)
            self.options: dict[str, Any] = {
                "report": str(rng.choice(["first", "first", "all", "any", "earliest"])),
                "min_separation": float(rng.choice([0.0, 0.05])),
                "nonzero_toi": bool(rng.integers(2)),
                "initial": str(rng.choice(["report", "assume_free"])),
                "path": "rigid" if self.deforming else str(rng.choice(["rigid", "linear"])),
            }
            self.partition = str(rng.choice(["cells", "bisection", "auto"]))
            self.cells = int(rng.integers(1, 5))
            self.next_id = self.steps_made = 0
            count = int(rng.choice([0, 1, 2, 12, 24]))
            self.table = self.new(count, self.optional())
            ids = self.new_ids(count) if rng.integers(2) else None
            self.exclude = torch.zeros((0, 2), dtype=torch.int64)
            self.world = self.create(ids)
        else:
            assert folder is not None
            for name in _KEPT:
                setattr(self, name, resume[name])
            self.world = World.load(folder, MESHES, comm=comm, options=self.of_world())
        self.counts = dict.fromkeys(("contacts", "stopped", "rounds", "touching", "unresolved", "excluded"), 0)
        self.check()

    def state(self) -> dict[str, Any]:
        """What a later machine goes on from, besides the checkpoint."""
        return {name: getattr(self, name) for name in _KEPT}

    def of_world(self, **more: Any) -> WorldOptions:
        """The options of the world."""
        options = self.options | {"report": of_contacts(self.options["report"])}
        return WorldOptions(balance=self.balance(), **options, **more)

    def balance(self) -> BalanceOptions:
        if self.rng.integers(3) == 0:
            return BalanceOptions("none")
        given = {"start": 0.0, "goal": 0.0, "moving": 0.0, "deciding": 0.0}
        return BalanceOptions("cost" if self.rng.integers(2) else "measured", **given)

    # --- bodies
    def optional(self) -> list[str]:
        return [name for name in DEFAULTS if self.rng.integers(4) == 0 and (name != "self_collision" or self.deforming)]

    def places(self, count: int) -> Tensor:
        rng = self.rng
        x = rng.uniform(0.0, SIDE, (count, 3))
        kind = rng.integers(10)
        if kind < 4:  # on planes between ranks
            x = 0.5 * np.round(2.0 * x)
        if kind == 9 and count:
            x[rng.integers(count)] = rng.choice([-1e6, 1e9, 1e15, 50.0], 3)
        return torch.tensor(x).reshape(count, 3)

    def new(self, count: int, optional: list[str]) -> Columns:
        """Columns of new bodies, of ids to be given."""
        rng = self.rng

        def normal(*shape: int) -> Tensor:
            return torch.tensor(rng.normal(size=(count, *shape)))

        columns: Columns = {"id": torch.zeros(count, dtype=torch.int64), "position": self.places(count)}
        columns["mesh_index"] = torch.tensor(rng.integers(3, size=count), dtype=torch.int32)
        columns["group"] = torch.tensor(rng.integers(1, 4, size=count))
        columns["mask"] = torch.tensor(rng.integers(1, 4, size=count))
        columns["world"] = torch.tensor(rng.integers(2, size=count), dtype=torch.int32)
        columns["static"] = torch.tensor(rng.uniform(size=count) < 0.25)
        columns["margin"] = torch.tensor(rng.choice([0.0, 0.05], count))
        columns["self_collision"] = torch.tensor(rng.uniform(size=count) < 0.5)
        for name, (value, dtype) in DEFAULTS.items():
            if name not in optional:
                columns[name] = torch.full((count,), value, dtype=dtype)
        q = torch.tensor(rng.normal(size=(count, 4))) + torch.tensor([1e-3, 0, 0, 0], dtype=torch.float64)
        columns[".q"] = torch.nn.functional.normalize(q, dim=1)
        if rng.integers(3) == 0:
            columns[".q"] = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1)
        columns[".v"], columns[".w"] = normal(3), normal(3)
        columns[".flag"], columns[".small"] = normal()[:] > 0, (10 * normal()).to(torch.int8)
        columns[".none"], columns[".deep"] = normal(0).float(), normal(2, 2).bfloat16()
        nan = normal(3)
        nan[nan > 0.5] = torch.nan
        nan[nan < -0.5] = -0.0
        columns[".nan"] = nan
        columns[".mass"] = (1.0 + normal().abs()).half()
        columns[".c"] = torch.complex(normal().float(), normal().float())
        columns["fixed"] = torch.tensor(rng.uniform(size=count) < 0.2)
        self.given = optional
        return columns

    def vertex_count(self, columns: Columns) -> Tensor:
        return torch.tensor([len(m.vertices) for m in MESHES])[columns["mesh_index"].long()]

    def vertices(self, columns: Columns) -> Columns:
        """Of the bodies: their vertices, wherever their ids put them, and noise."""
        parts, noise = [], []
        for k in range(len(columns["id"])):
            mesh = MESHES[int(columns["mesh_index"][k])].vertices
            parts.append(mesh + columns["position"][k] + 0.05 * columns[".v"][k])
            numbers = (torch.arange(len(mesh)) * int(columns[".small"][k])).to(torch.bfloat16)
            noise.append(numbers[:, None].expand(-1, 2))
        x = torch.cat(parts) if parts else torch.zeros((0, 3), dtype=torch.float64)
        n = torch.cat(noise) if noise else torch.zeros((0, 2), dtype=torch.bfloat16)
        return {"x": x, "noise": n.contiguous()}

    def new_ids(self, count: int) -> Tensor:
        rng = self.rng
        # A trajectory of three segments takes ids below 2^62 / 3.
        jump = int(rng.choice([0, 0, 3, 1000, 2**33])) if rng.integers(20) else max(0, 2**60 - self.next_id)
        gaps = np.cumsum(rng.integers(1, 5, size=count)) - 1
        return torch.tensor(self.next_id + jump + gaps, dtype=torch.int64).reshape(count)

    def shares(self, count: int) -> Tensor:
        """The rank that passes each of new bodies."""
        if self.rng.integers(3) == 0:
            return torch.full((count,), int(self.rng.integers(self.comm.size)), dtype=torch.int64)
        return torch.tensor(self.rng.integers(self.comm.size, size=count), dtype=torch.int64)

    def arguments(self, columns: Columns, rows: Tensor, ids: Tensor | None) -> dict[str, Any]:
        mine = {name: column[rows] for name, column in columns.items()}
        filters: dict[str, Any] = {name: mine[name] for name in self.given}
        given: dict[str, Any] = {"scene": pgccd.Scene(MESHES, mine["mesh_index"], **filters)}
        given["position"] = mine["position"]
        given["payload"] = {name[1:]: column for name, column in mine.items() if name.startswith(".")}
        given["payload"]["fixed"] = mine["fixed"]
        if self.deforming:
            given["vertex_payload"] = self.vertices(mine)
        if ids is not None:
            given["id"] = ids[rows]
        return given

    def more_excluded(self, ids: Tensor) -> Tensor | None:
        """Pairs of bodies of these ids that are never tested from now on; this rank's share of them, or None."""
        rng = self.excluding
        share = rng.choice([0.0, 0.0, 0.0, 0.05, 0.4])
        pairs = torch.combinations(ids[torch.tensor(rng.permutation(len(ids)), dtype=torch.int64)])
        pairs = pairs[torch.tensor(rng.uniform(size=len(pairs)) < share)]
        owner = torch.tensor(rng.integers(self.comm.size, size=len(pairs)))
        self.exclude = torch.cat([self.exclude, pairs.sort(dim=1).values]).unique(dim=0)
        mine = pairs[owner == self.comm.rank]
        with_none = bool(rng.integers(2))
        return mine if len(mine) or with_none else None

    def passed(self, count: int, ids: Tensor | None) -> tuple[Tensor, Tensor]:
        """This rank's rows of new bodies; and the ids of all."""
        share = self.shares(count)
        if ids is not None:
            mine = torch.nonzero(share == self.comm.rank)[:, 0]
            return mine[torch.tensor(self.rng.permutation(count)).argsort()[mine].argsort()], ids
        order = torch.argsort(share, stable=True)
        ids = torch.empty(count, dtype=torch.int64)
        ids[order] = self.next_id + torch.arange(count)
        return torch.nonzero(share == self.comm.rank)[:, 0], ids

    def create(self, ids: Tensor | None) -> Any:
        mine, given = self.passed(len(self.table["id"]), ids)
        arguments = self.arguments(self.table, mine, ids)
        cells = {"cells": self.cells} if self.partition == "cells" else {}
        options = self.of_world(partition=self.partition, **cells)
        options = replace(options, overlap=bool(self.rng.integers(2)))
        exclude = self.more_excluded(given)
        world = World.create(
            **arguments, lower=(0.0,) * 3, upper=(SIDE,) * 3, exclude=exclude, comm=self.comm, options=options
        )
        self.table["id"] = given
        self.sort()
        self.next_id = int(given.max()) + 1 if len(given) else 0
        return world

    def sort(self) -> None:
        order = self.table["id"].argsort()
        self.table = {name: column[order] for name, column in self.table.items()}

    def add(self) -> str:
        count = int(self.rng.choice([0, 1, 3, 10]))
        columns = self.new(count, self.optional())
        ids = self.new_ids(count) if self.rng.integers(2) else None
        if ids is not None and count and self.rng.integers(2):
            columns["position"][:] = columns["position"][:1]  # all at one place
        mine, given = self.passed(count, ids)
        exclude = self.more_excluded(torch.cat([self.table["id"], given]))
        got = self.world.add(**self.arguments(columns, mine, ids), exclude=exclude)
        assert got.equal(given[mine]), (got, given[mine])
        columns["id"] = given
        self.table = {name: torch.cat([column, columns[name]]) for name, column in self.table.items()}
        self.sort()
        self.next_id = max(self.next_id, int(given.max()) + 1 if count else 0)
        return f"add {count}"

    def remove(self) -> str:
        rng, id = self.rng, self.table["id"]
        share = rng.choice([0.0, 0.1, 0.5, 1.0], p=[0.1, 0.6, 0.25, 0.05])
        gone = torch.tensor(rng.uniform(size=len(id)) < share)
        asks = torch.tensor(rng.integers(self.comm.size, size=(2, len(id))))
        mine = id[gone & (asks == self.comm.rank).any(dim=0)]
        self.world.remove(torch.cat([mine, mine[:1]]))
        self.table = {name: column[~gone] for name, column in self.table.items()}
        self.exclude = self.exclude[~torch.isin(self.exclude, id[gone]).any(dim=1)]
        return f"remove {int(gone.sum())}"

    # --- checks
    def rows(self) -> Tensor:
        return torch.searchsorted(self.table["id"], self.world.id)

    def vertex_rows(self, rows: Tensor) -> Tensor:
        count = self.vertex_count(self.table)
        begin = count.cumsum(0) - count
        return torch.cat([rows[:0], *(begin[row] + torch.arange(int(count[row])) for row in rows.tolist())])

    def check(self) -> None:
        world, table = self.world, self.table
        id = world.id
        assert torch.isin(id, table["id"]).all() and (id[1:] > id[:-1]).all()
        everyone = sorted(sum(to_all(self.comm, id.tolist()), []))
        assert everyone == table["id"].tolist(), (everyone, table["id"].tolist())
        assert world.next_id == self.next_id, (world.next_id, self.next_id)
        assert (world.partition.owner_of(world.position) == self.comm.rank).all()
        assert world.steps_made == self.steps_made
        excluded = self.exclude[:0] if world.exclude is None else world.exclude
        assert same_bits(excluded, self.exclude), (excluded, self.exclude)
        rows = self.rows()
        assert same_bits(world.position, table["position"][rows])
        for name, column in world.payload.items():
            assert same_bits(column, table["fixed" if name == "fixed" else "." + name][rows]), name
        for name in DEFAULTS:
            if name in world.columns:
                expected = table[name][rows]
                if name == "self_collision" and "static" in world.columns:
                    expected = expected & ~table["static"][rows]
                assert same_bits(world.columns[name].double(), expected.double()), name
        asked = torch.cat([table["id"], torch.tensor([-1, 2**63 - 1])])
        expected = torch.full((len(asked),), -1, dtype=torch.int64)
        expected[torch.searchsorted(table["id"], id)] = torch.arange(len(id))
        assert world.rows_of(asked).equal(expected)
        if self.deforming:
            mine = {name: column[rows] for name, column in table.items()}
            for name, column in self.vertices(mine).items():
                assert same_bits(world.vertex_payload[name], column), name

    def scene(self) -> pgccd.Scene:
        table = self.table
        filters = {name: table[name] for name in DEFAULTS}
        filters["exclude"] = torch.searchsorted(table["id"], self.exclude)
        filters["margin"] = table["margin"]
        if not self.deforming:
            filters.pop("self_collision")
        return pgccd.Scene(MESHES, table["mesh_index"], **filters)

    def motion(self, trajectory: bool) -> tuple[Any, Any]:
        """Of all, and of this rank's own bodies."""
        table, rng, rows = self.table, self.rng, self.rows()
        speed, segments = float(rng.choice([0.0, 0.1, 1.0, 5.0])), int(rng.integers(1, 4))
        count = len(table["id"])
        v, w = speed * table[".v"], float(rng.choice([0.0, 0.3, 3.0])) * table[".w"]
        still = table["static"]
        v, w = v.masked_fill(still[:, None], 0.0), w.masked_fill(still[:, None], 0.0)
        if self.deforming:
            of_vertices = self.vertex_count(table)
            x = self.vertices(table)["x"]
            step = v.repeat_interleave(of_vertices, dim=0)
            noise = torch.tensor(0.1 * rng.normal(size=(segments, len(x), 3)))
            noise[:, still.repeat_interleave(of_vertices)] = 0.0
            frames = [x]
            for k in range(segments):
                frames.append(frames[-1] + step + noise[k])
            own = self.vertex_rows(rows)
            if trajectory:
                whole = torch.stack(frames)
                thick = self.thickness(segments)
                of_own = None if thick is None else thick[:, rows]
                return pgccd.Trajectory(whole, margin=thick), pgccd.Trajectory(whole[:, own], margin=of_own)
            return pgccd.VertexMotion(*frames[:2]), pgccd.VertexMotion(*(f[own] for f in frames[:2]))
        path = self.options["path"]
        thick = self.thickness(segments)

        def of(some: Tensor) -> Any:
            x, q = table["position"][some], table[".q"][some]
            if not trajectory:
                return pgccd.RigidMotion.from_velocity(x, q, v[some], w[some], 1.0, path)
            rates = (rate[some].expand(segments, -1, -1) for rate in (v, w))
            return pgccd.Trajectory.from_velocity(
                x, q, *rates, 1.0, path, margin=None if thick is None else thick[:, some]
            )

        return of(torch.arange(count)), of(rows)

    def thickness(self, segments: int) -> Tensor | None:
        count = len(self.table["id"])
        return torch.tensor(self.rng.choice([0.0, 0.03], (segments, count))) if self.rng.integers(2) else None

    def names(self) -> list[str]:
        every = ["position", "q", "v", "flag", "small", "none", "deep", "nan", "mass", "c"]
        return [name for name in every if self.rng.integers(3) == 0]

    def same_contacts(self, hits: Any, whole: Any, names: list[str], earliest: bool) -> None:
        id, own = self.table["id"], self.world.id
        pairs = id[whole.pairs]
        concerns = torch.isin(pairs, own).any(dim=1) | earliest
        assert hits.columns.keys() == whole.columns.keys()
        for name, column in whole.columns.items():
            column = (pairs if name == "pairs" else column)[concerns]
            assert same_bits(hits.columns[name], column), (name, hits.columns[name], column)
        assert sorted(hits.payload) == sorted(names)
        for name in names:
            column = self.table[name if name == "position" else "." + name]
            assert same_bits(hits.payload[name], column[whole.pairs[concerns]]), name
        self.sums(hits)
        if not isinstance(hits, pgccd.CollidingPairs):
            time = whole.time if hasattr(whole, "time") else whole.toi
            first = torch.full((len(id),), torch.inf, dtype=torch.float64)
            first.scatter_reduce_(0, whole.pairs.reshape(-1), time.repeat_interleave(2), "amin")
            if earliest and len(time):
                first = first.clamp(max=time.amin())
            assert same_bits(self.world.first_toi(hits), first[self.rows()])
        self.counts["contacts"] += len(whole.pairs)
        self.counts["excluded"] += len(self.exclude)

    def sums(self, hits: Any) -> None:
        """`sum_per_body` of values that follow from each row, against sums term by term."""
        dtype = [torch.float64, torch.float32, torch.bfloat16, torch.float16][self.rng.integers(4)]
        shape = [(), (3,), (2, 2), (0,)][self.rng.integers(4)]
        # Ranks have different numbers of contacts.
        rng = np.random.default_rng(int(self.rng.integers(1000)))
        values = torch.tensor(rng.normal(size=(len(hits), 2, *shape)) * 10.0 ** rng.integers(-3, 3)).to(dtype)
        found = self.world.sum_per_body(hits, values)
        id = self.world.id
        expected = torch.zeros((len(id), *shape), dtype=dtype)
        row = {int(body): k for k, body in enumerate(id)}
        for k, pair in enumerate(hits.pairs.tolist()):
            for side in (0, 1):
                if pair[side] in row:
                    expected[row[pair[side]]] += values[k, side]
        assert same_bits(found + 0.0, expected + 0.0), (dtype, found, expected)

    def step(self) -> str:
        trajectory = bool(self.rng.integers(3) == 0)
        whole, own = self.motion(trajectory)
        names = self.names()
        expected = self.detect(whole, trajectory)
        hits = stepped(self.world, own, self.options["report"], payload=names[::-1])
        self.steps_made += 1
        self.same_contacts(hits, expected, names, self.options["report"] == "earliest")
        return f"step {type(whole).__name__} {len(expected.pairs)}"

    def detect(self, whole: Any, trajectory: bool) -> Any:
        options = {name: value for name, value in self.options.items() if name != "path"}
        return detected(self.scene(), whole, **options)

    def resolve(self) -> str:
        trajectory = bool(self.rng.integers(3) == 0)
        whole, own = self.motion(trajectory)
        names = [] if trajectory else self.names()
        movable = ~self.table["fixed"] if self.rng.integers(2) else None
        options = {name: self.options[name] for name in ("min_separation", "initial")}
        expected: Any = pgccd.resolve(self.scene(), whole, movable, **options)
        rows, id = self.rows(), self.table["id"]
        may = None if movable is None else movable[rows]
        got: Any = self.world.step(own, resolve=True, movable=may, payload=names)
        self.steps_made += 1
        assert same_bits(got.fraction, expected.fraction[..., rows]), (got.fraction, expected.fraction[..., rows])
        by = expected.stopped_by[rows]
        by = torch.where(by < 0, -1, torch.cat([id, id.new_full((1,), -1)])[by])
        assert got.stopped_by.equal(by), (got.stopped_by, by)
        assert got.rounds == expected.rounds, (got.rounds, expected.rounds)
        for name in ("touching_at_start", "unresolved"):
            pairs = id[getattr(expected, name)]
            pairs = pairs[torch.isin(pairs, self.world.id).any(dim=1)]
            assert getattr(got, name).equal(pairs), (name, getattr(got, name), pairs)
        mine = self.vertex_rows(rows) if self.deforming else rows
        if trajectory:
            for name in ("position", "orientation", "rotation", "margin"):
                column = getattr(expected.motion, name)
                if column is None:
                    assert getattr(got.motion, name) is None
                else:
                    column = column[:, rows if name == "margin" else mine]
                    assert same_bits(getattr(got.motion, name), column), name
            ours, theirs = ([part.columns() for part in each.segments] for each in (got, expected))
        else:
            ours, theirs = [got.motion.columns()], [expected.motion.columns()]
            hits = pgccd.detect(self.scene(), whole, nonzero_toi=True, **options)
            self.same_contacts(got.hits, hits, names, False)
        for a, b in zip(ours, theirs, strict=True):
            for name, column in b.items():
                assert same_bits(a[name], column[mine]), name
        stopped = int((expected.fraction < 1).sum())
        self.counts["stopped"] += stopped
        self.counts["rounds"] += expected.rounds
        self.counts["touching"] += len(expected.touching_at_start)
        self.counts["unresolved"] += len(expected.unresolved)
        if not trajectory and not self.deforming and self.rng.integers(2):
            # The loop goes on.
            x, q = expected.motion.at(1.0) if self.options["path"] == "rigid" else (expected.motion.position_t1, None)
            self.table["position"] = x
            new = {"position": x[rows]}
            if q is not None:
                self.table[".q"], new["q"] = q, q[rows]
            back = torch.where(expected.fraction < 1, -1.0, 1.0)[:, None]
            self.table[".v"] = back * self.table[".v"]
            self.world.move(v=self.table[".v"][rows], **new)
        return f"resolve {type(whole).__name__} {stopped}"

    def move(self) -> str:
        rng, rows = self.rng, self.rows()
        count = len(self.table["id"])
        far = torch.tensor(rng.uniform(size=count) < rng.choice([0.1, 0.5, 1.0]))
        position = torch.where(far[:, None], self.places(count), self.table["position"])
        if rng.integers(8) == 0:
            position[:] = position[:1]
        self.table["position"] = position
        new: dict[str, Tensor] = {}
        if rng.integers(2):
            self.table[".flag"] = ~self.table[".flag"]
            self.table[".deep"] = -self.table[".deep"]
            new = {"flag": self.table[".flag"][rows], "deep": self.table[".deep"][rows]}
        if self.deforming:
            new["x"] = self.vertices({name: column[rows] for name, column in self.table.items()})["x"]
        self.world.move(position[rows], **new)
        return "move"

    def cut(self) -> str:
        """Another partition."""
        rng, size = self.rng, self.comm.size
        partition: Any
        if isinstance(self.world.partition, Bisection):
            low, high = ((0.0,) * 3, (SIDE,) * 3) if rng.integers(2) else ((1.0, -2.0, 1.0), (1.5, 9.0, 3.0))
            partition = Bisection.uniform(low, high, size)
        else:
            partition = self.world.partition
            owner = torch.tensor(rng.integers(size, size=partition.cell_count))
            partition = partition.with_owner(owner)
        self.world.partition = partition
        self.world.move(self.world.position)
        return "cut"

    def run(self, operations: int) -> None:
        """Random operations. An error tells those before it."""
        log: list[str] = []
        for _ in range(operations):
            share = {"step": 0.2, "resolve": 0.3, "move": 0.2, "add": 0.13, "remove": 0.12, "cut": 0.05}
            kind = str(self.rng.choice(list(share), p=list(share.values())))
            try:
                log.append(f"{getattr(self, kind)()} of {len(self.table['id'])}")
                self.check()
            except Exception as error:
                raise AssertionError(f"seed {self.seed}, {self.options}: {kind} after {log[-6:]}") from error


def go_on(comm: Comm, seed: int, operations: int, folder: str, resume: bool) -> dict[str, int]:
    """Makes a world, or restores the one that an earlier call has saved, on any number of ranks; random operations; and
    saves it. Returns what has been seen.
    """
    state = torch.load(Path(folder) / "state.pt", weights_only=True) if resume else None
    machine = Machine(comm, seed, folder, state)
    machine.run(operations)
    machine.world.save(folder, keep=1)
    if comm.rank == 0:
        torch.save(machine.state(), Path(folder) / "state.pt")
    return machine.counts
