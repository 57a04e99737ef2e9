"""Ranks of one start find each other in a store that contains keys of earlier starts."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
import torch.distributed as dist
from support.forked_job import ForkedJob, command_line, forkserver
from support.launch import children, environment, free_port, torchrun

from pgccd.distributed import connect
from pgccd.distributed.guard import Hub
from pgccd.distributed.launch import interfaces, rendezvous
from pgccd.distributed.launch.connect import _start_guard
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.rendezvous import agree_on_start, first_host, meet
from pgccd.distributed.launch.token import share_token

SIZE = 4


def start(store: dist.Store, timeout: float = 20.0) -> list[dist.Store]:
    """As separate processes would."""
    places = [Placement("torchrun", rank, SIZE, 0) for rank in range(SIZE)]
    with ThreadPoolExecutor(SIZE) as threads:
        return list(threads.map(lambda place: agree_on_start(store, place, timeout), places))


def test_each_start_has_a_part_of_the_store_to_itself() -> None:
    store = dist.HashStore()
    for index in range(4):
        parts = start(store)
        assert not parts[0].check(["name"])
        parts[1].set("name", f"of start {index}")
        assert {part.get("name").decode() for part in parts} == {f"of start {index}"}


def test_ranks_that_do_not_come_are_named() -> None:
    store = dist.HashStore()
    start(store)
    # Keys of an earlier start exist; now rank 0 is alone.
    with pytest.raises(RuntimeError, match=r"^ranks \[1, 2, 3\] of 4 did not connect within 0.3 s$"):
        agree_on_start(store, Placement("torchrun", 0, SIZE, 0), 0.3)
    store.set_timeout(rendezvous.timedelta(seconds=0.3))
    with pytest.raises(RuntimeError, match="^rank 0 did not connect within 0.3 s"):
        agree_on_start(store, Placement("torchrun", 2, SIZE, 0), 0.3)


@pytest.mark.parametrize(
    ("nodes", "first"),
    [("gpu[007-012,020],login1", "gpu007"), ("node3", "node3"), ("a1,b2", "a1"), ("n-1-[2,4]", "n-1-2")],
)
def test_first_host_of_slurm_s_short_form(nodes: str, first: str) -> None:
    assert first_host(nodes) == first


def placed(monkeypatch: pytest.MonkeyPatch, launcher: str, **variables: str) -> Placement:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    return Placement(launcher, 0, 2, 0, True)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_port_in_use_is_named(monkeypatch: pytest.MonkeyPatch, host: str) -> None:
    if host == "::1" and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=family) as other:
        port = other.getsockname()[1]
        here = placed(monkeypatch, "srun", MASTER_ADDR=host, MASTER_PORT=str(port))
        with pytest.raises(RuntimeError, match=f"^MASTER_PORT: cannot listen on {host}, port {port}: Address already"):
            meet(here, 1.0)
    store = meet(here, 5.0).store
    store.set("key", "value")
    assert store.get("key") == b"value"


@pytest.mark.parametrize(
    ("name", "value"),
    [*(("MASTER_PORT", value) for value in ("99999", "abc", "0")), ("SLURM_STEP_ID", "x"), ("SLURM_JOB_ID", "-1")],
)
def test_variables_that_are_no_numbers_are_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    here = placed(monkeypatch, "srun", MASTER_ADDR="127.0.0.1", **{name: value})
    with pytest.raises(ValueError, match=f"^{name}: expected a number"):
        meet(here, 1.0)


@pytest.fixture
def step(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """A step of Slurm whose nodes share a home folder."""
    for name in ("MASTER_ADDR", "MASTER_PORT", "SLURM_STEP_RESV_PORTS"):
        monkeypatch.delenv(name, raising=False)
    variables = {"SLURM_STEP_NODELIST": "no-such-name", "XDG_CACHE_HOME": str(tmp_path)}
    variables |= {"SLURM_JOB_ID": "100", "SLURM_STEP_ID": "31"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    return variables


def meet_in_step(late: int | None = None, seconds: float = 0.0, timeout: float = 20.0) -> list[Any]:
    """What `meet` returns to each of two ranks of one machine, or raises."""

    def of_rank(rank: int) -> Any:
        if rank == late:
            time.sleep(seconds)
        try:
            return meet(Placement("srun", rank, 2, rank, True), timeout)
        except RuntimeError as error:
            return error

    with ThreadPoolExecutor(2) as threads:
        return list(threads.map(of_rank, range(2)))


@pytest.mark.parametrize("late", [None, 0, 1])
def test_a_step_meets_at_a_port_that_was_free(late: int | None, step: dict[str, str], tmp_path: Path) -> None:
    first, second = meet_in_step(late, 1.0)
    first.store.set("key", "value")
    assert second.store.get("key") == b"value" and first.is_local and second.is_local
    assert list((tmp_path / "pgccd").iterdir()) == []


def test_steps_have_files_of_their_own(step: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Ports by a formula were the same for steps 100.31 and 101.0."""
    names = []
    monkeypatch.setattr(rendezvous._AddressFile, "wait", lambda self, timeout: names.append(self._name) or ("", 0))
    monkeypatch.setattr(rendezvous, "connect_store", lambda *arguments, **named: None)
    monkeypatch.setattr(rendezvous, "agree_on_start", lambda *arguments: None)
    for job, number, cluster in (("100", "31", "a/b"), ("101", "0", "a/b"), ("101", "0", "c")):
        monkeypatch.setenv("SLURM_JOB_ID", job)
        monkeypatch.setenv("SLURM_STEP_ID", number)
        monkeypatch.setenv("SLURM_CLUSTER_NAME", cluster)
        meet(Placement("srun", 1, 2, 1, True), 1.0)
    assert names == ["step-a_b-100.31", "step-a_b-101.0", "step-c-101.0"]


