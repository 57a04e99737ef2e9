"""A user's scene, distributed over ranks: bodies in, contacts out, for any motion and response."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Never, overload

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.checkpoint.files import KEEP
from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.distributed.comm.exchange import Columns, take_rows
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.detection.options import SearchOptions
from pgccd.distributed.detection.report import earliest_for_all, tell_owners
from pgccd.distributed.detection.segments import Segments
from pgccd.distributed.detection.share import Share
from pgccd.distributed.guard import collective
from pgccd.distributed.halo.migrate import IdChecksum, migrate
from pgccd.distributed.halo.vertices import Vertices
from pgccd.distributed.launch.agreement import agree_on_step, together
from pgccd.distributed.partition.balance import PAIR_COST, RankLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.interface import Partition, Point
from pgccd.distributed.steps.rank import Rank
from pgccd.distributed.world.input_checks import (
    columns_to_send,
    motion_facts,
    new_values,
    payload_asked,
    scene_columns,
    scene_of,
)
from pgccd.distributed.world.options import Movable, Names, NewBodies, WorldOptions, options_given
from pgccd.distributed.world.own_bodies import OwnBodies
from pgccd.distributed.world.population import with_more, without
from pgccd.distributed.world.resolve import (
    OwnFractions,
    ResolutionPlan,
    WorldResolution,
    find_fractions,
    options_of_resolution,
    resolve_step,
    vertices_of,
)
from pgccd.distributed.world.state import WorldState, agreed_partition, require_alike, state_given
from pgccd.distributed.world.world_checkpoint import Saving, load_state, save_state
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import bool_column
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.resolution.listed import are_near, is_on_arcs, travels_of
from pgccd.resolution.results import M
from pgccd.resolution.search import held_bodies, warn_of_held
from pgccd.resolution.trajectories import TrajectoryResolution, resolve_segments
from pgccd.runtime.stages import StageClock
from pgccd.search.bodies import MovingBodies
from pgccd.search.passes import search_seconds


class World(OwnBodies):
    """Bodies distributed over ranks by position. Made by `create` or `load`, on all ranks together.

    Bodies migrate to the rank that owns the cell of their position, at the beginning and after each `move`. Rows of
    `id`, `position`, `mesh_index` and `payload` are those of this rank's own bodies, by ascending id.

    Attributes:
        comm: between the ranks.
        options: as given.
        meshes: a `pgccd.MeshSet`, for the scenes of bodies to be added.
        id_checksum: number of all bodies, and a hash of their ids, which migration preserves.
        columns: of this rank's own bodies, by name; names of the payload begin with ".".
        steps_made: number of calls of `step` and `collide`. A loop that searches a step several times must count its
            steps itself.
        next_id: larger than all ids that bodies of this world have had. New bodies may have this id or larger ones.
        found: pairs and contacts of the last step; None before the first.
        header: as passed to `save` for the checkpoint that the world was loaded from; None without a checkpoint.

    Example:
        >>> world = pgccd.distributed.World.create(scene, x, (0, 0, 0), (9, 9, 9), payload={"velocity": v}, comm=comm)
        >>> hits = world.step(pgccd.RigidMotion.from_velocity(world.position, q, world.payload["velocity"], w, dt=0.1))
    """

    def __init__(self, *given: Never, **named: Never) -> None:
        raise TypeError("World: make it by World.create(scene, position, lower, upper, ...) or World.load(folder, ...)")

    def _set(self, comm: Comm, options: WorldOptions, state: WorldState, checksum: IdChecksum) -> None:
        self.comm, self.options, self._search_options = comm, options, options._search(state.exclude)
        self._rank = Rank(Decomposition(comm, state.partition), options.balance)
        self.meshes, self._cut, self.id_checksum = state.meshes, state.cut, checksum
        self.found: Share | None = None
        self.steps_made, self._seconds = state.steps_made, 0.0
        self.columns, self._vertices, self.next_id = state.columns, state.vertices, state.next_id
        self._resolution_plan, self.header = ResolutionPlan(), state.header
        self._saving: Saving | None = None

    @classmethod
    @collective
    def create(
        cls,
        scene: Scene,
        position: Tensor,
        lower: Point,
        upper: Point,
        *,
        id: Tensor | None = None,
        exclude: Tensor | Sequence[Sequence[int]] | None = None,
        payload: dict[str, Tensor] | None = None,
        vertex_payload: dict[str, Tensor] | None = None,
        comm: Comm | None = None,
        options: WorldOptions | None = None,
    ) -> World:
        """Makes a world. Each rank passes any share of the bodies.

        Args:
            scene: N bodies, this rank's share, on the device to use. Its meshes are equal on all ranks; optional
                columns (`group`, `margin`, ...) are given on all ranks or on none. They are copied.
            position: (N, 3) float64 positions of their origins, length units, world frame.
            lower, upper: corners of the world's box, length units. Bodies may leave it.
            id: (N,) int64 global ids >= 0, unique over all ranks. Default: consecutive, rank by rank. Without ids, it
                is an error if two ranks pass the same bodies, as when each rank passes all of them.
            exclude: (E, 2) integers: global ids of more pairs of bodies that are never tested, of any ranks, in any
                order. They are added to those of the scenes. The pairs of all ranks count, and each rank keeps all of
                them.
            payload: named tensors (N, ...) that migrate with the bodies: orientations, velocities, and so on.
            vertex_payload: named tensors (X, ...) with one row per vertex (of the first body, in the order of its mesh,
                then of the second, ...) that migrate with the bodies: the vertices of deforming bodies.
            comm: between the ranks. Default: one rank.
            options: of detection and distribution, equal on all ranks. Default: `WorldOptions()`.

        Raises:
            TypeError, ValueError: naming the argument; on all ranks.
        """
        comm = comm or Alone()
        options = options_given(comm, options)
        bodies = NewBodies(scene, position, id, exclude, payload, vertex_payload)
        cut = options._cut(lower, upper)
        state = together(comm, lambda: state_given(comm.size, bodies, cut, options.balance))
        require_alike(comm, state, options, id is not None)
        state = state.with_ids(comm, id is not None)
        return cls._begin(comm, options, state.with_excluded(comm, bodies, state.columns["id"]))

    @classmethod
    def _begin(cls, comm: Comm, options: WorldOptions, state: WorldState) -> World:
        ascending = torch.argsort(state.columns["id"])
        vertices = None if state.vertices is None else state.vertices.take(ascending)
        state = replace(state, columns=take_rows(state.columns, ascending), vertices=vertices)
        world = cls.__new__(cls)
        world._set(comm, options, state, IdChecksum.of_ranks(comm, state.columns["id"]))
        world._change_hands()
        return world

    @classmethod
    @collective
    def load(
        cls,
        folder: str | PathLike[str],
        meshes: Sequence[Mesh],
        *,
        comm: Comm | None = None,
        device: torch.device | str = "cpu",
        options: WorldOptions | None = None,
    ) -> World:
        """Restores the newest checkpoint in a folder, see `save`. The steps that follow equal those of the saved world,
        bit by bit.

        The checkpoint holds the bodies with all columns, the number of steps made, the next id, and the partition. On
        the same number of ranks the owners of all parts of space are restored; another number of ranks starts with a
        uniform partition.

        Args:
            folder: as for `save`.
            meshes: equal to those of the saved world.
            comm: between the ranks. Default: one rank.
            device: of the bodies.
            options: as for `create`, but `partition`, `axes` and `cells` come from the checkpoint.

        Raises:
            FileNotFoundError: there is no checkpoint; on all ranks.
            CheckpointError: it cannot be read, or is damaged; on all ranks.
            TypeError, ValueError: naming the argument; on all ranks.

        Example:
            >>> world.save("out/world")
            >>> world = pgccd.distributed.World.load("out/world", [rock], comm=comm)
        """
        comm = comm or Alone()
        options = options_given(comm, options)
        state = load_state(comm, folder, meshes, device, options.balance)
        require_alike(comm, state, options, ids_given=True)
        return cls._begin(comm, options, state)

    @collective
    def save(
        self,
        folder: str | PathLike[str],
        keep: int = KEEP,
        *,
        header: Mapping[str, Any] | None = None,
        wait: bool = True,
    ) -> Path:
        """Writes a checkpoint between two steps, which `load` reads on any number of ranks. When it is complete, all
        but the newest checkpoints are removed.

        Args:
            folder: shared by all ranks, for checkpoints of one world. It is created if needed, and locked against other
                jobs while this method runs.
            keep: number of checkpoints to keep, this one included: the newest ones.
            header: values of the caller, plain (as JSON has them) and equal on all ranks. `load` restores them as the
                attribute `header`.
            wait: False: returns when the bodies have been copied to host memory, and writes during the following steps.
                `finish_saving` waits until the checkpoint is complete, and so does the next call of `save`. Until then
                the previous checkpoint is the newest one, also if this process ends.

        Returns:
            The folder of the checkpoint, inside `folder`.

        Raises:
            CheckpointError: it, or the checkpoint before, could not be written; the previous one is kept; on all ranks.
            ValueError, TypeError: naming the argument; the folder is locked by another job, or is not visible to a
                rank; on all ranks.

        Example:
            >>> world.save("out/world")
        """
        self.finish_saving()
        written, self._saving = save_state(self.comm, folder, self._state, keep, header, wait)
        if wait:
            self.finish_saving()
        return written

    @collective
    def finish_saving(self) -> None:
        """Waits until the checkpoint that `save(wait=False)` began is complete. Does nothing if there is none.

        Raises:
            CheckpointError: it cannot be written; the previous one is kept; on all ranks.
        """
        saving, self._saving = self._saving, None
        if saving is not None:
            saving.finish()

    @property
    def _state(self) -> WorldState:
        meshes, cut, partition = self.meshes, self._cut, self.partition
        state = WorldState(meshes, cut, partition, self.columns, self._vertices, self.steps_made, next_id=self.next_id)
        return replace(state, exclude=self.exclude)

    @property
    def exclude(self) -> Tensor | None:
        """(E, 2) int64 global ids i < j, sorted: pairs never tested, equal on all ranks; None without pairs."""
        excluded = self._search_options.excluded
        return None if excluded is None else excluded.pairs

    @property
    def partition(self) -> Partition:
        """The partition of space; the same on all ranks."""
        return self._rank.partition

    @partition.setter
    @partial(collective, name="World.partition")
    def partition(self, partition: Partition) -> None:
        self._rank.partition = agreed_partition(self.comm, partition)

    @overload
    def step(
        self, motion: RigidMotion | VertexMotion, *, payload: Names = (), resolve: Literal[False] = False
    ) -> Contacts: ...
    @overload
    def step(
        self, motion: Trajectory, *, payload: Names = (), resolve: Literal[False] = False
    ) -> TrajectoryContacts: ...
    @overload
    def step(
        self, motion: M, *, payload: Names = (), resolve: Literal[True], movable: Movable = None
    ) -> WorldResolution[M]: ...
    @overload
    def step(self, motion: Trajectory, *, resolve: Literal[True], movable: Movable = None) -> TrajectoryResolution: ...
    @collective
    def step(
        self,
        motion: RigidMotion | VertexMotion | Trajectory,
        *,
        payload: Names = (),
        resolve: bool = False,
        movable: Movable = None,
    ) -> Contacts | WorldResolution[Any] | TrajectoryResolution:
        """Finds the collisions of one step, or of all steps of a trajectory; with `resolve`, how far the bodies can
        move without collisions.

        A contact between bodies of two ranks is returned on both ranks, with the same bits in every column, `payload`
        included. A contact between two own bodies is returned once. Both ranks therefore compute the same impulse, if
        elementwise from a row; `sum_per_body` adds impulses to bodies. With report="earliest", every rank gets the
        first contact of the scene.

        Args:
            motion: of this rank's own bodies, in the order of `id`; of the same kind on all ranks.
            payload: names of per-body payload, or "position" (at t = 0), that contacts carry; the same on all ranks.
                They are sent with the ghosts. Not with a trajectory that is resolved, which returns no contacts.
            resolve: the same on all ranks. True: finds how far each body can move such that none meets another. The
                result equals that of `pgccd.resolve`, bit by bit, with the world's min_separation, tolerance and
                initial, whatever its report. A body that is stopped in a segment of a trajectory stays there.
            movable: with `resolve`, (N,) bool: the own bodies that may be stopped. Default: all.

        Returns:
            All contacts of this rank's own bodies, `pairs` in global ids i < j (i, i for a body with itself), sorted.
            `payload[name]` is (K, 2, ...): the values of i, then of j, whichever ranks own them. For a trajectory,
            `TrajectoryContacts`, as from `pgccd.detect`. `stats` counts the pairs that this rank tested. With
            `resolve`, a `WorldResolution`, whose `hits` carry the payload; for a trajectory a
            `pgccd.TrajectoryResolution`, of this rank's own bodies and in global ids.

        Raises:
            TypeError: the motion is of another type, or `payload` holds no names; on all ranks.
            ValueError: the motion has a wrong number of bodies, vertices or segments, or another path; bodies have no
                such payload; or ranks ask for different payload; on all ranks. Or a pose is invalid; on this rank.
                With `resolve`, a UserWarning names a body of this rank that deforms, moves and gets fraction 0.

        Example:
            >>> hits = world.step(motion, payload=("velocity",))
            >>> of_i, of_j = hits.payload["velocity"].unbind(1)  # (K, 3) each
            >>> toi = world.first_toi(hits)
            >>> resolved = world.step(motion, resolve=True)
            >>> position, orientation = resolved.motion.at(1.0)
        """
        scene, fixed = self._current_scene(), None

        def settings() -> dict[str, Any]:
            nonlocal fixed
            arguments.flag(resolve, "resolve")
            facts = motion_facts(motion, self.options.path, self.meshes, self.mesh_index)
            if movable is not None:
                if not resolve:
                    raise ValueError("movable: can only be given with resolve=True")
                fixed = bool_column(movable, "movable", scene.body_count, scene.device) == 0
            asked = payload_asked(payload, self.columns)
            if asked and resolve and isinstance(motion, Trajectory):
                raise ValueError("payload: a resolved trajectory returns no contacts to carry it")
            return facts | {"resolve": resolve, "payload": asked}

        carried = {name: self.columns[name] for name in agree_on_step(self.comm, settings)["payload"]}
        if resolve:
            return self._resolve(motion, fixed, carried)
        report: Any = self.options.report
        if isinstance(motion, Trajectory):
            # The earliest contact is selected from the first contacts of all segments.
            options = self._search_options
            of_segments = replace(options, report="first") if report == "earliest" else options
            segments, share, carried = self._search_segments(motion, of_segments, carried)
            return segments.contacts_for_owners(self.comm, share, report, carried)
        share = self._search(self.id, scene, motion, self._search_options, carried)
        if report == "earliest":
            return earliest_for_all(self.comm, share, payload=carried)
        contacts = tell_owners(share, carried)
        assert isinstance(contacts, Contacts)
        return contacts

    @collective
    def collide(self, motion: RigidMotion | VertexMotion | Trajectory, *, payload: Names = ()) -> CollidingPairs:
        """Finds the pairs of bodies that collide during one step, or in any step of a trajectory, as `pgccd.collide`
        does: with the world's min_separation, tolerance, initial and broad phase. It counts as a step.

        Args:
            motion, payload: as for `step`.

        Returns:
            All pairs of this rank's own bodies, in global ids i < j (i, i for a body with itself), sorted; a pair of
            bodies of two ranks is returned on both. `payload` and `stats` as for `step`.

        Raises:
            TypeError, ValueError: as for `step`.

        Example:
            >>> colliding = world.collide(motion)
            >>> colliding.pairs, colliding.stats
        """

        def settings() -> dict[str, Any]:
            facts = motion_facts(motion, self.options.path, self.meshes, self.mesh_index)
            return facts | {"payload": payload_asked(payload, self.columns)}

        carried = {name: self.columns[name] for name in agree_on_step(self.comm, settings)["payload"]}
        options = replace(self._search_options, report="any", nonzero_toi=False)
        if isinstance(motion, Trajectory):
            segments, share, carried = self._search_segments(motion, options, carried)
            return segments.pairs_for_owners(share, carried)
        pairs = tell_owners(self._search(self.id, self._current_scene(), motion, options, carried), carried)
        assert isinstance(pairs, CollidingPairs)
        return pairs

    def _search_segments(
        self, motion: Trajectory, options: SearchOptions, carried: Columns
    ) -> tuple[Segments, Share, Columns]:
        """Searches all segments of a trajectory; returns the payload of the bodies of all segments too."""
        own = scene_columns(self.columns)
        segments = Segments.agreed(self.comm, motion.segment_count, own)
        own, carried = segments.repeat(own), segments.repeat_rows(carried)
        if (margin := motion._margins(own.get("margin"), len(self.id))) is not None:
            own["margin"] = margin
        if options.excluded is not None:
            options = replace(options, excluded=options.excluded.in_segments(segments.ids))
        share = self._search(own["id"], scene_of(self.meshes, own), motion.steps(), options, carried)
        return segments, share, carried

    def _resolve(
        self, motion: Any, fixed: Tensor | None, carried: Columns
    ) -> WorldResolution[Any] | TrajectoryResolution:
        steps_made, plan = self.steps_made, self._resolution_plan

        def step(scene: Scene, motion: RigidMotion | VertexMotion) -> WorldResolution[Any]:
            clock, whole = StageClock(), self._search_to_resolve(scene, motion, fixed, carried)
            resolved = resolve_step(whole, scene, motion, fixed, carried, self._rank, plan, clock)
            self._seconds += clock.work
            if isinstance(motion, VertexMotion):
                for body in self.id[held_bodies(scene, motion, resolved.fraction)].tolist()[:1]:
                    warn_of_held(body, stacklevel=6)
            return resolved

        scene = self._current_scene()
        resolved = resolve_segments(scene, motion, step) if isinstance(motion, Trajectory) else step(scene, motion)
        self.steps_made = steps_made + 1
        return resolved

    def _search_to_resolve(
        self, scene: Scene, motion: RigidMotion | VertexMotion, fixed: Tensor | None, carried: Columns
    ) -> Share:
        """The search of the whole step, and of the pairs for rounds if they are to be listed."""
        lists = self._resolution_plan.lists and is_on_arcs(motion)
        if lists:  # the same on all ranks
            bodies = MovingBodies.of(scene, motion, wait=False)
            lists = are_near(self.comm.sum(travels_of(bodies)))
        marks = {} if fixed is None else {"fixed": fixed}
        return self._search(self.id, scene, motion, options_of_resolution(self._search_options, lists), carried | marks)

    def _fractions(self, motion: RigidMotion, fixed: Tensor | None, keeps_common: bool) -> OwnFractions:
        """How far the own bodies move in a step, whose shortened motion is not tested again."""
        scene, clock = self._current_scene(), StageClock()
        whole = self._search_to_resolve(scene, motion, fixed, {})
        plan = self._resolution_plan
        found = find_fractions(whole, scene, motion, fixed, self._rank, plan, clock, keeps_common)
        self._seconds += clock.work
        return found

    def _search(
        self, id: Tensor, scene: Scene, motion: RigidMotion | VertexMotion, options: SearchOptions, carried: Columns
    ) -> Share:
        clock = StageClock()
        with clock.stage("plan"):
            bodies = MovingBodies.of(scene, motion, wait=False)
            if options.at_any_times:
                bodies = bodies.stoppable()
        share, _ = self._rank.search(
            columns_to_send(id, bodies) | carried,
            bodies,
            lambda ghosts: ghosts,
            options,
            clock,
            concurrent_work=lambda _: None,
            vertices=vertices_of(motion, scene),
        )
        clock.add(search_seconds(share.contacts.stats))
        self.found, self._seconds, self.steps_made = share, clock.work, self.steps_made + 1
        return share

    @collective
    def move(self, position: Tensor, **payload: Tensor) -> None:
        """Sets the positions of the bodies. Bodies in subdomains of other ranks migrate there, with their payload.

        Args:
            position: (N, 3) positions of the origins, length units, in the order of `id`.
            payload: new values of named tensors, of bodies or of vertices; tensors not named are unchanged.

        Raises:
            ValueError: naming the argument.
            RuntimeError: bodies were lost or duplicated between ranks.

        Example:
            >>> world.move(x, velocity=v)
        """
        vertices = {} if self._vertices is None else self._vertices.columns
        moved, of_vertices = new_values({"position": position, **payload}, self.columns, vertices)
        # All arguments are valid; nothing has been changed before this line.
        self.columns |= moved
        if self._vertices is not None:
            self._vertices = Vertices(self._vertices.columns | of_vertices, self._vertices.count)
        self._change_hands()

    @collective
    def add(
        self,
        scene: Scene,
        position: Tensor,
        *,
        id: Tensor | None = None,
        exclude: Tensor | Sequence[Sequence[int]] | None = None,
        payload: dict[str, Tensor] | None = None,
        vertex_payload: dict[str, Tensor] | None = None,
    ) -> Tensor:
        """Adds bodies between two steps; they migrate to their owners. All ranks call it, each with any share of the
        new bodies, or none (0 rows). Later steps equal those of a world made with all these bodies.

        Args:
            scene: M bodies, with the meshes of this world. If some bodies have an optional column and others do not,
                the others get the default of `pgccd.Scene`.
            position: (M, 3) positions of their origins, length units, world frame.
            id: (M,) int64 from `next_id` on: no id is used twice, not even the id of a removed body. Default:
                consecutive, rank by rank.
            exclude: (E, 2) as for `create`: more pairs, of new bodies or of present ones.
            payload, vertex_payload: as for `create`, with the names, shapes and dtypes of this world.

        Returns:
            (M,) int64: the ids of these bodies, in the order of `position`.

        Raises:
            TypeError, ValueError: naming the argument; also if ranks pass the same bodies without ids; on all ranks.
                The world is unchanged.

        Example:
            >>> id = world.add(pgccd.Scene(world.meshes, [0, 0]), x + 5.0, payload={"velocity": v})
        """
        bodies = NewBodies(scene, position, id, exclude, payload, vertex_payload)
        state, new = with_more(self.comm, self._state, bodies)
        self._become(state)
        return new

    @collective
    def remove(self, ids: Tensor) -> None:
        """Removes bodies between two steps. All ranks call it, and all bodies whose ids any rank passes are removed.
        Their ids are not used again.

        Args:
            ids: (M,) int64 global ids of bodies of any rank; an id may occur several times, on any ranks.

        Raises:
            TypeError, ValueError: naming the argument; also if no body has one of the ids; on all ranks. The world is
                unchanged.

        Example:
            >>> world.remove(world.id[world.position[:, 2] < -10.0])
        """
        self._become(without(self.comm, self._state, ids))

    def _become(self, state: WorldState) -> None:
        """Takes the bodies of another state."""
        self.columns, self._vertices, self.next_id = state.columns, state.vertices, state.next_id
        if state.exclude is not self.exclude:
            self._search_options = self.options._search(state.exclude)
        self._scene = None
        self.id_checksum = IdChecksum.of_ranks(self.comm, self.id)
        self._migrate()

    @collective
    def loads(self) -> Tensor:
        """(ranks,) int64: the predicted cost of each rank in the last step, the same on all ranks."""
        if self.found is None:
            raise RuntimeError("no step has been made yet")
        cost = self.found.held.own_count + PAIR_COST * len(self.found.pairs)
        return self.comm.all_gather(torch.tensor([cost]))[:, 0]

    def _change_hands(self) -> None:
        found, comm, rank = self.found, self.comm, self._rank
        if found is not None and rank.balancer.is_due(self.steps_made, comm.size):  # not before the first step
            mine = [found.held.own_count, len(found.pairs), len(found.contacts), self._seconds]
            loads = RankLoads(*comm.all_gather(torch.tensor(mine, dtype=torch.float64)).T.tolist())
            if rank.is_balance_due(self.steps_made, loads):
                rank.balance(found, loads, self.steps_made)
        self._migrate()

    def _migrate(self) -> None:
        after = migrate(self._rank.decomposition, self.columns, self.position, self._vertices)
        self.columns, self._vertices = after.columns, after.vertices
        IdChecksum.of_ranks(self.comm, self.id).require(self.id_checksum)
