"""A scene of the user's own, spread over ranks: bodies in, contacts out, whatever the motion and the response."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.detection import narrow
from pgccd.detection.broad import BroadPhase
from pgccd.detection.contacts import Contacts
from pgccd.distributed.balance import BackOff, BalanceOptions, CellLoads, RankLoads, rank_loads, rebalance
from pgccd.distributed.comm.exchange import Columns, make_route, take_rows
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.detection import Detection, cell_loads, detect_distributed
from pgccd.distributed.halo_capacity import HaloCapacity
from pgccd.distributed.launch.agreement import require_agreement, together
from pgccd.distributed.migrate import Census, migrate
from pgccd.distributed.partition import Partition, Point, Triple
from pgccd.distributed.report import earliest_for_all, tell_owners
from pgccd.distributed.share import Options, PartEstimates
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh, MeshSet
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion
from pgccd.runtime.stages import StageClock


class World:
    """Bodies spread over ranks by where they are.

    Each rank brings any share of the bodies; they move to the rank that owns the cell of their position, and again
    whenever `move` takes them elsewhere. Rows of `id`, `position`, `mesh_index` and `payload` are those of the
    bodies this rank owns now, by ascending id.

    Args:
        meshes: alike on all ranks.
        lower, upper: corners of the world's box, length units. Bodies may leave it.
        position: (N, 3) float64 where the origins of this rank's share of bodies are, on the device where all will be.
        id: (N,) int64 global ids >= 0, no two alike on any ranks. Default: counted through, rank by rank.
        mesh_index: (N,) integers: which mesh each body is. Default: all the first.
        group, mask, world, static, margin: (N,), as for `pgccd.Scene`. Either on all ranks or on none.
        payload: named tensors (N, ...) that travel with the bodies: orientations, velocities, anything.
        comm: between the ranks. Default: one rank.
        report, min_separation, tolerance, nonzero_toi, broad_phase: as for `pgccd.detect`.
        path: of all motions, as for `pgccd.RigidMotion`.
        axes, cells: how space is cut, see `Partition.uniform`.
        balance: how cells change hands.
        overlap: test own bodies while those of others are under way. The result does not depend on it.

    Raises:
        TypeError, ValueError: naming the argument; on all ranks.

    Example:
        >>> world = pgccd.distributed.World([rock], (0, 0, 0), (9, 9, 9), x, payload={"velocity": v}, comm=comm)
        >>> hits = world.step(pgccd.RigidMotion.from_velocity(world.position, q, world.payload["velocity"], w, dt=0.1))
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        lower: Point,
        upper: Point,
        position: Tensor,
        *,
        id: Tensor | None = None,
        mesh_index: Tensor | None = None,
        group: Tensor | None = None,
        mask: Tensor | None = None,
        world: Tensor | None = None,
        static: Tensor | None = None,
        margin: Tensor | None = None,
        payload: dict[str, Tensor] | None = None,
        comm: Comm | None = None,
        report: narrow.Report = "first",
        min_separation: float = 0.0,
        tolerance: float | None = None,
        nonzero_toi: bool = False,
        broad_phase: BroadPhase = "auto",
        path: Literal["rigid", "linear"] = "rigid",
        axes: int = 3,
        cells: int | Triple = 16,
        balance: BalanceOptions | None = None,
        overlap: bool = True,
    ) -> None:
        self.comm = comm or Alone()
        self.options = Options(report, min_separation, tolerance, nonzero_toi, broad_phase, overlap)
        self.balance, self.path = balance or BalanceOptions(), path
        optional = {"group": group, "mask": mask, "world": world, "static": static, "margin": margin}
        given: dict[str, Any] = {name: column for name, column in optional.items() if column is not None}

        def prepare() -> Columns:
            arguments.real_tensor(position, "position")
            if position.dim() != 2 or position.shape[1] != 3 or position.is_meta:
                raise ValueError(f"position: expected shape (N, 3), got {arguments.describe(position)}")
            self._meshes = MeshSet(meshes, position.device)
            self.partition = Partition.uniform(
                lower, upper, self.comm.size, axes=axes, cells=cells, device=position.device
            )
            index = torch.zeros(len(position), dtype=torch.int32) if mesh_index is None else mesh_index
            scene = Scene(self._meshes, index, **given)  # checks them
            if scene.body_count != len(position):
                raise ValueError(f"mesh_index: expected {len(position)} values, one a body, got {scene.body_count}")
            columns = {"id": _ids(id, len(position), position.device), "mesh_index": scene.mesh_index}
            columns["position"] = position.to(torch.float64)
            columns |= {name: getattr(scene, name) for name in given}
            return columns | _payload_columns({} if payload is None else payload, len(position), position.device)

        columns = together(self.comm, prepare)
        kinds = {name: (str(column.dtype), tuple(column.shape[1:])) for name, column in columns.items()}
        facts = {"payload": kinds, "lower, upper": (lower, upper), "options": self.options, "path": path}
        facts |= {"axes": axes, "cells": cells, "balance": self.balance, "id": id is None}
        facts |= {"meshes": meshes_digest(self._meshes.meshes), "position": position.device.type}
        require_agreement(self.comm, facts)
        if id is None:
            counts = self.comm.all_gather(torch.tensor([len(position)]))[:, 0].tolist()
            columns["id"] = columns["id"] + sum(counts[: self.comm.rank])
        _require_unique(self.comm, columns["id"])
        self._census = Census.of_ranks(self.comm, columns["id"])
        self._found: Detection | None = None
        self._capacity: HaloCapacity | None = None
        self._estimates = PartEstimates()
        self._seconds, self._steps, self._back_off = 0.0, 0, BackOff()
        self._columns = take_rows(columns, torch.argsort(columns["id"]))
        self._change_hands()

    @property
    def id(self) -> Tensor:
        """(N,) int64, ascending: the bodies this rank owns."""
        return self._columns["id"]

    @property
    def position(self) -> Tensor:
        """(N, 3) float64: where their origins are, as last given."""
        return self._columns["position"]

    @property
    def mesh_index(self) -> Tensor:
        """(N,) int32."""
        return self._columns["mesh_index"]

    @property
    def payload(self) -> dict[str, Tensor]:
        """What the user's tensors are now, by name."""
        own = ("id", "position", "mesh_index", *OPTIONAL_COLUMNS)
        return {name.removeprefix("."): column for name, column in self._columns.items() if name not in own}

    def step(self, motion: RigidMotion) -> Contacts:
        """Finds the collisions of one step.

        Args:
            motion: of the bodies this rank owns, in the order of `id`.

        Returns:
            All contacts of bodies this rank owns (with whomever), `pairs` in global ids i < j, sorted; a contact of
            bodies of two ranks is returned on both. With report="earliest", the one of the whole scene, on every rank.
            `stats` are those of the pairs that this rank tested.

        Raises:
            TypeError: the motion is not rigid: deforming bodies are not spread over ranks.
            ValueError: it has another number of bodies or another path.

        Example:
            >>> hits = world.step(motion)
            >>> toi = world.first_toi(hits)
        """
        if not isinstance(motion, RigidMotion):
            raise TypeError(
                f"motion: expected a RigidMotion, got {type(motion).__name__}: bodies that deform stay whole"
            )
        if motion.body_count != len(self.id):
            raise ValueError(f"motion: has {motion.body_count} bodies, this rank owns {len(self.id)}")
        if motion.path != self.path:
            raise ValueError(f"motion: its path is {motion.path!r}, the world's {self.path!r}")
        motion.check_given()
        own = {name: self._columns[name] for name in ("id", "mesh_index", *OPTIONAL_COLUMNS) if name in self._columns}
        own |= motion.columns()
        self.comm.guard.activity = "step"
        clock = StageClock()
        where = self.comm, self.partition, own, self._build, self.options, clock
        found = detect_distributed(*where, self._estimates, self._capacity)
        self._found, self._seconds, self._steps = found, clock.work, self._steps + 1
        self._capacity = HaloCapacity.of(found.held)
        if self.options.report == "earliest":
            return earliest_for_all(self.comm, found)
        return tell_owners(self.comm, found)

    def first_toi(self, hits: Contacts) -> Tensor:
        """(N,) float64: the first toi of each body this rank owns, inf for those that do not collide.

        Args:
            hits: as `step` returned them.
        """
        if not isinstance(hits, Contacts):
            raise TypeError(f"hits: expected pgccd.Contacts, got {arguments.describe(hits)}")
        if hits.toi is None:
            raise ValueError('hits: report="any" gives no toi')
        first = torch.full((len(self.id),), torch.inf, dtype=torch.float64, device=self.id.device)
        bodies, toi = hits.pairs.reshape(-1), hits.toi.repeat_interleave(2)
        row = torch.searchsorted(self.id, bodies).clamp_(max=max(0, len(self.id) - 1))
        own = self.id[row] == bodies if len(self.id) else torch.zeros_like(bodies, dtype=torch.bool)
        return first.scatter_reduce(0, row[own], toi[own], "amin")

    def move(self, position: Tensor, **payload: Tensor) -> None:
        """Says where the bodies are now; those in cells of other ranks go there, with their payload.

        Args:
            position: (N, 3), in the order of `id`.
            payload: new values of the tensors named; the others stay as they are.

        Raises:
            ValueError: naming the argument.
            RuntimeError: bodies were lost or doubled between ranks.

        Example:
            >>> world.move(x, velocity=v)
        """
        moved: Columns = {}
        for name, values in {"position": position, **payload}.items():
            key = name if name == "position" else "." + name
            former = self._columns.get(key)
            if former is None:
                raise ValueError(f"{name}: not a payload of this world, which has {sorted(self.payload)}")
            if not isinstance(values, Tensor) or values.layout != torch.strided:
                raise TypeError(f"{name}: expected a dense tensor, got {arguments.describe(values)}")
            arguments.refuse_gradient(values, name)
            if values.shape != former.shape or values.dtype != former.dtype or values.device != former.device:
                expected = f"{tuple(former.shape)} {former.dtype} on {former.device}"
                raise ValueError(f"{name}: expected {expected}, got {tuple(values.shape)} {values.dtype}")
            moved[key] = values.detach()
        if not bool(torch.isfinite(position).all()):
            raise ValueError("position: expected finite numbers")
        self._columns |= moved  # only now: what is refused changes nothing
        self._change_hands()

    def loads(self) -> Tensor:
        """(ranks,) int64: the predicted cost of each rank in the last step, the same on all of them."""
        total = self._cell_loads()
        return rank_loads(total.cost, self.partition.owner, self.comm.size)

    def _build(self, columns: Columns) -> tuple[Scene, RigidMotion]:
        optional: dict[str, Any] = {name: columns[name] for name in OPTIONAL_COLUMNS if name in columns}
        pose = (columns["position_t0"], columns["orientation_t0"], columns["position_t1"], columns["rotation"])
        return Scene.of_checked(self._meshes, columns["mesh_index"], **optional), RigidMotion.from_rotation(
            *pose, path=self.path
        )

    def _cell_loads(self) -> CellLoads:
        if self._found is None:
            raise RuntimeError("no step has been made yet")
        own = cell_loads(self.partition, self._found.share.parts[0].bodies.position_t0, self._found)
        return CellLoads.unstacked(self.comm.sum(own.stacked()))

    def _change_hands(self) -> None:
        if self.balance.applies(self._steps, self.comm.size) and self._back_off.is_over(self._steps):
            assert self._found is not None
            mine = [len(self._found.held.own_id), len(self._found.pairs), len(self._found.contacts)]
            loads = self.comm.all_gather(torch.tensor([*mine, self._seconds], dtype=torch.float64))
            bodies, pairs, contacts = loads[:, :3].long().t().tolist()
            if not RankLoads(bodies, pairs, contacts, loads[:, 3].tolist()).are_level(self.balance):
                former = self.partition
                self.partition = rebalance(former, self._cell_loads(), self.balance, loads[:, 3])
                self._back_off.tried(self._steps, int((former.owner != self.partition.owner).sum()))
                self._capacity = None
        self._columns, _ = migrate(self.comm, self.partition, self._columns, self._columns["position"])
        Census.of_ranks(self.comm, self.id).require(self._census)


