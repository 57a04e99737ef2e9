"""Ranks started with different settings all end at once, with a one-line error that names the setting."""

from __future__ import annotations

import functools
import hashlib
import itertools
import os
import re
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from support.cases import mostly_slow
from support.forked_job import ForkedJob, command_line
from support.launch import ROOT, finish, mpirun, torchrun
from support.ranks import RankPool

import pgccd
from pgccd.distributed import Alone, CapturedWorld, Comm, World
from pgccd.distributed.launch import agreement, code
from pgccd.distributed.launch.agreement import PROBLEM, DisagreementError, agree_by_store
from pgccd.distributed.launch.placement import Placement

SETTINGS = {"--robots": "100", "--seed": "1", "device": "cpu"}


def compare(of_ranks: list[dict[str, str]], timeout: float = 20.0) -> list[str]:
    """The error of each rank; empty if there is none."""
    store = dist.HashStore()

    def of_rank(rank: int) -> str:
        try:
            agree_by_store(store, Placement("torchrun", rank, len(of_ranks), 0), of_ranks[rank], timeout)
        except DisagreementError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(len(of_ranks)) as threads:
        return list(threads.map(of_rank, range(len(of_ranks))))


def test_equal_settings_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agreement, "_KEYS_AT_A_TIME", 2)
    assert compare([SETTINGS] * 5) == [""] * 5


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("odd", [0, 1, 4])
def test_the_setting_and_two_ranks_are_named(name: str, odd: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agreement, "_KEYS_AT_A_TIME", 2)
    of_ranks = [SETTINGS | ({name: "other"} if rank == odd else {}) for rank in range(5)]
    first, other = of_ranks[0][name], of_ranks[odd or 1][name]
    assert compare(of_ranks) == [f"{name}: rank 0 has {first}, rank {odd or 1} has {other}"] * 5


def test_a_setting_that_one_rank_lacks() -> None:
    assert compare([SETTINGS, {"device": "cpu"}]) == ["--robots: rank 0 has 100, rank 1 has nothing"] * 2


def test_the_problem_of_one_rank_ends_all() -> None:
    of_ranks = [SETTINGS, SETTINGS, {PROBLEM: "argument --steps: no number"}]
    assert compare(of_ranks) == ["rank 2: argument --steps: no number"] * 3


def test_ranks_that_do_not_come_are_named() -> None:
    with pytest.raises(RuntimeError, match=r"^ranks \[1, 2\] of 3 did not connect within 0.2 s$"):
        agree_by_store(dist.HashStore(), Placement("torchrun", 0, 3, 0), SETTINGS, 0.2)


