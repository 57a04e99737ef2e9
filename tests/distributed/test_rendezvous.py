"""Ranks of one start find each other in a store that contains keys of earlier starts."""

from __future__ import annotations

import json
import re
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch.distributed as dist
from support.launch import SECONDS, finish, free_port, start_ranks, torchrun

from pgccd.distributed.guard import Hub
from pgccd.distributed.launch import interfaces, rendezvous
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.rendezvous import agree_on_start, first_host, meet

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


def test_a_token_on_some_ranks_only_is_named(tmp_path: Path) -> None:
    shell = '[ "$RANK" = 1 ] && export PGCCD_JOB_TOKEN=secret; exec "$PYTHON" -m pgccd simulate --robots 9 --steps 1'
    command = torchrun(2, "--no-python", "bash", "-c", f"cd {tmp_path}; {shell} --timeout 20")
    done = finish(command, PYTHON=sys.executable)
    expected = "pgccd simulate: error: PGCCD_JOB_TOKEN: rank 0 has none, rank 1 has a value"
    assert done.returncode != 0 and expected in done.stdout, done.stdout


def test_tokens_that_differ_end_all_ranks_before_the_time_out(tmp_path: Path) -> None:
    token = "os.environ['PGCCD_JOB_TOKEN'] = 'secret' + os.environ['RANK']"
    code = f"import os; {token}; from pgccd.__main__ import run; raise SystemExit(run())"
    options = ["--robots", "9", "--steps", "1", "--timeout", "9999", "--out", str(tmp_path)]
    ranks = start_ranks(3, ["-c", code, "simulate", *options])  # torchrun would end all when one fails
    printed = [rank.communicate(timeout=SECONDS)[0] for rank in ranks]
    assert [rank.returncode for rank in ranks] == [2, 2, 2], printed
    expected = r"pgccd simulate: error: rank 1: guard: .* is PGCCD_JOB_TOKEN the same on all\?"
    assert re.search(expected, printed[0]), printed
