"""The initial state of a `World`: one rank's share of the bodies, validated, and the partition of space."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.checkpoint.partition import partition_header
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.launch.agreement import require_agreement, together
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.cut import Cut
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.world.input_checks import (
    LARGEST_ID,
    SCENE_COLUMNS,
    from_all_ranks,
    ids_given,
    payload_columns,
    require_different,
    require_positions,
    require_unique,
    unknown_ids,
)
from pgccd.distributed.world.options import NewBodies, WorldOptions
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import pairs_never_tested
from pgccd.motion.of_scene import check_scene


@dataclass(frozen=True)
class WorldState:
    """One rank's part of a world between two steps."""

    meshes: MeshSet
    cut: Cut
    partition: Partition
    columns: Columns  #: of bodies; names of the payload begin with "."
    vertices: Vertices | None  #: that migrate with the bodies
    steps_made: int = 0
    dtype: str = "float64"  #: of the positions as they were given
    next_id: int = 0  #: larger than all ids that bodies have had
    exclude: Tensor | None = None  #: (E, 2) ids i < j, sorted: pairs never tested, of all ranks; None without any
    header: dict[str, Any] | None = None  #: of the user, in the checkpoint that was loaded

    def with_ids(self, comm: Comm, are_given: bool) -> WorldState:
        """This state with unique ids; ids that were not given become consecutive from `next_id` on, rank by rank.

        Raises:
            ValueError: two bodies have the same id, or ranks without ids passed the same bodies; on all ranks.
        """
        id = self.columns["id"]
        if not are_given:
            require_different(comm, self.columns, self.vertices)
            counts = comm.all_gather(torch.tensor([len(id)]))[:, 0].tolist()
            if sum(counts) and self.next_id + sum(counts) > LARGEST_ID + 1:
                raise of_all_ranks(
                    ValueError(f"id: {sum(counts)} bodies, but no ids are left above {self.next_id - 1}")
                )
            id = id + self.next_id + sum(counts[: comm.rank])
        require_unique(comm, id)
        largest = int(id.max()) if len(id) else -1
        next_id = max(self.next_id, 1 - int(comm.min(torch.tensor([-largest]))))
        return replace(self, columns=self.columns | {"id": id}, next_id=next_id)

    def with_excluded(self, comm: Comm, bodies: NewBodies, id: Tensor) -> WorldState:
        """This state with more pairs that are never tested: the pairs that any rank gives with bodies of these ids
        (N,).

        Raises:
            TypeError, ValueError: naming the argument `exclude`; on all ranks.
        """
        given, of_scene = bodies.exclude, bodies.scene.exclude
        if not comm.any(given is not None or of_scene is not None):
            return self
        own = self.columns["id"]

        def check() -> Tensor:
            pairs = pairs_never_tested([] if given is None else given, None, own.device)
            return pairs if of_scene is None else torch.cat([pairs, id[of_scene].sort(dim=1).values])

        pairs = from_all_ranks(comm, together(comm, check).flatten()).view(-1, 2)
        unknown = unknown_ids(comm, own, pairs.unique())
        if len(unknown):
            raise of_all_ranks(ValueError(f"exclude: expected ids of bodies of this world, got {int(unknown.min())}"))
        if self.exclude is not None:
            pairs = torch.cat([self.exclude, pairs])
        return replace(self, exclude=pairs.unique(dim=0) if len(pairs) else None)

    def without_excluded(self, removed: Tensor) -> WorldState:
        """This state without pairs of removed ids."""
        if self.exclude is None:
            return self
        pairs = self.exclude[~torch.isin(self.exclude, removed).any(dim=1)]
        return replace(self, exclude=pairs if len(pairs) else None)


def state_given(ranks: int, bodies: NewBodies, cut: Cut, balance: BalanceOptions) -> WorldState:
    """The state from this rank's share of the bodies, validated.

    Args:
        ranks: number of ranks.
        bodies: of this rank.
        cut, balance: of the world.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    columns, vertices = bodies_given(bodies)
    meshes, dtype = bodies.scene.meshes, arguments.real_tensor(bodies.position, "position").dtype
    partition = cut.uniform(ranks, meshes.device, balance)
    return WorldState(meshes, cut, partition, columns, vertices, dtype=arguments.dtype_name(dtype))


def bodies_given(bodies: NewBodies) -> tuple[Columns, Vertices | None]:
    """The columns and vertices of bodies from this rank's arguments, validated; without `exclude`.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    scene = bodies.scene
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a pgccd.Scene, got {arguments.describe(scene)}")
    check_scene(scene)
    _ = scene.world_count  # validates `world`
    position, number, device = require_positions(bodies.position), scene.body_count, scene.device
    arguments.shape(position, "position", (number, 3), device)
    columns = {"id": ids_given(bodies.id, number, device), "mesh_index": scene.mesh_index}
    columns["position"] = position.to(torch.float64)
    optional = {name: getattr(scene, name) for name in SCENE_COLUMNS}
    columns |= {name: column for name, column in optional.items() if column is not None}
    count, vertices = vertex_counts(scene.meshes, scene.mesh_index), None
    payload, of_vertices = ({} if each is None else each for each in (bodies.payload, bodies.vertex_payload))
    of_vertices = payload_columns(of_vertices, "vertex_payload", int(count.sum()), device)
    if of_vertices:
        vertices, columns["vertex_count"] = Vertices(of_vertices, count), count
    columns |= payload_columns(payload, "payload", number, device)
    if both := sorted(set(of_vertices) & set(columns)):
        raise ValueError(f"vertex_payload[{both[0][1:]!r}]: payload has a tensor of this name too")
    return columns, vertices


def require_alike(comm: Comm, state: WorldState, options: WorldOptions, ids_given: bool) -> None:
    """Raises an error, on all ranks, unless all parameters are equal on all ranks."""
    given = vars(options) | vars(state.cut)  # a checkpoint has its own cut
    balance = given.pop("balance")
    facts = {name: _plain(value) for name, value in given.items()}
    facts |= {f"balance.{name}": _plain(value) for name, value in vars(balance).items()}
    facts |= {
        "id": "given" if ids_given else "not given",
        "meshes": meshes_digest(state.meshes.meshes),
        "position": (state.columns["position"].device.type, state.dtype),
    }
    of_vertices = {} if state.vertices is None else state.vertices.columns
    for argument, columns in (("payload", state.columns), ("vertex_payload", of_vertices)):
        for name, column in columns.items():
            if name not in facts:
                fact = f"{argument}[{name[1:]!r}]" if name.startswith(".") else name
                facts[fact] = arguments.dtype_name(column.dtype), tuple(column.shape[1:])
    require_agreement(comm, facts)


def agreed_partition(comm: Comm, partition: Partition) -> Partition:
    """The partition. Raises an error, on all ranks, unless it is one for these ranks, and the same on all."""

    def check() -> None:
        if not isinstance(partition, Partition):
            raise TypeError(f"partition: expected Cells or a Bisection, got {arguments.describe(partition)}")
        if partition.ranks != comm.size:
            raise ValueError(f"partition: expected one for {comm.size} ranks, got one for {partition.ranks}")

    together(comm, check)
    parameters, tensors = partition_header(partition)
    digests = [hashlib.sha256(tensor.cpu().numpy().tobytes()).hexdigest() for tensor in tensors.values()]
    require_agreement(comm, {"partition": (parameters, digests)})
    return partition


def _plain(value: Any) -> Any:
    """Equal values of different types (0 and 0.0; a tuple and a tensor) as values of the same type."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
