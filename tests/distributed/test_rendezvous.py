"""Ranks of one start find each other in a store that contains keys of earlier starts."""

from __future__ import annotations

import re
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch.distributed as dist
from support.launch import SECONDS, finish, start_ranks, torchrun

from pgccd.distributed.guard import Hub
from pgccd.distributed.launch import rendezvous
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
