"""A scene of the user's own, spread over ranks: bodies in, contacts out, whatever the motion and the response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.detection import narrow
from pgccd.detection.broad import BroadPhase
from pgccd.detection.contacts import Contacts
from pgccd.detection.trajectories import TrajectoryContacts
from pgccd.distributed.comm.exchange import Columns, take_rows
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.detection.detect import Detection, detect_distributed
from pgccd.distributed.detection.report import earliest_for_all, tell_owners
from pgccd.distributed.detection.segments import Segments
from pgccd.distributed.detection.share import Options, PartEstimates
from pgccd.distributed.halo.capacity import HaloCapacity
from pgccd.distributed.halo.migrate import Census, migrate
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.launch.agreement import require_agreement, together
from pgccd.distributed.partition.balance import PAIR_COST, BackOff, BalanceOptions, RankLoads
from pgccd.distributed.partition.interface import Point, Triple
from pgccd.distributed.partition.rebalancing import make_partition, rebalanced, require_policy
from pgccd.distributed.world.columns import ids_given, payload_columns, require_rows, require_unique
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh, MeshSet
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.runtime.stages import StageClock

# Columns of scenes that may be absent, and all columns that detection reads.
_OPTIONAL = (*OPTIONAL_COLUMNS, "self_collision")
_OF_SCENES = ("id", "mesh_index", *_OPTIONAL)


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
        self_collision: (N,) bool or bool: which bodies are tested against themselves while they deform.
        payload: named tensors (N, ...) that travel with the bodies: orientations, velocities, anything.
        vertex_payload: named tensors (X, ...) with a row for each vertex of each body (of the first body, in the order
            of its mesh, then of the second, ...), that travel with the bodies: the vertices of bodies that deform.
        comm: between the ranks. Default: one rank.
        report, min_separation, tolerance, nonzero_toi, broad_phase: as for `pgccd.detect`.
        path: of all motions, as for `pgccd.RigidMotion`.
        partition: how space is cut: "cells" (`Cells.uniform`) or "bisection" (`Bisection.uniform`).
        axes, cells: of cells.
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
        self_collision: Tensor | bool = False,
        payload: dict[str, Tensor] | None = None,
        vertex_payload: dict[str, Tensor] | None = None,
        comm: Comm | None = None,
        report: narrow.Report = "first",
        min_separation: float = 0.0,
        tolerance: float | None = None,
        nonzero_toi: bool = False,
        broad_phase: BroadPhase = "auto",
        path: Literal["rigid", "linear"] = "rigid",
        partition: Literal["cells", "bisection"] = "cells",
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
            cut = lower, upper, self.comm.size, axes, cells, position.device
            self.partition = make_partition(partition, *cut)
            require_policy(partition, self.balance)
            index = torch.zeros(len(position), dtype=torch.int32) if mesh_index is None else mesh_index
            scene = Scene(self._meshes, index, self_collision=self_collision, **given)  # checks them
            if scene.body_count != len(position):
                raise ValueError(f"mesh_index: expected {len(position)} values, one a body, got {scene.body_count}")
            columns = {"id": ids_given(id, len(position), position.device), "mesh_index": scene.mesh_index}
            columns["position"] = position.to(torch.float64)
            columns |= {name: getattr(scene, name) for name in given}
            if scene.self_collision is not None:
                columns["self_collision"] = scene.self_collision
            count, self._vertices = vertex_counts(self._meshes, scene.mesh_index), None
            of_vertices = {} if vertex_payload is None else vertex_payload
            of_vertices = payload_columns(of_vertices, "vertex_payload", int(count.sum()), position.device)
            if of_vertices:
                self._vertices, columns["vertex_count"] = Vertices(of_vertices, count), count
            return columns | payload_columns(
                {} if payload is None else payload, "payload", len(position), position.device
            )

        columns = together(self.comm, prepare)
        all_columns = columns | ({} if self._vertices is None else self._vertices.columns)
        kinds = {name: (str(column.dtype), tuple(column.shape[1:])) for name, column in all_columns.items()}
        facts = {"payload": kinds, "lower, upper": (lower, upper), "options": self.options, "path": path}
        facts |= {"partition": partition, "axes": axes, "cells": cells, "balance": self.balance, "id": id is None}
        facts |= {"meshes": meshes_digest(self._meshes.meshes), "position": position.device.type}
        require_agreement(self.comm, facts)
        if id is None:
            counts = self.comm.all_gather(torch.tensor([len(position)]))[:, 0].tolist()
            columns["id"] = columns["id"] + sum(counts[: self.comm.rank])
        require_unique(self.comm, columns["id"])
        self.census = Census.of_ranks(self.comm, columns["id"])
        #: Of the last step.
        self.found: Detection | None = None
        self._capacity: HaloCapacity | None = None
        self.estimates = PartEstimates()
        self.steps_made = 0
        self._seconds, self._back_off = 0.0, BackOff()
        ascending = torch.argsort(columns["id"])
        self.columns = take_rows(columns, ascending)
        self._vertices = None if self._vertices is None else self._vertices.take(ascending)
        self._change_hands()

    @property
    def id(self) -> Tensor:
        """(N,) int64, ascending: the bodies this rank owns."""
        return self.columns["id"]

    @property
    def position(self) -> Tensor:
        """(N, 3) float64: where their origins are, as last given."""
        return self.columns["position"]

    @property
    def mesh_index(self) -> Tensor:
        """(N,) int32."""
        return self.columns["mesh_index"]

    @property
    def payload(self) -> dict[str, Tensor]:
        """What the user's tensors are now, by name."""
        return {name[1:]: column for name, column in self.columns.items() if name.startswith(".")}

    @property
    def vertex_payload(self) -> dict[str, Tensor]:
        """What the user's tensors of vertices are now, by name: of the bodies this rank owns, by ascending id."""
        columns = {} if self._vertices is None else self._vertices.columns
        return {name[1:]: column for name, column in columns.items()}

    def step(self, motion: RigidMotion | VertexMotion | Trajectory) -> Contacts:
        """Finds the collisions of one step, or of all steps of a trajectory.

        Args:
            motion: of the bodies this rank owns, in the order of `id`; of one kind on all ranks.

        Returns:
            All contacts of bodies this rank owns (with whomever), `pairs` in global ids i < j (i, i of a body with
            itself), sorted; a contact of bodies of two ranks is returned on both. With report="earliest", the one of
            the whole scene, on every rank. Of a trajectory `TrajectoryContacts`, as of `pgccd.detect`. `stats` are
            those of the pairs that this rank tested.

        Raises:
            TypeError: the motion is of no such kind.
            ValueError: it has another number of bodies, vertices or segments, or another path.

        Example:
            >>> hits = world.step(motion)
            >>> toi = world.first_toi(hits)
        """
        own = self.columns_of_scene(self.columns)
        if isinstance(motion, Trajectory):
            require_rows(motion, len(self.id), vertex_counts(self._meshes, self.mesh_index))
            segments = Segments.agreed(self.comm, motion.segment_count, own)
            # The earliest is chosen from the first contacts of all segments.
            report: narrow.Report = "first" if self.options.report == "earliest" else self.options.report
            found = self._detect(segments.repeat(own), motion.steps(), replace(self.options, report=report))
            return segments.contacts_for_owners(self.comm, found, self.options.report)
        found = self._detect(own, motion, self.options)
        if self.options.report == "earliest":
            return earliest_for_all(self.comm, found)
        return tell_owners(self.comm, found)

    def _detect(self, own: Columns, motion: RigidMotion | VertexMotion, options: Options) -> Detection:
        if not isinstance(motion, (RigidMotion, VertexMotion)):
            kinds = "a pgccd.RigidMotion, VertexMotion or Trajectory"
            raise TypeError(f"motion: expected {kinds}, got {arguments.describe(motion)}")
        count = vertex_counts(self._meshes, own["mesh_index"])
        require_rows(motion, len(own["id"]), count)
        vertices = None
        if isinstance(motion, VertexMotion):
            vertices = Vertices(motion.columns(), count)
        else:
            if motion.path != self.path:
                raise ValueError(f"motion: its path is {motion.path!r}, the world's {self.path!r}")
            motion.check_given()
            own = own | motion.columns()
        self.comm.guard.activity = "step"
        clock = StageClock()
        where = self.comm, self.partition, own, self.build, options, clock
        capacity = self._capacity if vertices is None else None
        found = detect_distributed(*where, self.estimates, capacity, vertices)
        self.found, self._seconds, self.steps_made = found, clock.work, self.steps_made + 1
        self._capacity = HaloCapacity.of(found.held)
        return found

    def first_toi(self, hits: Contacts) -> Tensor:
        """(N,) float64: the first toi of each body this rank owns, or the first `time` of a trajectory; inf for those
        that do not collide.

        Args:
            hits: as `step` returned them.
        """
        if not isinstance(hits, Contacts):
            raise TypeError(f"hits: expected pgccd.Contacts, got {arguments.describe(hits)}")
        if hits.toi is None:
            raise ValueError('hits: report="any" gives no toi')
        first = torch.full((len(self.id),), torch.inf, dtype=torch.float64, device=self.id.device)
        time = hits.time if isinstance(hits, TrajectoryContacts) else hits.toi
        assert time is not None
        bodies, toi = hits.pairs.reshape(-1), time.repeat_interleave(2)
        row = torch.searchsorted(self.id, bodies).clamp_(max=max(0, len(self.id) - 1))
        own = self.id[row] == bodies if len(self.id) else torch.zeros_like(bodies, dtype=torch.bool)
        return first.scatter_reduce(0, row[own], toi[own], "amin")

    def move(self, position: Tensor, **payload: Tensor) -> None:
        """Says where the bodies are now; those in cells of other ranks go there, with their payload.

        Args:
            position: (N, 3), in the order of `id`.
            payload: new values of the tensors named, of bodies or of vertices; the others stay as they are.

        Raises:
            ValueError: naming the argument.
            RuntimeError: bodies were lost or doubled between ranks.

        Example:
            >>> world.move(x, velocity=v)
        """
        moved: Columns = {}
        of_vertices: Columns = {}
        for name, values in {"position": position, **payload}.items():
            key = name if name == "position" else "." + name
            of_bodies, vertices = self.columns, {} if self._vertices is None else self._vertices.columns
            former = of_bodies.get(key, vertices.get(key))
            if former is None:
                known = sorted({*self.payload, *self.vertex_payload})
                raise ValueError(f"{name}: not a payload of this world, which has {known}")
            if not isinstance(values, Tensor) or values.layout != torch.strided:
                raise TypeError(f"{name}: expected a dense tensor, got {arguments.describe(values)}")
            arguments.refuse_gradient(values, name)
            if values.shape != former.shape or values.dtype != former.dtype or values.device != former.device:
                expected = f"{tuple(former.shape)} {former.dtype} on {former.device}"
                raise ValueError(f"{name}: expected {expected}, got {tuple(values.shape)} {values.dtype}")
            (moved if key in of_bodies else of_vertices)[key] = values.detach()
        if not bool(torch.isfinite(position).all()):
            raise ValueError("position: expected finite numbers")
        # Only now: what is refused changes nothing.
        self.columns |= moved
        if self._vertices is not None:
            self._vertices = Vertices(self._vertices.columns | of_vertices, self._vertices.count)
        self._change_hands()

    def loads(self) -> Tensor:
        """(ranks,) int64: the predicted cost of each rank in the last step, the same on all of them."""
        if self.found is None:
            raise RuntimeError("no step has been made yet")
        cost = len(self.found.held.own_id) + PAIR_COST * len(self.found.pairs)
        return self.comm.all_gather(torch.tensor([cost]))[:, 0]

    def columns_of_scene(self, columns: Columns) -> Columns:
        """Those of them that detection reads."""
        return {name: columns[name] for name in _OF_SCENES if name in columns}

    def build(self, columns: Columns) -> tuple[Scene, RigidMotion | VertexMotion]:
        """The scene and motion of bodies with these columns."""
        optional: dict[str, Any] = {name: columns[name] for name in _OPTIONAL if name in columns}
        scene = Scene.of_checked(self._meshes, columns["mesh_index"], **optional)
        if "x_t0" in columns:
            return scene, VertexMotion(columns["x_t0"], columns["x_t1"])
        pose = (columns["position_t0"], columns["orientation_t0"], columns["position_t1"], columns["rotation"])
        return scene, RigidMotion.from_rotation(*pose, path=self.path)

    def decides_balance(self, steps_made: int) -> bool:
        """Whether it is decided after so many steps if bodies change hands for balance."""
        return self.balance.applies(steps_made, self.comm.size) and self._back_off.is_over(steps_made)

    def _change_hands(self) -> None:
        if self.decides_balance(self.steps_made):
            assert self.found is not None
            mine = [len(self.found.held.own_id), len(self.found.pairs), len(self.found.contacts)]
            loads = self.comm.all_gather(torch.tensor([*mine, self._seconds], dtype=torch.float64))
            bodies, pairs, contacts = loads[:, :3].long().t().tolist()
            if not RankLoads(bodies, pairs, contacts, loads[:, 3].tolist()).are_level(self.balance):
                places = self.found.places(self.found.share.parts[0].bodies.position_t0)
                after = rebalanced(self.comm, self.partition, places, self.balance, loads[:, 3])
                self._back_off.tried(self.steps_made, after.moved)
                self.partition = after.partition
                self._capacity = None
        moved = migrate(self.comm, self.partition, self.columns, self.position, vertices=self._vertices)
        self.columns, self._vertices = moved.columns, moved.vertices
        Census.of_ranks(self.comm, self.id).require(self.census)