def test_a_file_that_an_earlier_start_has_left(step: dict[str, str], tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    folder = tmp_path / "pgccd"
    folder.mkdir()
    for content in (json.dumps([["127.0.0.1"], port]), "[", "[[1], 2, 3]", "[" * 3000):
        left = folder / "step-slurm-100.31"
        left.write_text(content)
        left.chmod(0o600)
        first, second = meet_in_step(late=0, seconds=0.5)
        first.store.set("key", content)
        assert second.store.get("key") == content.encode()


def test_a_step_whose_nodes_share_no_folder(step: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(
        RuntimeError, match=f"^MASTER_PORT: not set, and {tmp_path}/pgccd/step-slurm-100.31 on "
    ) as said:
        meet(Placement("srun", 1, 2, 0), 0.3)
    assert "set MASTER_PORT (and MASTER_ADDR)" in str(said.value)


def test_ports_that_slurm_has_reserved(step: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    monkeypatch.setenv("SLURM_STEP_RESV_PORTS", f"{port}-{port + 7}")
    first, second = meet_in_step()
    assert first.store.port == second.store.port == port


def test_addresses_of_this_machine() -> None:
    found = interfaces.addresses()
    assert found["127.0.0.1"] == "lo" and interfaces.interface_of("::ffff:127.0.0.1") == "lo"
    assert "127.0.0.1" not in interfaces.outer_addresses() and interfaces.interface_of("192.0.2.1") is None
    for address in interfaces.outer_addresses():
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        with socket.socket(family) as own:
            own.bind((address, 0))


def test_an_address_of_another_machine_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    here = placed(monkeypatch, "srun", MASTER_ADDR="192.0.2.1", MASTER_PORT=str(free_port()))
    with pytest.raises(RuntimeError, match="^MASTER_ADDR: 192.0.2.1 is no address of "):
        meet(here, 1.0)


@pytest.mark.parametrize("host", ["no-such-host.invalid", "127.0.0.1"])
def test_an_address_at_which_nothing_listens(
    host: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rendezvous, "_TOLD_AFTER", 0.3)
    monkeypatch.setattr(rendezvous, "_STORE_SECONDS", rendezvous._REACH_SECONDS + 0.5)
    port = free_port()
    placed(monkeypatch, "srun", MASTER_ADDR=host, MASTER_PORT=str(port))
    with pytest.raises(RuntimeError, match=f"^MASTER_ADDR: rank 0 cannot be reached at {host}, port {port} "):
        meet(Placement("srun", 1, 2, 0), 1.5)
    told = f"pgccd: rank 0 is not yet reached at {host}, port {port} (MASTER_ADDR, MASTER_PORT): "
    assert capsys.readouterr().err.count(told) == 1


def test_a_hub_of_all_interfaces_can_be_reached_by_ipv6() -> None:
    if not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6")
    hub = Hub("", b"token", 1)
    for host in ("127.0.0.1", "::1"):
        socket.create_connection((host, hub.port), timeout=5.0).close()
    hub.close(1.0)


def test_a_hub_on_a_machine_without_ipv6(monkeypatch: pytest.MonkeyPatch) -> None:
    original = socket.create_server

    def create(*arguments: Any, **more: Any) -> socket.socket:
        if more.get("family") == socket.AF_INET6:
            raise OSError(99, "Cannot assign requested address")
        return original(*arguments, **more)

    monkeypatch.setattr(socket, "create_server", create)
    hub = Hub("", b"token", 1)
    socket.create_connection(("127.0.0.1", hub.port), timeout=5.0).close()
    hub.close(1.0)


def test_a_silent_program_on_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendezvous, "_LATER_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
        monkeypatch.setenv("MASTER_PORT", str(port))
        expected = rf"^MASTER_PORT: no store answers at 127.0.0.1, port {port}, within 1 s"
        with pytest.raises(RuntimeError, match=expected):
            meet(Placement("torchrun", 1, 2, 1), 1.0)


def keep_store(pipe: Connection) -> None:
    """Of an agent: serves until it is killed."""
    store = dist.TCPStore("127.0.0.1", 0, None, True, wait_for_workers=False)
    pipe.send(store.port)
    pipe.recv()


def test_an_agent_that_dies_while_ranks_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    """With it the store that it keeps: at once, not after the time-out."""
    ours, theirs = forkserver().Pipe()
    agent = forkserver().Process(target=keep_store, args=(theirs,), daemon=True)
    agent.start()
    port = ours.recv()
    placed(
        monkeypatch,
        "torchrun",
        MASTER_ADDR="127.0.0.1",
        MASTER_PORT=str(port),
        TORCHELASTIC_USE_AGENT_STORE="True",
    )
    killing = threading.Timer(0.5, agent.kill)
    killing.start()
    begin = time.monotonic()
    expected = (
        rf"^MASTER_ADDR: the store at 127.0.0.1, port {port} \(MASTER_ADDR, MASTER_PORT\) is lost: torchrun's agent"
    )
    for rank in (0, 1):  # that waits for another, and one that waits for rank 0; or when all has ended
        with pytest.raises(RuntimeError, match=expected if rank == 0 else "^MASTER_(ADDR|PORT): "):
            meet(Placement("torchrun", rank, 2, rank), 300.0 if rank == 0 else 1.0)
    assert time.monotonic() - begin < 30.0


def orphaned_job() -> None:
    """Rank 1 does not come, and the process that launched rank 0 dies meanwhile."""
    if os.environ["RANK"] == "0":
        os.environ["TORCHELASTIC_RUN_ID"] = "run"
        parent = os.getppid()
        began = time.monotonic()
        os.getppid = lambda: parent if time.monotonic() < began + 1.0 else 1  # type: ignore[assignment]
        connect("cpu", "gloo", timeout=300.0)


def test_a_rank_whose_agent_dies_while_it_waits_for_others(tmp_path: Path) -> None:
    with ForkedJob(2, tmp_path / "said", orphaned_job) as started:
        assert started.finish(30.0) == [70, 0], started.said
    expected = (
        r"^pgccd: rank 0 ends: torchrun's agent, process \d+, which launched it, has died while the ranks connected"
    )
    assert re.match(expected + r" \(MASTER_ADDR=127.0.0.1 MASTER_PORT=\d+\)\n$", started.said), started.said


@pytest.mark.slow
def test_torchrun_is_killed_while_its_ranks_meet() -> None:
    job = (
        "import os, time; from pgccd.distributed import connect; time.sleep(99.0 * int(os.environ['RANK'])); connect()"
    )
    process = subprocess.Popen(
        torchrun(2, "--no-python", sys.executable, "-c", f"print('begins', flush=True); {job}"),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    while "begins" not in process.stdout.readline():
        assert process.poll() is None
    time.sleep(8.0)
    ranks = children(process.pid)
    begin = time.monotonic()
    process.kill()
    said = ""
    for line in process.stdout:
        said += line
        if "torchrun's agent" in line:
            break
    for rank in ranks:
        with contextlib.suppress(ProcessLookupError):
            os.kill(rank, signal.SIGKILL)  # rank 1 would sleep on
    process.wait()
    assert time.monotonic() - begin < 30.0 and "MASTER_ADDR" in line, said


def test_a_store_that_a_stranger_has_written_to(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each value ends the job in one line."""
    monkeypatch.setenv("PGCCD_JOB_TOKEN", "secret")
    for port in ("x", "99999999", "-1", "1" * 5000, "\0", "\ud7ff", ""):
        store = dist.HashStore()
        store.set("guard/port", port)
        meeting = rendezvous.Meeting(store, "127.0.0.1", True, "here")
        with pytest.raises(RuntimeError, match="^guard: the port of rank 0 in the store has been overwritten") as said:
            _start_guard(meeting, Placement("torchrun", 1, 2, 1), 1.0)
        assert len(str(said.value).splitlines()) == 1 and len(str(said.value)) < 300
    monkeypatch.delenv("PGCCD_JOB_TOKEN")
    for path in ("\0", "x" * 5000, "/dev/zero", "/proc/self/mem", str(tmp_path)):
        store = dist.HashStore()
        store.set("token/file", path)
        with pytest.raises(RuntimeError, match="^token: .* of rank 0 is no private file"):
            share_token(store, Placement("torchrun", 1, 2, 1, True), 1.0)


def with_a_token(of_rank: dict[str, str], *arguments: str) -> int:
    """`pgccd` on a rank with a token of its own, or none."""
    os.environ.pop("PGCCD_JOB_TOKEN", None)
    if os.environ["RANK"] in of_rank:
        os.environ["PGCCD_JOB_TOKEN"] = of_rank[os.environ["RANK"]]
    return command_line(*arguments)


@pytest.mark.parametrize(
    ("tokens", "expected"),
    [
        ({"1": "secret"}, "PGCCD_JOB_TOKEN: rank 0 has none, rank 1 has a value"),
        ({str(k): f"secret{k}" for k in range(3)}, r"rank 1: guard: .* is PGCCD_JOB_TOKEN the same on all\?"),
    ],
)
def test_tokens_that_differ_end_all_ranks_before_the_time_out(
    tokens: dict[str, str], expected: str, tmp_path: Path
) -> None:
    options = ["--robots", "9", "--steps", "1", "--timeout", "9999", "--out", str(tmp_path / "run")]
    with ForkedJob(3, tmp_path / "said", with_a_token, tokens, "simulate", *options) as started:
        assert started.finish() == [2, 2, 2], started.said
    assert re.search(f"pgccd simulate: error: {expected}", started.said), started.said
