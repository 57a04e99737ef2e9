"""Ranks on two hosts, whose names cannot be resolved: network namespaces, where these are permitted."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.launch import ROOT, SECONDS, environment, mpirun
from support.launch import finish as run_to_end

from pgccd import sim

pytestmark = [pytest.mark.ranks, pytest.mark.slow]

PORT = 29471
CONFIG = sim.ModelConfig(robots=60, pattern="skewed", seed=4)
SIMULATE = ["simulate", "--robots", "60", "--world", "skewed", "--seed", "4", "--no-pictures"]
IPV4, IPV6 = ("10.77.0.1", "10.77.0.2"), ("fd77::1", "fd77::2")
HOSTS = (f"pgccd-{os.getpid()}-a", f"pgccd-{os.getpid()}-b")


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def hosts() -> Iterator[None]:
    try:
        for name in HOSTS:
            ip("netns", "add", name)
        ip("link", "add", "eth0", "netns", HOSTS[0], "type", "veth", "peer", "name", "eth0", "netns", HOSTS[1])
        for name, address, address6 in zip(HOSTS, IPV4, IPV6, strict=True):
            inside = ["-n", name]
            ip(*inside, "address", "add", f"{address}/24", "dev", "eth0")
            with contextlib.suppress(subprocess.CalledProcessError):
                ip(*inside, "address", "add", f"{address6}/64", "dev", "eth0", "nodad")
            for link in ("lo", "eth0"):
                ip(*inside, "link", "set", link, "up")
    except (OSError, subprocess.CalledProcessError) as error:
        remove_hosts()
        pytest.skip(f"no network namespaces: {error}")
    yield
    remove_hosts()


def remove_hosts() -> None:
    for name in HOSTS:
        subprocess.run(["ip", "netns", "del", name], capture_output=True)


def on_host(host: int, program: list[str], **variables: str) -> subprocess.Popen[str]:
    """Starts Python on a host with a name of its own, of which no other host knows."""
    named = 'hostname "$0" && exec "$@"'
    return subprocess.Popen(
        [
            "ip",
            "netns",
            "exec",
            HOSTS[host],
            "unshare",
            "--uts",
            "sh",
            "-c",
            named,
            f"node{host}",
            sys.executable,
            *program,
        ],
        env=environment(**variables),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def of_slurm(rank: int, **more: str) -> dict[str, str]:
    nodes = {"SLURM_STEP_NUM_NODES": "2", "SLURM_STEP_NODELIST": "node[0-1]", "SLURM_JOB_ID": str(os.getpid())}
    return {"SLURM_PROCID": str(rank), "SLURM_STEP_NUM_TASKS": "2", "SLURM_LOCALID": "0", **nodes, **more}


def finish(started: list[subprocess.Popen[str]]) -> list[str]:
    try:
        return [process.communicate(timeout=SECONDS)[0] for process in started]
    finally:
        for process in started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def require_same(folder: Path, alone: Path) -> None:
    sim.run(CONFIG, 4, alone)
    hashes = [[line["state_hash"] for line in sim.read_log(where)] for where in (folder, alone)]
    assert hashes[0] == hashes[1] and len(hashes[0]) == 4


@pytest.mark.parametrize("kind", ["names", "IPv4", "IPv6"])
@pytest.mark.parametrize("late", [0.0, 12.0])
def test_ranks_of_srun(kind: str, late: float, hosts: None, tmp_path: Path) -> None:
    address = {"names": {}, "IPv4": {"MASTER_ADDR": IPV4[0]}, "IPv6": {"MASTER_ADDR": IPV6[0]}}[kind]
    address |= {"MASTER_PORT": str(PORT)} if kind != "names" else {"XDG_CACHE_HOME": str(tmp_path)}
    job = ["-m", "pgccd", *SIMULATE, "--steps", "4", "--timeout", "60", "--out", str(tmp_path / "run")]
    started = [on_host(1, job, **of_slurm(1, **address))]
    time.sleep(late)  # rank 0 is the late one
    started.append(on_host(0, job, **of_slurm(0, **address)))
    said = finish(started)
    assert [process.returncode for process in started] == [0, 0], said
    require_same(tmp_path / "run", tmp_path / "alone")


@pytest.mark.parametrize("backend", ["c10d", "static"])
def test_ranks_of_torchrun(backend: str, hosts: None, tmp_path: Path) -> None:
    job = ["-m", "pgccd", *SIMULATE, "--steps", "4", "--timeout", "60", "--out", str(tmp_path / "run")]
    started = []
    for host in (0, 1):
        launch = ["-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1"]
        if backend == "c10d":
            # By itself torchrun tells the ranks the name of the first host.
            launch += ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"{IPV4[0]}:{PORT}", "--local-addr", IPV4[host]]
            launch += ["--rdzv-conf", f"is_host={1 - host}", "--rdzv-id", "two"]
        else:
            launch += ["--node-rank", str(host), "--master-addr", IPV4[0], "--master-port", str(PORT)]
        started.append(on_host(host, [*launch, *job]))
    said = finish(started)
    assert [process.returncode for process in started] == [0, 0], said
    require_same(tmp_path / "run", tmp_path / "alone")


# What mpirun starts in place of ssh: options, an address, and a command.
REMOTE = """#!/bin/bash
while [[ "$1" == -* ]]; do shift; done
address=$1; shift
[ "$address" = {address} ] && host=0 || host=1
names=({names})
exec ip netns exec "${{names[$host]}}" unshare --uts sh -c "hostname node$host; $*"
"""


@pytest.mark.parametrize("transport", ["auto", "mpi4py"])
def test_ranks_of_mpirun(transport: str, hosts: None, tmp_path: Path) -> None:
    remote, out = tmp_path / "remote", tmp_path / "run"
    remote.write_text(REMOTE.format(address=IPV4[0], names=" ".join(HOSTS)))
    remote.chmod(0o700)
    job = ["-m", "pgccd", *SIMULATE, "--steps", "4", "--timeout", "60", "--transport", transport, "--out", str(out)]
    command = mpirun(2, *job)
    at = command.index("-n")
    if "hydra" not in subprocess.run([command[at - 1], "--version"], capture_output=True, text=True).stdout.lower():
        pytest.skip("not the mpirun of MPICH")
    command[at:at] = ["-launcher", "ssh", "-launcher-exec", str(remote), "-localhost", IPV4[0]]
    command[at:at] = ["-hosts", ",".join(IPV4), "-ppn", "1"]
    done = run_to_end(["ip", "netns", "exec", HOSTS[0], *command])
    assert done.returncode == 0, done.stdout
    require_same(out, tmp_path / "alone")
    # One rank on each host, which find each other without a file that they share.
    assert all(len(line["ranks"]["pcs"]) == 2 for line in sim.read_log(out))


def test_a_host_that_is_lost(hosts: None, tmp_path: Path) -> None:
    """Its connections stay open: nothing is received."""
    address = {"MASTER_ADDR": IPV4[0], "MASTER_PORT": str(PORT)}
    job = ["-m", "pgccd", *SIMULATE, "--steps", "100000", "--timeout", "8", "--out", str(tmp_path / "run")]
    started = [on_host(host, job, **of_slurm(host, **address)) for host in (0, 1)]
    deadline = time.monotonic() + 60.0
    while len(sim.read_log(tmp_path / "run")) < 3:
        assert time.monotonic() < deadline and all(process.poll() is None for process in started), finish(started)
        time.sleep(0.1)
    ip("-n", HOSTS[1], "link", "set", "eth0", "down")
    said = finish(started)
    assert all(process.returncode != 0 for process in started), said
    assert re.search(r"pgccd: rank 1 \(process \d+ on node1\) (does not answer|has died)", said[0]), said
    assert re.search(r"rank 0 \(process \d+ on node0\) (does not answer|has died)", said[1]), said


def test_addresses_that_are_wrong(hosts: None, tmp_path: Path) -> None:
    """Each message names the variable and the address, soon."""
    job = ["-m", "pgccd", *SIMULATE, "--steps", "4", "--timeout", "300", "--out", str(tmp_path / "run")]
    wrong = ["10.77.0.9", "10.99.0.1", "no-such-host.invalid"]
    begin = time.monotonic()
    started = [on_host(1, job, **of_slurm(1, MASTER_ADDR=host, MASTER_PORT=str(PORT))) for host in wrong]
    for host, said in zip(wrong, finish(started), strict=True):
        assert re.search(
            rf"MASTER_ADDR: rank 0 cannot be reached at {host}, port {PORT} \(MASTER_ADDR, MASTER", said
        ), said
    own = finish([on_host(0, job, **of_slurm(0, MASTER_ADDR=IPV4[1], MASTER_PORT=str(PORT)))])
    assert f"MASTER_ADDR: {IPV4[1]} is no address of node0, on which rank 0 runs" in own[0]
    assert time.monotonic() - begin < 60.0