def _ids(id: Tensor | None, count: int, device: torch.device) -> Tensor:
    if id is None:
        return torch.arange(count, device=device)
    if not isinstance(id, Tensor) or id.dtype != torch.int64 or id.shape != (count,):
        raise ValueError(f"id: expected ({count},) int64, got {getattr(id, 'shape', id)} {getattr(id, 'dtype', '')}")
    if count and int(id.min()) < 0:
        raise ValueError("id: expected numbers >= 0")
    return id.to(device)


def _payload_columns(payload: dict[str, Tensor], count: int, device: torch.device) -> Columns:
    if not isinstance(payload, dict) or not all(isinstance(name, str) for name in payload):
        raise TypeError(f"payload: expected tensors by name, got {arguments.describe(payload)}")
    columns = {}
    for name in sorted(payload):  # in one order on all ranks
        values = payload[name]
        if isinstance(values, Tensor):
            arguments.refuse_gradient(values, f"payload[{name!r}]")
        if not isinstance(values, Tensor) or values.shape[:1] != (count,) or values.device != device:
            raise ValueError(f"payload[{name!r}]: expected a tensor ({count}, ...) on {device}")
        columns["." + name] = values.detach()
    return columns


def _require_unique(comm: Comm, id: Tensor) -> None:
    """Each id goes to one rank that sees all like it."""
    rows = torch.arange(len(id), device=id.device)
    seen = make_route(comm, rows, id % comm.size).forward({"id": id}).wait()["id"].sort().values
    twice = seen[1:][seen[1:] == seen[:-1]]

    def check() -> None:
        if len(twice):
            raise ValueError(f"id: {int(twice[0])} is given to more than one body")

    together(comm, check)
