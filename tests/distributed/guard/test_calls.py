"""Ranks that call different things: all raise an error that names the calls, none waits for ever, none is aborted."""

from __future__ import annotations

import itertools
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.forked_job import ForkedJob

import pgccd
from pgccd import distributed
from pgccd.distributed import CapturedWorld, Comm, RankFailureError, World
from pgccd.distributed.guard import Guard, of_all_ranks
from pgccd.distributed.guard.calls import collective

pytestmark = pytest.mark.ranks

STONE = pgccd.Mesh.box([0.6, 0.6, 0.2])
BOX = (0.0,) * 3, (8.0,) * 3


def made(comm: Comm) -> World:
    place = torch.cartesian_prod(*[torch.arange(3.0, dtype=torch.float64)] * 3)[comm.rank :: comm.size]
    id = torch.arange(27)[comm.rank :: comm.size]
    scene = pgccd.Scene([STONE], [0] * len(id))
    return World.create(scene, 1.0 + 2.0 * place, *BOX, id=id, payload={"heat": place[:, 0]}, comm=comm)


def motion_of(bodies: Any) -> pgccd.RigidMotion:
    upright = torch.eye(4, dtype=torch.float64)[:1].expand(len(bodies.id), 4)
    return pgccd.RigidMotion(bodies.position, upright, bodies.position + 0.7 * (4.0 - bodies.position).sign(), upright)


def stay(bodies: Any, motion: Any, toi: Any) -> dict[str, Any]:
    return {"position": bodies.position}


def captured(world: World, folder: str) -> Any:
    return CapturedWorld(world, motion_of, stay).run(2)


NONE = torch.zeros(0, 3, dtype=torch.float64)
#: By the name in messages.
CALLS: dict[str, Callable[[World, str], Any]] = {
    "World.step": lambda world, folder: world.step(motion_of(world)),
    "World.collide": lambda world, folder: world.collide(motion_of(world)),
    "World.move": lambda world, folder: world.move(world.position),
    "World.add": lambda world, folder: world.add(pgccd.Scene([STONE], []), NONE, payload={"heat": NONE[:, 0]}),
    "World.remove": lambda world, folder: world.remove(torch.zeros(0, dtype=torch.int64)),
    "World.save": lambda world, folder: world.save(folder),
    "World.loads": lambda world, folder: world.loads(),
    "World.partition": lambda world, folder: setattr(world, "partition", world.partition),
    "World.create": lambda world, folder: made(world.comm),
    "CapturedWorld.run": captured,
    "Comm.all_gather": lambda world, folder: world.comm.all_gather(torch.arange(5)),
    "Comm.sum": lambda world, folder: world.comm.sum(torch.ones(3)),
    "Comm.min": lambda world, folder: world.comm.min(torch.ones(1)),
    "Comm.barrier": lambda world, folder: world.comm.barrier(),
    "Comm.broadcast": lambda world, folder: world.comm.broadcast(torch.ones(100)),
    "Comm.gather_objects": lambda world, folder: world.comm.gather_objects(["a", "b"]),
}
QUICK = [
    ("World.step", "World.move"),  # messages of other lengths: an error in a thread of Gloo
    ("Comm.all_gather", "Comm.barrier"),  # messages that no rank sends
    ("CapturedWorld.run", "World.step"),
]
ALL = [pair for pair in itertools.permutations(CALLS, 2) if pair not in QUICK]


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def differ(usual: str, other: str, folder: str) -> None:
    with distributed.connect("cpu", timeout=60.0) as comm:
        world = made(comm)
        world.step(motion_of(world))
        begin = time.monotonic()
        try:
            CALLS[other if comm.rank == comm.size - 1 else usual](world, folder)
            for _ in range(3):
                comm.barrier()
        finally:
            say(f"after {time.monotonic() - begin:.1f} s")
    say("went on")


def require_named(usual: str, other: str, size: int, folder: Path) -> None:
    with ForkedJob(size, folder, differ, usual, other, str(folder / "run")) as job:
        codes = job.finish(45.0)
        assert set(codes) <= {1, 70}, (codes, job.said)
        for rank in range(size):
            said = job.said_by(rank)
            named = re.search(
                r"RankFailureError: rank (\d) \(.*\) calls (\S+) where rank (\d) \(.*\) calls (\S+) \(", said
            )
            assert named, said
            of_ranks = dict(zip(named.group(1, 3), named.group(2, 4), strict=True))
            for one, name in of_ranks.items():
                assert name == (other if int(one) == size - 1 else usual)
            assert len(set(of_ranks.values())) == 2
            assert float(re.search(r"after ([\d.]+) s", said).group(1)) < 10.0  # type: ignore[union-attr]
            assert "went on" not in said