def test_code_is_compared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    facts = code.code_facts()
    assert {"pgccd", "torch", "numpy", "pgccd's .py files", "C++ sources of pgccd's build"} <= set(facts)
    assert facts["C++ sources of pgccd's build"] == digest_sources()
    package = Path(code.pgccd.__file__).parent
    shutil.copytree(package, tmp_path / "pgccd", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    same = code.digest_of_files(tmp_path / "pgccd")
    assert same == facts["pgccd's .py files"]
    (tmp_path / "pgccd" / "notes.txt").write_text("not code")
    assert code.digest_of_files(tmp_path / "pgccd") == same
    changed = tmp_path / "pgccd" / "sim" / "response.py"
    changed.write_text(changed.read_text() + " ")
    other = code.digest_of_files(tmp_path / "pgccd")
    assert other != same
    facts_of_other = facts | {"pgccd's .py files": other}
    assert compare([facts, facts_of_other]) == [f"pgccd's .py files: rank 0 has {same}, rank 1 has {other}"] * 2
    changed.rename(changed.with_name("answer.py"))
    assert code.digest_of_files(tmp_path / "pgccd") not in (same, other)


def digest_sources() -> str:
    """As build_support.extensions, which needs a compiler."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "csrc").rglob("*")):
        if path.suffix in (".h", ".cpp", ".cu", ".cuh"):
            name = path.relative_to(ROOT).as_posix()
            digest.update(f"{name}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def scale(bodies: float, by: float) -> float:
    return bodies * by


class Response:
    def __init__(self, by: float) -> None:
        self.by = by

    def __call__(self, bodies: float) -> float:
        return bodies * self.by

    def method(self, bodies: float) -> float:
        return bodies + self.by


def closed_over(function: Callable[..., float]) -> Callable[[float], float]:
    return lambda bodies: function(bodies, 2.0)


def times(by: float) -> Callable[[float], float]:
    return lambda bodies: bodies * by


def function_with(known: dict[str, Any]) -> Callable[[Any], Any]:
    """A function with globals of its own."""
    known = {"__name__": "job"} | known
    for each in known.values():
        if callable(each):
            each.__module__ = "job"
    exec("def step(bodies):\n    return [helper(each) * factor for each in bodies.unused]", known)
    return known["step"]


def test_functions_are_compared_by_their_code() -> None:
    different: list[Callable[..., Any]] = [
        lambda bodies: bodies * 0.9,
        lambda bodies: bodies * 0.8,
        lambda bodies: bodies + 0.9,
        lambda other: other,
        lambda bodies: bodies in {"a", "b"},
        lambda bodies: bodies in {"a", "c"},
        lambda bodies: (lambda: bodies * 3)(),
        lambda bodies: (lambda: bodies * 4)(),
        scale,
        functools.partial(scale, by=2.0),
        functools.partial(closed_over, scale),
        functools.partial(closed_over, max),
        closed_over(scale),
        closed_over(max),
        Response(1.0),
        Response(1.0).method,
        Response,
        torch.nn.Linear(1, 1),
        max,
        torch.abs,
        # What they use: values and functions in closures, defaults, arguments and globals.
        functools.partial(scale, by=3.0),
        times(0.5),
        times(0.25),
        lambda bodies, by=0.5: bodies * by,
        lambda bodies, by=0.25: bodies * by,
        lambda bodies, *, by=0.5: bodies * by,
        lambda bodies, *, by=0.25: bodies * by,
        lambda bodies, *, by=scale: by(bodies, 2.0),
        lambda bodies, *, by=max: by(bodies, 2.0),
        lambda bodies, by={"x": 1.0}: bodies * by["x"],  # noqa: B006
        lambda bodies, by={"x": 2.0}: bodies * by["x"],  # noqa: B006
        *(function_with({"factor": factor}) for factor in (1.0, 2.0, True, (1, 2), (1, 3))),
        *(
            function_with({"factor": factor})
            for factor in ([1, 2], [1, 3], {"x": 1.0}, {"x": 2.0}, {"y": 1.0}, {1: 1.0})
        ),
        *(function_with({"factor": {"x": (within, {"y": within})}}) for within in (1.0, 2.0)),
        *(function_with({"factor": {"x": helper}}) for helper in (times(1), times(2))),
        functools.partial(scale, by={"x": 1.0}),
        functools.partial(scale, by={"x": 2.0}),
        *(function_with({"factor": 1.0, "helper": helper}) for helper in (times(1), times(2))),
    ]
    assert len({code.code_of(function).partition(" ")[2] for function in different}) == len(different)
    # Equal wherever it stands, and whatever objects and texts it holds, which may differ between ranks.
    same = lambda bodies: bodies * 0.9  # noqa: E731
    assert code.code_of(same).partition(" ")[2] == code.code_of(different[0]).partition(" ")[2]
    for one, other in [
        ({"factor": torch.zeros(1)}, {"factor": torch.ones(1)}),
        ({"factor": "cuda:0"}, {"factor": "cuda:1"}),
        ({"factor": 1.0, "unused": 1.0}, {"factor": 1.0, "unused": 2.0}),
        ({"factor": {"x": 1.0, "y": 2.0}}, {"factor": {"y": 2.0, "x": 1.0}}),
        ({"factor": {"x": torch.zeros(1), "y": "a"}}, {"factor": {"x": torch.ones(1), "y": "b"}}),
        ({"factor": {torch.device("cuda", 0): 1.0}}, {"factor": {torch.device("cuda", 1): 2.0}}),
    ]:
        assert code.code_of(function_with(one)) == code.code_of(function_with(other))
    assert code.code_of(Response(2.0)) == code.code_of(Response(1.0))
    within_itself: dict[str, Any] = {"x": 1.0}
    within_itself["self"] = within_itself
    assert code.code_of(function_with({"factor": within_itself}))


def code_of_set(_: Comm) -> tuple[str, int]:
    known: dict[str, Any] = {"__name__": "__main__"}
    exec(compile("f = lambda bodies: bodies in {'a', 'b', 'c', 'd', 'e'}", "<string>", "exec"), known)
    return code.code_of(known["f"]), hash("a")


@pytest.mark.skipif(bool(os.environ.get("PYTHONHASHSEED")), reason="sets have the same order in all processes")
def test_sets_of_strings_have_another_order_in_another_process(ranks: RankPool) -> None:
    (found, seed), (here, other_seed) = *ranks.run(1, code_of_set), code_of_set(Alone())
    assert seed != other_seed and found == here and "<lambda> (" in found, found


def run_different_code(comm: Comm, odd: str) -> str:
    mesh = pgccd.Mesh.box([1.0, 1.0, 1.0])
    dtype = torch.float32 if odd == "dtype" and comm.rank == 1 else torch.float64
    position = torch.tensor([[3.0 * comm.rank, 0.0, 0.0]], dtype=dtype)
    id = torch.tensor([comm.rank])
    try:
        world = World.create(pgccd.Scene([mesh]), position, (-1.0, -1.0, -1.0), (9.0, 1.0, 1.0), id=id, comm=comm)
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)

        def motion(bodies: Any) -> pgccd.RigidMotion:
            q = upright.expand(len(bodies.id), 4)
            return pgccd.RigidMotion(bodies.position, q, bodies.position + 0.1, q)

        functions = [lambda bodies, moving, toi: {"position": moving.at(1.0)[0]}]
        functions.append(lambda bodies, moving, toi: {"position": moving.at(0.5)[0]})
        response = functions[comm.rank if odd == "lambda" else 0]
        if odd == "partial":
            response = functools.partial(functions[comm.rank])
        CapturedWorld(world, motion, response).run(2)
    except DisagreementError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ("nothing", ""),
        ("dtype", "position: rank 0 has .*float64.*, rank 1 has .*float32"),
        ("lambda", "response: rank 0"),
    ]
    + [("partial", "response: rank 0 has 'partial .*, rank 1 has 'partial")],
)
def test_what_ranks_pass_to_a_world_is_compared(odd: str, said: str, ranks: RankPool) -> None:
    for found in ranks.run(2, run_different_code, odd):
        assert re.match(said, found) and bool(found) == bool(said), found


def of_another_version(package: str, *arguments: str) -> int:
    """`pgccd`, on rank 1 from another folder."""
    if os.environ["RANK"] == "1":
        pgccd.__file__ = f"{package}/__init__.py"
    return command_line(*arguments)


def test_another_version_of_a_file_on_one_rank(tmp_path: Path) -> None:
    """Of one machine in a cluster whose installation is older."""
    shutil.copytree(ROOT / "pgccd", tmp_path / "pgccd", ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    with open(tmp_path / "pgccd" / "sim" / "response.py", "a") as file:
        file.write("# newer\n")
    options = ["simulate", "--robots", "9", "--steps", "1", "--out", str(tmp_path / "run")]
    with ForkedJob(2, tmp_path / "said", of_another_version, str(tmp_path / "pgccd"), *options) as started:
        assert started.finish() == [2, 2], started.said
    said = r"pgccd simulate: error: pgccd's .py files: rank 0 has \w{16}, rank 1 has \w{16}"
    assert re.search(said, started.said) and not (tmp_path / "run").exists(), started.said


# Options of rank 1, and the error that all ranks print.
OPTIONS = {
    "--robots 0": "rank 1: argument --robots: expected at least 1, got 0",
    "--steps x": "rank 1: argument --steps: invalid int value: 'x'",
    "--seed 5": "--seed: rank 0 has None, rank 1 has 5",
    "--transport mpi4py": "--transport: rank 0 has auto, rank 1 has mpi4py",
    "--timeout 40": "--timeout: rank 0 has 30.0, rank 1 has 40.0",
    "--no-pictures": "--no-pictures: rank 0 has False, rank 1 has True",
    "--resume auto": "--resume: rank 0 has None, rank 1 has auto",
    "--resume elsewhere": "rank 1: argument --robots: not allowed with --resume",
    "--overwrite": "--overwrite: rank 0 has False, rank 1 has True",
    "--device meta": "device: rank 0 has cpu, rank 1 has meta",
    "--device nothing": "rank 1: device: ",
    "--balance none": "--balance: rank 0 has cost, rank 1 has none",
    "--checkpoint-every 3": "--checkpoint-every: rank 0 has 0, rank 1 has 3",
    "--out elsewhere": "--out: rank 0 has None, rank 1 has elsewhere",
    "--unknown": "rank 1: unrecognized arguments: --unknown",
}
LAUNCHERS = ("forked", "torchrun", "mpirun")
OF_EVERY_RUN = [("forked", "--robots 0"), ("forked", "--seed 5"), ("mpirun", "--steps x")]


def with_an_option(option: str) -> int:
    """`pgccd`, on rank 1 with an option more."""
    more = option.split() if os.environ["RANK"] == "1" else []
    return command_line("simulate", "--robots", "100", "--steps", "3", "--timeout", "30", *more)


@pytest.mark.parametrize(("launcher", "option"), mostly_slow(itertools.product(LAUNCHERS, OPTIONS), OF_EVERY_RUN))
def test_options_that_differ_between_started_ranks(
    launcher: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    variable = "RANK" if launcher == "torchrun" else "{PMI_RANK:-$OMPI_COMM_WORLD_RANK}"
    odd = f'$([ "${variable}" = 1 ] && echo "{option}")'
    shell = f'cd {tmp_path}; exec "$PYTHON" -m pgccd simulate --robots 100 --steps 3 --timeout 30 {odd}'
    begin = time.monotonic()
    if launcher == "forked":
        with ForkedJob(2, tmp_path / "said", with_an_option, option) as started:
            codes, said = started.finish(), started.said
        assert codes == [2, 2], said
    elif launcher == "torchrun":
        done = finish(torchrun(2, "--no-python", "bash", "-c", shell), PYTHON=sys.executable)
        assert done.returncode != 0
        said = done.stdout
    else:
        command = mpirun(2, "-c", shell)
        command[command.index(sys.executable, len(command) - 3)] = "bash"
        done = finish(command, PYTHON=sys.executable)
        assert done.returncode != 0
        said = done.stdout
    assert f"pgccd simulate: error: {OPTIONS[option]}" in said, said
    assert time.monotonic() - begin < 25.0, said  # before the time-out
    assert not list(tmp_path.rglob("steps.jsonl"))


def with_a_wrong_variable() -> int:
    if os.environ["RANK"] == "1":
        os.environ["PGCCD_PEER_MEMORY"] = "yes"
    return command_line("simulate", "--robots", "100", "--steps", "3", "--timeout", "30", "--out", "/nowhere/run")


def test_a_variable_that_is_wrong_on_one_rank_ends_all(tmp_path: Path) -> None:
    with ForkedJob(2, tmp_path, with_a_wrong_variable) as started:
        assert started.finish(25.0) == [2, 2], started.said
    assert "pgccd simulate: error: rank 1: PGCCD_PEER_MEMORY: expected 0 or 1, got 'yes'" in started.said, started.said
