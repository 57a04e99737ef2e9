"""PCCCD: voxel-based parallel collision detection on CPUs, extended to continuous collision detection.

The algorithm of Lawlor & Kale, "A voxel-based parallel collision detection algorithm" (ICS 2002). Du, Liu & Suzumura
(2017) compare with it under this name. Bodies are not migrated; the voxels of a sparse regular grid distribute the
work. Differences from the original: boxes enclose triangles swept over a step, pgccd's certified tests solve the pairs
found, and all boxes for one rank are sent in one message.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.baselines.triangle_pairs import feature_candidates
from pgccd.baselines.voxel_boxes import VoxelContents, send_boxes
from pgccd.baselines.voxel_directory import VoxelDirectory, first_rows, greedy_ranks, voxel_keys
from pgccd.contacts.contacts import COLUMNS, Contacts, Stats
from pgccd.distributed.comm.exchange import Columns, make_route, take_rows
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.launch.agreement import require_agreement, together
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion
from pgccd.runtime.stages import StageClock
from pgccd.search import narrow
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import Initial
from pgccd.search.query import Query

# For the nanorobots: from 6 to 9 edges the time is within a tenth of the minimum; at 15 edges it is twice the minimum.
_EDGES_A_VOXEL = 8.0


@dataclass(frozen=True)
class VoxelStats:
    """Statistics of one rank in one call of `PCCCD.detect`.

    Attributes:
        boxes: boxes sent: one per voxel that a swept triangle touches.
        voxels: voxels of this rank with boxes.
        box_pairs: pairs of triangle boxes accepted on this rank.
        body_pairs: body pairs of these.
        candidates: feature pairs solved on this rank.
        unresolved: contacts reported because the iteration budget was spent.
        seconds: by stage: contribute, locate, exchange, synchronize, bisect, fetch, narrow, report.
    """

    boxes: int
    voxels: int
    box_pairs: int
    body_pairs: int
    candidates: int
    unresolved: int
    seconds: dict[str, float] = field(default_factory=dict)


class PCCCD:
    """Finds the collisions of rigid bodies on any number of CPU ranks; made by `create`, on all ranks together.

    Attributes:
        comm: between the ranks.
        voxel_size: length of a voxel's edge.
        stats: of the last call of `detect`; None before the first.

    Example:
        >>> hits = pgccd.baselines.PCCCD.create([rock]).detect(pgccd.RigidMotion(x0, q0, x1, q1))
    """

    def __init__(self, comm: Comm, meshes: MeshSet, query: Query, voxel_size: float) -> None:
        self.comm, self._meshes, self._query, self.voxel_size = comm, meshes, query, voxel_size
        self._directory = VoxelDirectory(comm)
        self._contents: VoxelContents | None = None
        self.stats: VoxelStats | None = None

    @classmethod
    def create(
        cls,
        meshes: Sequence[Mesh],
        voxel_size: float | None = None,
        *,
        comm: Comm | None = None,
        report: Literal["first", "all"] = "first",
        min_separation: float = 0.0,
        tolerance: float | None = None,
        nonzero_toi: bool = False,
        initial: Initial = "report",
    ) -> PCCCD:
        """Prepares the meshes, and compares the arguments of all ranks.

        Args:
            meshes: equal on all ranks, of triangles alone, without a thickness.
            voxel_size: length of a voxel's edge. Default: 8 mean edges of the meshes' triangles.
            comm: between the ranks. Default: one rank.
            report: "first": the earliest contact of each pair of bodies; "all": every touching feature pair.
            min_separation, tolerance, nonzero_toi, initial: as for `pgccd.detect`.

        Raises:
            TypeError, ValueError: naming the argument; on all ranks.
        """
        comm = comm or Alone()

        def prepare() -> tuple[MeshSet, Query, float]:
            arguments.choice(report, "report", ("first", "all"))
            mesh_set = MeshSet(meshes)
            _require_triangles(mesh_set.meshes)
            size = _EDGES_A_VOXEL * _mean_edge(mesh_set.meshes) if voxel_size is None else voxel_size
            if not arguments.length(size, "voxel_size") > 0.0:
                raise ValueError(f"voxel_size: expected a length > 0, got {size}")
            return mesh_set, Query(report, min_separation, tolerance, nonzero_toi, initial), size

        mesh_set, query, size = together(comm, prepare)
        require_agreement(comm, {"meshes": meshes_digest(mesh_set.meshes), "voxel_size": size, "query": query})
        return cls(comm, mesh_set, query, size)

    def detect(self, motion: RigidMotion, id: Tensor | None = None, mesh_index: Tensor | None = None) -> Contacts:
        """Finds the collisions of one step.

        Args:
            motion: of this rank's bodies, on the CPU; with the same kind of path on all ranks.
            id: (N,) int64 global ids >= 0, unique over all ranks. Default: consecutive, rank by rank.
            mesh_index: (N,) integers: mesh of each body. Default: the first.

        Returns:
            All contacts of this rank's bodies, `pairs` in global ids i < j, sorted.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        arguments.instance(motion, "motion", RigidMotion)
        if motion.device.type != "cpu":
            raise ValueError(f"motion: expected one on the CPU, got one on {motion.device}")
        count = motion.body_count
        index = torch.zeros(count, dtype=torch.int32) if mesh_index is None else mesh_index
        bodies = MovingBodies.of(Scene(self._meshes, index), motion)
        bodies_before = self._bodies_before(count)
        if id is None:
            id = torch.arange(count) + bodies_before[self.comm.rank]
        if not isinstance(id, Tensor) or id.dtype != torch.int64 or id.shape != (count,):
            raise ValueError(f"id: expected ({count},) int64, got {arguments.describe(id)}")
        own = {"id": id, "mesh_index": bodies.scene.mesh_index, **motion.columns()}
        clock = StageClock()

        query, lengths = self._query, self._query.lengths
        contents, boxes_sent = send_boxes(
            self.comm, self._directory, bodies, bodies_before[:-1], self.voxel_size, lengths, clock
        )
        self._contents = contents
        with clock.stage("synchronize"):
            self.comm.barrier()
        with clock.stage("bisect"):
            triangle_pairs = ops.voxel_pairs(
                contents.boxes, contents.segments, contents.voxels, contents.first_segment, self.voxel_size
            )
        with clock.stage("fetch"):
            columns, owner, triangle_pairs = self._fetch(own, bodies_before, triangle_pairs)
        with clock.stage("narrow"):
            found = MovingBodies.of_columns(self._meshes, columns, motion.path == "linear")
            pairs, candidates = feature_candidates(found, triangle_pairs, query.tests_start)
            report = narrow.REPORTS[query.report]
            row, *rows = ops.narrow(found.operands, pairs, candidates, *lengths, query.nonzero_toi, report)
        with clock.stage("report"):
            of_contacts = pairs[row.long()]
            contacts = dict(zip(COLUMNS, (columns["id"][of_contacts], *rows), strict=True))
            received = self._report(contacts, owner[of_contacts])
        unresolved = int((contacts["status"] == narrow.Status.UNRESOLVED).sum())
        self.stats = VoxelStats(
            boxes_sent,
            len(contents.voxels),
            len(triangle_pairs),
            len(pairs),
            len(candidates),
            unresolved,
            clock.seconds,
        )
        stats = Stats(
            bodies=count,
            pcs=len(pairs),
            candidates=len(candidates),
            contacts=len(received["toi"]),
            unresolved=unresolved,
            broad_phase="voxels",
            chunks=1,
            seconds=clock.seconds,
        )
        own_contacts: dict[str, Any] = received
        return Contacts(**own_contacts, stats=stats)

    def balance(self) -> None:
        """Balances the number of boxes per rank in the last call of `detect` by moving voxels: the largest first, each
        to the least loaded rank. All ranks must call this.

        Raises:
            RuntimeError: nothing has been detected yet.
        """
        if self._contents is None:
            raise RuntimeError("nothing has been detected yet")
        keys = voxel_keys(self._contents.voxels)
        everywhere = torch.arange(self.comm.size).repeat_interleave(len(keys))
        route = make_route(self.comm, torch.arange(len(keys)).repeat(self.comm.size), everywhere)
        received = route.forward({"key": keys, "boxes": self._contents.counts}).wait()
        self._directory.move(received["key"], greedy_ranks(received["boxes"], self.comm.size))

    def _bodies_before(self, count: int) -> Tensor:
        """(ranks + 1,) int64: number of bodies on the ranks before each rank, and in total."""
        counts = self.comm.all_gather(torch.tensor([count]))[:, 0]
        return torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])

    def _fetch(self, own: Columns, bodies_before: Tensor, triangle_pairs: Tensor) -> tuple[Columns, Tensor, Tensor]:
        """Fetches the bodies of pairs from their ranks.

        Args:
            own: columns of this rank's bodies.
            bodies_before: see `_bodies_before`.
            triangle_pairs: (K, 4) int64 from `ops.voxel_pairs`: bodies are numbered over all ranks.

        Returns:
            Columns of these bodies (M,), by ascending id; their ranks (M,); and triangle_pairs with bodies as rows of
            these columns, i < j.
        """
        wanted, body = torch.unique(triangle_pairs[:, ::2], return_inverse=True)
        owner = torch.searchsorted(bodies_before, wanted, right=True) - 1
        route = make_route(self.comm, torch.arange(len(wanted)), owner)
        asked = route.forward({"row": wanted - bodies_before[owner]}).wait()["row"]
        # Returned in the order of `wanted`: by rank.
        columns = route.back(take_rows(own, asked)).wait()
        order = torch.argsort(columns["id"])
        place = torch.empty_like(order)
        place[order] = torch.arange(len(order))
        body = place[body]
        triangle = triangle_pairs[:, 1::2]
        ordered, side = body.sort(dim=1)
        triangle_pairs = torch.stack([ordered, triangle.gather(1, side)], dim=2).flatten(1)
        return take_rows(columns, order), owner[order], triangle_pairs

    def _report(self, contacts: Columns, owner: Tensor) -> Columns:
        """Sends contacts to the ranks `owner` (K, 2) of their bodies; returns those received, sorted. With
        report="first", voxels on different ranks may each have found a first contact of the same pair.
        """
        everything = torch.arange(len(owner))
        second = everything[owner[:, 0] != owner[:, 1]]
        rows, destination = torch.cat([everything, second]), torch.cat([owner[:, 0], owner[second, 1]])
        received = make_route(self.comm, rows, destination).forward(contacts).wait()
        keys = [received["pairs"][:, 0], received["pairs"][:, 1], received["kind"], *received["features"].unbind(dim=1)]
        if self._query.report == "first":
            keys.insert(2, received["toi"])
        order = torch.from_numpy(np.lexsort([key.numpy() for key in reversed(keys)]))
        if self._query.report == "first":
            order = order[first_rows(received["pairs"][order])]
        return take_rows(received, order)


def _require_triangles(meshes: Sequence[Mesh]) -> None:
    """Raises ValueError if a mesh has anything but triangles: voxels are those of boxes around swept triangles."""
    for number, mesh in enumerate(meshes):
        if mesh.segment_count or mesh.point_count or mesh.thickness:
            raise ValueError(f"meshes: expected triangles alone, without a thickness, got {mesh!r} as number {number}")


def _mean_edge(meshes: Sequence[Mesh]) -> float:
    lengths = []
    for mesh in meshes:
        corners = mesh.vertices[mesh.faces.long()]
        lengths.append((corners - corners.roll(1, dims=1)).norm(dim=2).flatten())
    return float(torch.cat(lengths).mean()) if lengths else 1.0