@pytest.mark.parametrize(("usual", "other"), QUICK)
def test_different_calls_of_three_ranks_are_named(usual: str, other: str, tmp_path: Path) -> None:
    require_named(usual, other, 3, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize(("usual", "other"), ALL)
def test_all_different_calls_are_named(usual: str, other: str, size: int, tmp_path: Path) -> None:
    require_named(usual, other, size, tmp_path)


def leave_early() -> None:
    with distributed.connect("cpu", timeout=60.0) as comm:
        world = made(comm)
        if comm.rank == 1:
            return
        world.step(motion_of(world))


def test_a_rank_that_leaves_out_the_last_call_is_named(tmp_path: Path) -> None:
    with ForkedJob(3, tmp_path, leave_early) as job:
        codes = job.finish(45.0)
        assert codes[1] == 0 and codes[0] in (1, 70) and codes[2] in (1, 70), (codes, job.said)
        expected = r"RankFailureError: rank 1 has ended early, after 1 calls, where rank [02] \(.*\) calls World.step"
        assert all(re.search(expected, job.said_by(rank)) for rank in (0, 2)), job.said


def catch(is_on_all: bool) -> None:
    with distributed.connect("cpu", timeout=60.0) as comm:
        world = made(comm)
        motion = motion_of(world)
        if is_on_all or comm.rank == 1:
            motion.position_t1[0, 1] = torch.nan
        try:
            world.step(motion)
        except ValueError as error:
            say(f"caught {error}")
        time.sleep(0.3 * comm.rank)  # ranks need not do it at the same time
        assert comm.all_gather(torch.tensor([comm.rank])).tolist() == [[0], [1], [2]]
    say("went on")


@pytest.mark.parametrize("is_on_all", [True, False])
def test_a_pose_error_that_is_caught_leaves_no_rank_waiting(is_on_all: bool, tmp_path: Path) -> None:
    with ForkedJob(3, tmp_path, catch, is_on_all) as job:
        codes = job.finish(45.0)
        if is_on_all:
            assert codes == [0, 0, 0] and job.said.count("went on") == 3, job.said
            return
        assert None not in codes and 0 not in codes and -6 not in codes, (codes, job.said)
        for rank in range(3):
            assert re.search(r"RankFailureError: rank 1 \(.*\) failed in World.step: ValueError: ", job.said_by(rank))


class Recorder(Guard):
    """A guard that records what it would tell the hub."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []
        self._channel = self  # type: ignore[assignment]

    def send(self, **message: Any) -> bool:
        if message["about"] == "calls":
            self.told += message["names"]
        else:
            self.told.append(str(message["text"]))
        self._noted.set()
        return True


class Loop:
    """Two calls, of which one makes the other; they raise the error that they are given."""

    def __init__(self) -> None:
        self.guard = Recorder()

    @collective
    def run(self, error: Exception | None = None) -> str:
        self.turn(error)
        return "made"

    @collective
    def turn(self, error: Exception | None = None) -> None:
        if error is not None:
            raise error


RUN, TURN = (f"{Loop.__qualname__}.{name}" for name in ("run", "turn"))


def test_only_the_outermost_call_counts() -> None:
    loop = Loop()
    assert loop.run() == "made"
    loop.turn()
    loop.guard._tell_calls()
    assert loop.guard.told == [RUN, TURN]
    with pytest.raises(ValueError, match="of all"):
        loop.run(of_all_ranks(ValueError("of all")))
    loop.run()  # an error of all ranks leaves nothing to wait for
    loop.guard._tell_calls()
    assert loop.guard.told[2:] == [RUN, "None", RUN]
    with pytest.raises(RankFailureError):
        loop.run(RankFailureError("another"))
    with pytest.raises(ValueError, match="one"):
        loop.run(ValueError("one"))
    assert loop.guard.told[5:] == [RUN, RUN, "ValueError: one"]


def test_one_rank_tells_nothing() -> None:
    comm = distributed.Alone()
    assert comm.any(True) and comm.guard._calls == 0


def test_an_error_is_told_with_the_call_that_raised_it() -> None:
    loop, of_call, of_user = Loop(), ValueError("1"), ValueError("2")
    loop.guard.report(of_user)
    loop.turn()
    loop.guard.report(of_user)
    with pytest.raises(ValueError, match="1"):
        loop.turn(of_all_ranks(of_call))
    loop.guard.report(of_call)
    loop.guard.activity = "step 3"  # a part of the call
    loop.guard.report(of_call)
    loop.guard.report(of_user)
    assert [text for text in loop.guard.told if text.startswith("failed")] == [
        "failed in the start: ValueError: 2",
        f"failed in its own code, after {TURN}: ValueError: 2",
        f"failed in {TURN}: ValueError: 1",
        "failed in step 3: ValueError: 1",
        "failed in its own code, after step 3: ValueError: 2",
    ]
