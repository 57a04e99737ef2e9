"""Elementary queries (vertex-face, edge-edge) with pgccd and with ipctk's methods: results and single-thread times.

Mean times are from whole batches of one kind. Times of single queries, for percentiles, are from calls with one query,
the fastest of three, less the cost of an empty call; Python code between the queries evicts caches, so they are
pessimistic.

pgccd runs twice: in float64, and in float32 on rounded points. The float32 reference is the float64 result on the
rounded points, which are exact in float64: a miss in float32 is a contact that float64 finds at the same points.

ipctk is called query by query for its results and the times of colliding queries (less the cost of a call with a query
at rest). Its mean for free queries is from one C++ call over all queries that it finds free.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import pgccd
from pgccd import ops
from support import timing

#: Points (n, 8, 3): the four points at t0, then at t1.
Queries = np.ndarray

#: Of the arithmetics that may decide a query: float32, float64 and double-double.
SIGNIFICANT_BITS = (24, 53, 106)


@dataclass
class Answers:
    """Results of n queries."""

    collides: np.ndarray  #: (n,) bool
    unresolved: int
    seconds: np.ndarray  #: (n,) per query


@dataclass
class Batch:
    """pgccd's results for n queries in one call."""

    status: np.ndarray  #: (n,) int8
    significant_bits: np.ndarray  #: (n,) int8
    seconds: float  #: of the call

    @property
    def collides(self) -> np.ndarray:
        """Colliding queries (n,) bool; unresolved ones count."""
        return self.status != pgccd.Status.FREE


class Pgccd:
    """pgccd's elementary tests on points rounded to `dtype`."""

    def __init__(self, kind: str, tolerance: float, dtype: type[np.floating] = np.float64) -> None:
        self.name = "pgccd" if dtype is np.float64 else f"pgccd {np.dtype(dtype).name}"
        self._kind = kind
        self._operator = ops.vertex_face if kind == "vf" else ops.edge_edge
        self._tolerance = tolerance
        self._dtype = dtype

    def batch(self, points: Queries) -> Batch:
        """All queries in one call."""
        ends = _ends(points, self._dtype)
        seconds, found = timing.seconds(lambda: self._operator(*ends, 0.0, self._tolerance, False))
        status, _, _, significant_bits = (column.numpy() for column in found)
        return Batch(status, significant_bits, seconds)

    def truth(self, points: Queries, known: np.ndarray) -> np.ndarray:
        """Which queries (n,) bool collide after rounding; `known` is the truth for the points as given."""
        if self._dtype is np.float64:
            return known
        return Pgccd(self._kind, self._tolerance).batch(points.astype(self._dtype)).collides

    def mean_seconds(self, points: Queries, rounds: int = 20) -> float | None:
        """Seconds per query: median over rounds, each in another order."""
        if len(points) == 0:
            return None
        random = np.random.default_rng(0)
        spent = [self.batch(points[random.permutation(len(points))]).seconds for _ in range(rounds + 2)][2:]
        return max(0.0, float(np.median(spent)) - self.overhead()) / len(points)

    def overhead(self) -> float:
        """Seconds of an empty call."""
        nothing = np.empty((0, 8, 3))
        return float(np.median([self.batch(nothing).seconds for _ in range(200)]))

    def single_seconds(self, points: Queries) -> np.ndarray:
        """(n,) seconds of calls with one query."""
        start, end = _ends(points, self._dtype)
        rows = [(start[k : k + 1], end[k : k + 1]) for k in range(len(points))]
        best = np.full(len(points), np.inf)
        for _ in range(3):
            for k, row in enumerate(rows):
                begin = time.perf_counter()
                self._operator(*row, 0.0, self._tolerance, False)
                best[k] = min(best[k], time.perf_counter() - begin)
        none = (start[:0], end[:0])
        overhead = np.median(
            [timing.seconds(lambda: self._operator(*none, 0.0, self._tolerance, False))[0] for _ in range(500)]
        )
        return np.maximum(best - overhead, 0.0)


