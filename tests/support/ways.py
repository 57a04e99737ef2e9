"""All ways to find the contacts of a scene: threads, broad phases, chunks, given pairs, fixed capacity, captured steps,
devices and ranks. Each must give the bits of one thread of a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

import pgccd
from pgccd.distributed import BalanceOptions, Comm, World, WorldOptions
from support.hard_scenes import hard_scene
from support.random_scenes import RandomScene
from support.ranks import RankPool
from support.reports import captured_loop, detected, of_contacts, stepped, trimmed
from support.same_bits import columns_of, difference, first_rows

Columns = dict[str, Tensor]
THREADS = 3


@dataclass
class Difference:
    """A way whose result is not that of one thread of a CPU."""

    scene: RandomScene
    way: str
    said: str

    def __str__(self) -> str:
        return f"{self.scene}\n  {self.way}: {self.said}"


def reference(scene: RandomScene) -> pgccd.Contacts:
    """The contacts by one thread of a CPU, in one piece, by the sweep."""
    with threads_set(1):
        return detected(scene.scene(), scene.motion(), broad_phase="sweep", **scene.arguments)


def differences(
    scenes: Iterable[RandomScene], devices: Iterable[str], pool: RankPool | None, ranks: int
) -> list[Difference]:
    """What the ways of finding contacts do not agree upon.

    Args:
        scenes: a batch; each number of ranks is asked once for all of them.
        devices: "cpu", "cuda".
        pool: of processes, if `ranks` is not 0.
        ranks: the largest number of ranks.
    """
    scenes, devices = list(scenes), list(devices)
    found: list[Difference] = []
    expected: list[Columns] = []
    for scene in scenes:
        with _named(scene):
            contacts, others = reference(scene), derived(scene, "cpu")
        expected.append(columns_of(contacts))
        with _named(scene):
            said = _not_of_all(scene, contacts)
        if said is not None:
            found.append(Difference(scene, "of all contacts", said))
        for way, columns in all_ways(scene, contacts, devices):
            said = columns if isinstance(columns, str) else difference(columns, expected[-1])
            if said is not None:
                found.append(Difference(scene, way, said))
        for device in devices:
            with _named(scene):
                said = difference(derived(scene, device), others) if device != "cpu" else None
            if said is not None:
                found.append(Difference(scene, f"derived values, {device}", said))
    if pool is not None:
        found += of_ranks(scenes, devices, pool, ranks, expected)
    return found


def of_ranks(
    scenes: list[RandomScene],
    devices: Iterable[str],
    pool: RankPool,
    ranks: int,
    expected: list[Columns] | None = None,
) -> list[Difference]:
    """As `differences`, of 1 to `ranks` ranks alone; `expected`: columns of the `reference` of each scene."""
    expected = [columns_of(reference(scene)) for scene in scenes] if expected is None else expected
    found: list[Difference] = []
    for size in range(1, ranks + 1):
        for device in devices:
            answers = pool.run(size, on_rank, [scene.seed for scene in scenes], device)
            for k, scene in enumerate(scenes):
                for rank, answer in enumerate(answers):
                    said = of_rank(scene, expected[k], *answer[k])
                    if said is not None:
                        found.append(Difference(scene, f"rank {rank} of {size}, {device}", said))
    return found


def _not_of_all(scene: RandomScene, found: pgccd.Contacts | pgccd.CollidingPairs) -> str | None:
    """What of a report is not selected from the contacts of report "all"; None for trajectories."""
    report = scene.arguments["report"]
    if report == "all" or isinstance(scene.motion(), pgccd.Trajectory):
        return None
    arguments = scene.arguments | {"report": "all"} | ({"nonzero_toi": False} if report == "any" else {})
    every = pgccd.detect(scene.scene(), scene.motion(), **arguments)
    expected = columns_of(every[first_rows(every, report)])
    return difference(columns_of(found), {name: expected[name] for name in found.columns})


def all_ways(scene: RandomScene, whole: pgccd.Contacts, devices: Iterable[str]) -> Iterator[tuple[str, Columns | str]]:
    """The columns by each way, or an error."""
    for device in devices:
        for name, way in _ways(scene, whole, device):
            try:
                yield f"{name}, {device}", columns_of(way())
            except Exception as error:
                yield f"{name}, {device}", f"{type(error).__name__}: {error}"


def _ways(scene: RandomScene, whole: pgccd.Contacts, device: str) -> Iterator[tuple[str, Callable[[], pgccd.Contacts]]]:
    bodies, motion = scene.scene(device), scene.motion(device)
    detect = partial(detected, bodies, motion, **scene.arguments)
    if device == "cpu":

        def threads() -> pgccd.Contacts:
            with threads_set(THREADS):
                return detect()

        yield "threads", threads
    for broad_phase in ("sweep", "grid", "lbvh"):
        yield broad_phase, partial(detect, broad_phase=broad_phase)
    for budget in (1, 30_000):
        yield f"chunks of {budget} bytes", partial(detect, memory_budget=budget)
    if isinstance(motion, pgccd.Trajectory):
        return
    separation, tolerance = scene.arguments["min_separation"], scene.arguments["tolerance"]
    moving = pgccd.MovingBodies.of(bodies, motion)
    pairs = pgccd.broad.find_pairs(moving, separation, "lbvh", tolerance)
    yield "given pairs", partial(detect, pairs=pairs)
    yield "given pairs in chunks", partial(detect, pairs=pairs, memory_budget=1)
    on_device = whole if device == "cpu" else detect()
    needed = on_device.stats.needed
    assert needed is not None
    yield "fixed capacity", lambda: detect(capacity=needed.times(1.5)).trim()
    yield "given pairs in a fixed capacity", lambda: detect(pairs=pairs, capacity=needed.times(1.5)).trim()

    def captured() -> pgccd.Contacts:
        loop = captured_loop(bodies, motion, **scene.arguments)
        loop(motion)
        loop(motion)
        return trimmed(loop)

    yield "captured", captured


def derived(scene: RandomScene, device: str) -> Columns:
    """What is computed beside contacts: poses between the ends, first times, elementary tests."""
    bodies, motion = scene.scene(device), scene.motion(device)
    generator = torch.Generator().manual_seed(scene.seed)
    columns = {}
    step = motion.segment(0) if isinstance(motion, pgccd.Trajectory) else motion
    times = torch.rand((3, 1), generator=generator, dtype=torch.float64)
    if isinstance(step, pgccd.VertexMotion):
        columns["vertices"] = step.at(times)
        ends = step.x_t0, step.x_t1
    else:
        ends = step.position_t0, step.position_t1
        columns["rotation"] = step.rotation
        columns["orientation"] = pgccd.integrate_orientation(step.orientation_t0, step.rotation)
        if step.path == "rigid":
            columns["position at"], columns["orientation at"] = step.at(times)
    if scene.arguments["report"] != "any":
        hits = pgccd.detect(bodies, motion, **scene.arguments)
        columns |= {f"first of {by}": hits.first_toi(by).reshape(-1) for by in ("scene", "world", "body")}
    # Queries of points of the scene, some of which repeat.
    rows = torch.randint(len(ends[0]), (50, 4), generator=generator).to(device)
    for dtype in (torch.float64, torch.float32):
        points = [end[rows].to(dtype) for end in ends]
        for test in (pgccd.narrow.vertex_face, pgccd.narrow.edge_edge):
            answer = test(*points, scene.arguments["min_separation"], 1e-3, scene.arguments["nonzero_toi"])
            given = {name: column for name, column in vars(answer).items() if isinstance(column, Tensor)}
            columns |= {f"{test.__name__} {dtype} {name}": column for name, column in given.items()}
    return {name: column.cpu() for name, column in columns.items()}


def on_rank(comm: Comm, seeds: list[int], device: str) -> list[tuple[Tensor, Columns]]:
    """For each scene the bodies that this rank owns, and their contacts, with ids in `pairs`."""
    answers = []
    for seed in seeds:
        scene = hard_scene(seed)
        with _named(scene):
            world = world_of(comm, scene, device)
            own = body_of(world.id.cpu())
            answers.append((own, columns_of(stepped(world, scene.motion(device, own), scene.arguments["report"]))))
    return answers


def world_of(comm: Comm, scene: RandomScene, device: str) -> World:
    """The scene's bodies distributed at random; for even seeds by cells with random owners."""
    generator = torch.Generator().manual_seed(scene.seed)
    position, count = scene.position(), len(scene.mesh_index)
    mine = torch.nonzero(torch.randint(comm.size, (count,), generator=generator) == comm.rank)[:, 0].flip(0)
    by_cells = scene.seed % 2 == 0
    exclude = None
    if scene.exclude is not None and (comm.rank or comm.size == 1):  # the pairs of all ranks count
        exclude = _id_of(scene.exclude).to(device)[max(0, comm.rank - 1) :: max(1, comm.size - 1)]
    filters: Any = {name: column[mine] for name, column in scene.filters.items()}
    options = WorldOptions(
        path="linear" if scene.kind == "linear" else "rigid",
        partition="cells" if by_cells else "bisection",
        balance=BalanceOptions("none"),
        overlap=scene.seed % 3 == 0,
        **({"cells": 3} if by_cells else {}),
        **(scene.arguments | {"report": of_contacts(scene.arguments["report"])}),
    )
    world = World.create(
        pgccd.Scene(scene.meshes, scene.mesh_index[mine], **filters).to(device),
        position[mine].to(device),
        tuple((position.amin(dim=0) - 1.0).tolist()),
        tuple((position.amax(dim=0) + 1.0).tolist()),
        id=_id_of(mine).to(device),
        exclude=exclude,
        comm=comm,
        options=options,
    )
    if by_cells:
        owner = torch.randint(comm.size, (world.partition.cell_count,), generator=generator).to(device)
        world.partition = world.partition.with_owner(owner)
        world.move(world.position)
    return world


def of_rank(scene: RandomScene, whole: Columns, own: Tensor, found: Columns) -> str | None:
    """The difference between the contacts found by a rank, see `on_rank`, and those of all bodies."""
    concerns = torch.isin(whole["pairs"], own).any(dim=1)
    if scene.arguments["report"] == "earliest":
        concerns[:] = True  # it is told to every rank
    expected = {name: column[concerns] for name, column in whole.items()}
    return difference(found | {"pairs": body_of(found["pairs"])}, expected)


def _id_of(body: Tensor) -> Tensor:
    return 5 * body + 2


def body_of(id: Tensor) -> Tensor:
    return torch.div(id - 2, 5, rounding_mode="floor")


@contextmanager
def _named(scene: RandomScene) -> Iterator[None]:
    """Errors name the scene."""
    try:
        yield
    except Exception as error:
        raise RuntimeError(str(scene)) from error


@contextmanager
def threads_set(count: int) -> Iterator[None]:
    """Sets the number of threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
