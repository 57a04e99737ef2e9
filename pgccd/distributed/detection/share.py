"""One rank's share of a step: pairs of own bodies, then pairs with ghosts.

A pair of own bodies belongs to this rank if one of the two reaches no other rank. These pairs are searched while ghosts
are sent. Then ghosts are paired with each other and with the own bodies near them, and own bodies that reach other
ranks with each other; on a GPU concurrently with the first search.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import torch
from torch import Tensor

from pgccd import ops
from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.detection.options import PassEstimates, SearchOptions
from pgccd.distributed.halo.ghosts import Halo
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.halo.local_bodies import LocalBodies
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.rebalancing import Places
from pgccd.resolution.search import has_changed
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.side_stream import SideStream
from pgccd.runtime.stages import StageClock
from pgccd.search.bodies import MovingBodies
from pgccd.search.broad import select_rows
from pgccd.search.passes import PASS_SLACK, SearchPass, Select, contacts_of_step, find_pass, first_contacts_of

T = TypeVar("T")

#: From columns of bodies as sent between ranks to those of `MovingBodies.of_columns`.
Complete = Callable[[Columns], Columns]


@dataclass(eq=False)
class Share:
    """One rank's share of a step: pairs of own bodies and, with several ranks, pairs with ghosts or at the boundary.
    All pairs of bodies are in the shares of all ranks, each in one.
    """

    held: LocalBodies
    passes: list[SearchPass]  #: being searched
    ghosts: MovingBodies | None  #: None on a single rank
    options: SearchOptions
    #: (1,) int64: nonzero if there were more bodies than the given sizes on this rank, and pairs may be missing.
    overflow: Tensor
    sizes: HaloSizes | None  #: exact numbers of bodies; None if nothing was to synchronise

    @property
    def body_count(self) -> int:
        """Number of held bodies, without padding."""
        assert self.sizes is not None
        return self.held.own_count + sum(self.sizes.received)

    @cached_property
    def pairs(self) -> Tensor:
        """(P, 2) int64: the PCS as rows of the held bodies, the one with the smaller id first. Synchronises."""
        return torch.cat([each.in_step(_pairs_of(each)) for each in self.passes])

    @cached_property
    def contacts(self) -> Contacts | CollidingPairs:
        """The contacts of these pairs, as rows of the held bodies; the first one for "earliest". Synchronises."""
        found = contacts_of_step(self.passes)
        if self.options.report == "earliest" and isinstance(found, Contacts):
            found = found.earliest(*self.held.id[found.pairs].unbind(dim=1))
        return replace(found, stats=replace(found.stats, bodies=self.body_count))

    def first_contacts(self) -> tuple[Tensor, Tensor]:
        """Pairs (K, 2) as rows of the held bodies, and toi (K,), of all passes: see `SearchPass.first_contacts`."""
        return first_contacts_of(self.passes)

    def places(self) -> Places:
        """The positions of the work. Synchronises."""
        distances = self.options.distances
        lower = [ops.swept_boxes(each.bodies.swept_spheres, *distances)[0] for each in self.passes]
        of_pairs = [_corners(corner, _pairs_of(each)) for each, corner in zip(self.passes, lower, strict=True)]
        of_contacts = [_corners(corner, each.find().pairs) for each, corner in zip(self.passes, lower, strict=True)]
        return Places(self.passes[0].bodies.position_t0, torch.cat(of_pairs), torch.cat(of_contacts))


def _pairs_of(search_pass: SearchPass) -> Tensor:
    return search_pass.pairs[: search_pass.find().stats.pcs]


def _corners(lower: Tensor, pairs: Tensor) -> Tensor:
    return torch.maximum(lower[pairs[:, 0]], lower[pairs[:, 1]])


def search_share(
    decomposition: Decomposition,
    own: Columns,
    bodies: MovingBodies,
    complete: Complete,
    options: SearchOptions,
    estimates: PassEstimates,
    *,
    concurrent_work: Callable[[Share], T],
    sizes: HaloSizes | None = None,
    synchronises: bool = True,
    vertices: Vertices | None = None,
    clock: StageClock | None = None,
    discard: Tensor | None = None,
    slack: float = PASS_SLACK,
    changed: Tensor | None = None,
) -> tuple[Share, T]:
    """Sends ghosts, and starts the search of this rank's share of pairs.

    Args:
        decomposition: of space.
        own: columns of this rank's own bodies, "id" ascending, that are sent for ghosts.
        bodies: the own bodies, made with `wait=False`; `stoppable` for pairs at any times.
        complete: returns the columns of the scene and motion of ghosts, given the sent columns, which their owners have
            validated. They equal the owner's, bit by bit. Deforming bodies also have the columns of their vertices.
        options: of the detection.
        estimates: of the capacities of passes.
        concurrent_work: given the share, enqueues work that runs concurrently with the search of own pairs.
        sizes: capacities of messages, whose unused rows are padding: see `Halo`. By default ranks agree on exact sizes.
        synchronises: False: sizes are given, for a graph. If messages are sent on the stream, nothing synchronises
            then; rows of `own` with id -1, of a negative radius in `bodies`, are padding; the result is incomplete if
            there is `Share.overflow` or a pose is invalid.
        vertices: of the own bodies, if they deform; sizes are exact then.
        clock: records stage times.
        discard, slack: see `find_pass`.
        changed: (N,) uint8: only pairs with a marked body are searched, of this rank or of another. Default: all pairs.

    Returns:
        The share, and the result of `concurrent_work`.

    Raises:
        ValueError: if it synchronises: a pose is invalid.

    Example:
        >>> options, estimates = SearchOptions(), PassEstimates()
        >>> share, _ = search_share(
        ...     decomposition,
        ...     own,
        ...     bodies,
        ...     lambda ghosts: ghosts,
        ...     options,
        ...     estimates,
        ...     concurrent_work=lambda share: None,
        ... )
        >>> share.contacts
    """
    comm, device, distances = decomposition.comm, bodies.device, options.distances

    def stage(name: str) -> AbstractContextManager[None]:
        return nullcontext() if clock is None else clock.stage(name)

    if changed is not None:
        own = own | {"changed": changed}
    halo = Halo(decomposition, own, bodies, distances, sizes, synchronises)
    with stage("halo"):
        halo.find_boundary()
    side = SideStream(device, options.overlap and comm.size > 1)  # waits for the boundary
    if comm.size > 1 and not (sizes is None and side.is_apart):  # exact sizes synchronise: own pairs are searched first
        with side, stage("halo"):
            halo.send()
    if not options.overlap:
        with stage("halo wait"):
            halo.wait()
    with stage("broad"):
        own_pass = find_pass(
            bodies,
            options.query,
            options.broad_phase,
            select=_selecting(options, own["id"], changed),
            discard=discard,
            estimate=estimates.own,
            slack=slack,
            in_other_search=halo.reach if comm.size > 1 else None,
            at_any_times=options.at_any_times,
        )
    own_pairs_found = side.mark()
    own_pass.begin()
    with side, stage("halo wait"):
        held = halo.wait()
    if comm.size == 1:
        alone = halo.sizes(0, [0]) if synchronises else None
        share = Share(held, [own_pass], None, options, halo.overflow, alone)
        return share, concurrent_work(share)
    frame, owner, rank = decomposition.subdomain  # of the neighbours found by the halo
    with side:
        with stage("halo"):
            ghost_vertices = _vertices_of_ghosts(vertices, held, bodies)
            ghosts = _ghosts(held, complete, ghost_vertices, bodies, halo.is_padded)
            if options.at_any_times:
                ghosts = ghosts.stoppable()
            near, near_count = ops.near_ghosts(
                bodies.swept_spheres, halo.reach, ghosts.swept_spheres, *distances, frame, owner, rank
            )
            overflow, exact = halo.overflow, None
            if synchronises:
                numbers = [near_count, held.ghosts_by_source()] if halo.is_padded else [near_count]
                count, *received = HostCopy.start(torch.cat(numbers)).numpy().tolist()
                near, exact = near[:count], halo.sizes(count, received or held.route.received)
            else:
                assert sizes is not None
                overflow = overflow + (near_count > sizes.near)
                near = _first_rows(near[: sizes.near], near_count)
            rows = torch.cat([near, torch.arange(held.own_count, len(held), device=device)])
            both = None
            if vertices is not None and ghost_vertices is not None:
                both = Vertices.join(vertices, ghost_vertices).take(rows)
            at_boundary = _at_boundary(bodies, ghosts, rows, both, is_padded=not synchronises)
            if options.at_any_times:
                at_boundary = at_boundary.stoppable()

            id_of_rows = held.id  # not read unless pairs are excluded
            if options.excluded is not None:
                id_of_rows = torch.cat([held.id, held.id.new_full((1,), -1)])[rows]
            of_rows = None
            if changed is not None:
                of_rows = torch.cat([changed, held.ghosts["changed"], changed.new_zeros(1)])[rows]

            def owned(pairs: Tensor) -> tuple[Tensor, Tensor]:
                spheres = at_boundary.swept_spheres
                found = ops.owned_pairs(pairs, rows, held.id, spheres, *distances, halo.reach, frame, owner, rank)
                select = _selecting(options, id_of_rows, of_rows)
                return found if select is None else select(found[0])

            with_ghosts = find_pass(
                at_boundary,
                options.query,
                options.broad_phase,
                select=owned,
                discard=discard,
                rows=rows,
                estimate=estimates.with_ghosts,
                slack=slack,
                at_any_times=options.at_any_times,
            )
        with side.sharing():
            with_ghosts.begin()
        with stage("halo"):
            side.wait(own_pairs_found)
            share = Share(held, [own_pass, with_ghosts], ghosts, options, overflow, exact)
            made = concurrent_work(share)
    side.join()
    return share, made


def _vertices_of_ghosts(vertices: Vertices | None, held: LocalBodies, bodies: MovingBodies) -> Vertices | None:
    """Vertices of ghosts, if the bodies deform. Waits for them."""
    if vertices is None:
        return None
    return vertices.send(held.route, vertex_counts(bodies.scene.meshes, held.ghosts["mesh_index"]))


def _ghosts(
    held: LocalBodies, complete: Complete, vertices: Vertices | None, bodies: MovingBodies, is_padded: bool
) -> MovingBodies:
    columns = complete(held.ghosts) | ({} if vertices is None else vertices.columns)
    meshes = bodies.scene.meshes
    if is_padded:
        columns["radius"] = meshes.radius.index_select(0, columns["mesh_index"])
        _leave_out(columns, held.ghosts["id"] < 0)
    return MovingBodies.of_columns(meshes, columns, bodies.linear_path)


def _at_boundary(
    bodies: MovingBodies, ghosts: MovingBodies, rows: Tensor, vertices: Vertices | None, is_padded: bool
) -> MovingBodies:
    """Some of the held bodies: `rows` (B,) of own bodies, -1 for padding, then of ghosts."""
    own, more = bodies.columns, ghosts.columns
    columns = dict(zip(own, ops.take_rows(list(own.values()), [more[name] for name in own], rows), strict=True))
    if is_padded:
        _leave_out(columns, rows < 0)
    columns |= {} if vertices is None else vertices.columns
    return MovingBodies.of_columns(bodies.scene.meshes, columns, bodies.linear_path)


def _selecting(options: SearchOptions, id: Tensor, changed: Tensor | None) -> Select | None:
    """Leaves out pairs of rows with these ids (N,) that are excluded, or in which no body has changed (N,)."""
    excluded = options.excluded
    if excluded is None:
        return None if changed is None else partial(_with_changed, changed)
    if changed is None:
        return partial(excluded.leave_out, id)
    return lambda pairs: excluded.leave_out(id, _with_changed(changed, pairs)[0])


def _with_changed(changed: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
    return select_rows(pairs, has_changed(pairs, changed))


def _leave_out(columns: Columns, is_padding: Tensor) -> None:
    """Makes rows of zeros, marked by (N,), bodies that no pair contains: of negative radius, in a valid pose. A pose
    without a unit quaternion has no swept sphere: broad phases would not leave out the NaN that is computed instead,
    and it would hide pairs of other bodies.
    """
    columns["radius"] = columns["radius"].masked_fill(is_padding, -torch.inf)
    columns["orientation_t0"][:, 0].masked_fill_(is_padding, 1.0)


def _first_rows(rows: Tensor, count: Tensor) -> Tensor:
    """The first `count` (1,) of rows (K,), then -1."""
    return torch.where(torch.arange(len(rows), device=rows.device) < count, rows, -1)