class Ipctk:
    """One of ipctk's narrow phases."""

    def __init__(self, ipctk: Any, name: str, method: Any, kind: str) -> None:
        self.name = name
        self._ipctk = ipctk
        self._method = method
        self._kind = kind
        self._call: Callable[..., tuple[bool, float]] = (
            method.point_triangle_ccd if kind == "vf" else method.edge_edge_ccd
        )
        # This method returns at once for a query at rest, so only the call is timed.
        at_rest = ipctk.AdditiveCCD()
        self._empty = at_rest.point_triangle_ccd if kind == "vf" else at_rest.edge_edge_ccd

    def ask(self, points: Queries) -> Answers:
        """Results and times query by query."""
        rows = [list(query) for query in points]
        still = [row[:4] + row[:4] for row in rows[:2000]]
        overhead = float(np.median([_timed_call(self._empty, row)[0] for row in still])) if still else 0.0
        answered = [_timed_call(self._call, row) for row in rows]
        seconds = np.array([spent for spent, _ in answered]) - overhead
        return Answers(np.array([hit for _, (hit, _) in answered], dtype=bool), 0, np.maximum(seconds, 0.0))

    def mean_seconds_free(self, points: Queries, rounds: int = 5) -> float | None:
        """Seconds per query over queries that this method finds free, in one call."""
        count = len(points)
        if count == 0:
            return None
        ipctk, corner = self._ipctk, np.arange(4 * count, dtype=np.int32).reshape(-1, 4)
        start, end = (np.asfortranarray(points[:, k : k + 4].reshape(-1, 3)) for k in (0, 4))
        candidates = ipctk.Candidates()
        if self._kind == "vf":
            faces = corner[:, 1:]
            mesh = ipctk.CollisionMesh(start, ipctk.edges(np.asfortranarray(faces)), np.asfortranarray(faces))
            candidates.fv_candidates = [ipctk.FaceVertexCandidate(k, 4 * k) for k in range(count)]
        else:
            mesh = ipctk.CollisionMesh(start, np.asfortranarray(corner.reshape(-1, 2)))
            candidates.ee_candidates = [ipctk.EdgeEdgeCandidate(2 * k, 2 * k + 1) for k in range(count)]
        spent = []
        for _ in range(rounds):
            seconds, step = timing.seconds(
                lambda: candidates.compute_collision_free_stepsize(mesh, start, end, 0.0, self._method)
            )
            if step < 1.0:
                raise AssertionError(f"{self.name} finds a collision among queries that it found free")
            spent.append(seconds)
        return float(np.median(spent)) / count


def pgccd_methods(kind: str, tolerance: float) -> list[Pgccd]:
    """pgccd in both precisions."""
    return [Pgccd(kind, tolerance, dtype) for dtype in (np.float64, np.float32)]


def peers_of(ipctk: Any | None, kind: str, tolerance: float) -> list[Ipctk]:
    """ipctk's methods that bound the motion; none if it is not installed."""
    if ipctk is None:
        return []
    # Without rescaling Tight-Inclusion answers the query "do they touch?". Additive CCD requires rescaling; it uses the
    # default.
    tight = ipctk.TightInclusionCCD(tolerance=tolerance, conservative_rescaling=1.0)
    return [
        Ipctk(ipctk, "Tight-Inclusion", tight, kind),
        Ipctk(ipctk, "Additive CCD", ipctk.AdditiveCCD(), kind),
    ]


def _ends(points: Queries, dtype: type[np.floating]) -> tuple[torch.Tensor, torch.Tensor]:
    start, end = (torch.from_numpy(np.ascontiguousarray(points[:, k : k + 4], dtype=dtype)) for k in (0, 4))
    return start, end


def _timed_call(call: Callable[..., tuple[bool, float]], row: list[np.ndarray]) -> tuple[float, tuple[bool, float]]:
    begin = time.perf_counter()
    answer = call(*row)
    return time.perf_counter() - begin, answer
