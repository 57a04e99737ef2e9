"""Detection in rounds of resolution, for the bodies of any scene and motion."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.resolution.rounds import Found, found_by
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.memory import memory_limit
from pgccd.search.passes import SearchPass
from pgccd.search.query import Query


@dataclass(eq=False)
class ShortenedSearch:
    """Every round is a detection among all bodies on their shortened paths, broad phase included. It searches only
    pairs with a body that has changed. The pairs of the whole step do not suffice, because their test takes both bodies
    at the same time, and a body that has stopped meets others later than on its whole path.

    Args:
        passes: of the whole step.
        scene, motion: the bodies and their whole step.
        query: options of the search: first contacts.
        broad_phase: as for `detect`.
        invalid: (1,) int64 on the device: nonzero if the bodies are invalid; no pairs are then searched.
        may_wait: whether rounds may synchronise: with exact sizes on a CPU, and on a GPU where memory is short.
            Otherwise sizes are those of the given capacity.
    """

    passes: Sequence[SearchPass]
    scene: Scene
    motion: RigidMotion | VertexMotion
    query: Query
    broad_phase: broad.BroadPhase
    invalid: Tensor
    may_wait: bool
    waits = False

    def find_whole(self) -> list[Found]:
        """As of `RoundSearch`."""
        return found_by(self.passes)

    def look_again(self) -> None:
        """Every round finds its own pairs."""

    def find_round(
        self, changed: Tensor, fraction: Tensor, capacity: BufferSizes, first: Tensor
    ) -> tuple[list[Found], Tensor]:
        """As of `RoundSearch`."""
        motion = shortened(self.scene, self.motion, fraction)
        bodies = MovingBodies.of(self.scene, motion, wait=False)
        made = self._exactly(bodies, changed) if self._must_wait(capacity) else self._within(bodies, changed, capacity)
        return found_by([made]), made.counts()

    def _must_wait(self, capacity: BufferSizes) -> bool:
        if not self.may_wait:
            return False
        device = self.scene.device
        return device.type == "cpu" or capacity.bytes > memory_limit(None, capacity.bytes, device)

    def _exactly(self, bodies: MovingBodies, changed: Tensor) -> SearchPass:
        pairs = torch.empty((0, 2), dtype=torch.int64, device=bodies.device)
        if not int(self.invalid):
            chosen = broad.choose(bodies, self.broad_phase)
            pairs = broad.find_pairs_of_checked(bodies, self.query.min_separation, chosen, self.query.tolerance)
        search_pass = SearchPass(self.query, bodies, pairs[has_changed(pairs, changed)])
        search_pass.find()
        return search_pass

    def _within(self, bodies: MovingBodies, changed: Tensor, capacity: BufferSizes) -> SearchPass:
        pairs, counts = broad.find_pairs_padded(
            bodies, self.query.min_separation, self.broad_phase, capacity, self.invalid, self.query.tolerance
        )
        pairs, count = broad.select_rows(pairs, has_changed(pairs, changed))
        row = COUNT_ROWS["pairs_written"]
        counts[row : row + 1].copy_(count)
        search_pass = SearchPass(self.query, bodies, pairs, counts, capacity=capacity)
        search_pass.start()
        return search_pass


def shortened(scene: Scene, motion: RigidMotion | VertexMotion, fraction: Tensor) -> RigidMotion | VertexMotion:
    """The motion x_i(f_i t) of bodies, given f (N,)."""
    if isinstance(motion, RigidMotion):
        return motion.shortened(fraction)
    return motion.shortened(fraction[body_of_vertex(scene)])


def at_rest(scene: Scene, motion: RigidMotion | VertexMotion) -> Tensor:
    """(N,) bool: the bodies that do not move at all."""
    if isinstance(motion, RigidMotion):
        return ((motion.position_t0 == motion.position_t1) & (motion.rotation == 0.0)).all(dim=1)
    moves = (motion.x_t0 != motion.x_t1).any(dim=1)
    moving = moves.new_zeros(scene.body_count, dtype=torch.int32)
    return moving.index_add_(0, body_of_vertex(scene), moves.int()) == 0


def held_bodies(scene: Scene, motion: VertexMotion, fraction: Tensor) -> Tensor:
    """(N,) bool: the bodies that deform but move by no fraction (N,) of their step: one contact holds a whole body."""
    return (fraction == 0.0) & ~at_rest(scene, motion)


def warn_of_held(body: int, stacklevel: int) -> None:
    """Warns of one of `held_bodies`, in the line that is `stacklevel` calls above this function, itself included."""
    warnings.warn(
        f"resolve: body {body} deforms and has fraction 0: a contact at the start stops all of its vertices. Push the "
        "vertices of contacts apart first, further than thickness and margins, see docs/how-to/cloth.md",
        UserWarning,
        stacklevel,
    )


def body_of_vertex(scene: Scene) -> Tensor:
    """(X,) int64: the body of each vertex of deforming bodies."""
    layout = scene.layout
    vertex = torch.arange(layout.vertex_count, device=scene.device)
    return torch.searchsorted(layout.vertex_begin, vertex, right=True) - 1


def has_changed(pairs: Tensor, changed: Tensor) -> Tensor:
    """(P,) bool: pairs (P, 2) with a body marked by (N,) uint8; rows of -1 have none."""
    marks = torch.cat([changed, changed.new_zeros(1)])  # the last row is that of -1
    return (marks[pairs] != 0).any(dim=1)
