"""Only processes of the job get its token, from any source; a store is none."""

from __future__ import annotations

import os
import re
import stat
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch.distributed as dist
from support.forked_job import ForkedJob, command_line
from support.launch import free_port

from pgccd.distributed.launch import private_files, token
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.token import share_token

SIZE = 3


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(token.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(token, "_SEEN_WITHIN", 0.3)
    return tmp_path / "pgccd"


def share(store: dist.Store, one_machine: bool = False) -> list[bytes | str]:
    """The token of each rank, or its error."""

    def of_rank(rank: int) -> bytes | str:
        try:
            return share_token(store, Placement("srun", rank, SIZE, 0, one_machine), 20.0)
        except RuntimeError as error:
            return str(error)

    with ThreadPoolExecutor(SIZE) as threads:
        return list(threads.map(of_rank, range(SIZE)))


def content(store: dist.Store) -> list[bytes]:
    """All that anybody may read in a store."""
    return [store.get(key) for key in ("token/file", "token/looked")]


def test_through_a_file_that_others_cannot_read(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = []
    read = token.read_private

    def read_and_look(path: Path) -> bytes:
        modes.append(stat.S_IMODE(path.stat().st_mode))
        return read(path)

    monkeypatch.setattr(token, "read_private", read_and_look)
    store = dist.HashStore()
    found = share(store)
    assert len(set(found)) == 1 and len(found[0]) == 32
    assert modes == [0o600] * (SIZE - 1)
    assert list(cache.iterdir()) == []
    assert share(dist.HashStore()) != found
    assert store.num_keys() == 2  # the file's name, and how many ranks have looked


@pytest.mark.parametrize("one_machine", [False, True])
def test_the_store_hands_out_no_token(cache: Path, monkeypatch: pytest.MonkeyPatch, one_machine: bool) -> None:
    """Neither to ranks that see no file, nor to a stranger who says so."""
    monkeypatch.setattr(token, "read_private", lambda path: b"")
    store = dist.HashStore()
    store.add("token/lacking", 1)
    first, *others = share(store, one_machine)
    assert isinstance(first, bytes) and len(first) == 32
    for other in others:
        assert re.fullmatch(
            r"token: .*/token-\S+ of rank 0 is no private file of this user on \S+: set PGCCD_JOB_TOKEN.*", other
        )
    for value in content(store):
        assert first not in value and first.hex().encode() not in value
    assert list(cache.iterdir()) == []


def test_a_file_that_another_machine_sees_late(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(token, "_SEEN_WITHIN", 20.0)
    looks, read = [], token.read_private

    def late(path: Path) -> bytes:
        looks.append(path)
        return read(path) if len(looks) > 6 else b""

    monkeypatch.setattr(token, "read_private", late)
    assert len(set(share(dist.HashStore()))) == 1
    del looks[:]
    assert "is no private file" in str(share(dist.HashStore(), one_machine=True)[1])


def test_no_folder_can_be_written(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(private_files, "folders", lambda: [Path("/proc/none")])
    monkeypatch.setattr(token, "folders", lambda: [Path("/proc/none")])
    for said in share(dist.HashStore()):
        assert re.fullmatch("token: rank 0 can write no file .*: set PGCCD_JOB_TOKEN to the same secret.*", str(said))


def test_through_the_environment(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(token.VARIABLE, "a secret")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert share(dist.HashStore()) == [b"a secret"] * SIZE
    assert not cache.exists()


def read_by_a_rank(path: Path) -> bytes:
    """The token that a rank takes from this file of rank 0; empty if it refuses it."""
    store = dist.HashStore()
    store.set("token/file", str(path))
    try:
        return share_token(store, Placement("srun", 1, SIZE, 0, True), 20.0)
    except RuntimeError as error:
        assert "is no private file" in str(error)
        return b""


def test_what_is_no_token_is_not_taken_for_one(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "token"
    assert read_by_a_rank(path) == b"" and read_by_a_rank(tmp_path) == b""
    for given in (b"", b"x" * 31, b"x" * 33, b"x" * 5000):
        path.write_bytes(given)
        path.chmod(0o600)
        assert read_by_a_rank(path) == b""
    path.write_bytes(b"x" * 32)
    assert read_by_a_rank(path) == b"x" * 32
    (tmp_path / "link").symlink_to(path)
    assert read_by_a_rank(tmp_path / "link") == b""
    os.mkfifo(tmp_path / "pipe", 0o600)  # would wait for a writer
    assert read_by_a_rank(tmp_path / "pipe") == b""
    for mode in (0o640, 0o604, 0o620):  # others may know it, or have written it
        path.chmod(mode)
        assert read_by_a_rank(path) == b""
    path.chmod(0o600)
    monkeypatch.setattr(private_files.os, "getuid", lambda: path.stat().st_uid + 1)  # another user's
    assert read_by_a_rank(path) == b""


def test_ranks_that_do_not_come(cache: Path) -> None:
    with pytest.raises(RuntimeError, match="^not all of 3 ranks connected within 0.1 s$"):
        share_token(dist.HashStore(), Placement("srun", 0, SIZE, 0), 0.1)
    assert list(cache.iterdir()) == []


def of_slurm(folder: str, variables: dict[str, str]) -> int:
    """`pgccd` as a rank of Slurm; rank 1 can read no file of the user."""
    rank = os.environ.pop("RANK")
    for name in ("WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        del os.environ[name]
    os.environ |= {"SLURM_PROCID": rank, "SLURM_STEP_NUM_TASKS": "2", "SLURM_STEP_NUM_NODES": "2"}
    os.environ |= {"SLURM_STEP_NODELIST": "127.0.0.1", "SLURM_JOB_ID": "88", "SLURM_STEP_ID": "0", "SLURM_LOCALID": "0"}
    os.environ |= {"XDG_CACHE_HOME": f"{folder}/{rank}", **variables}
    token._SEEN_WITHIN = 0.1
    if rank == "1":
        token.read_private = lambda path: b""  # type: ignore[assignment]
    return command_line("simulate", "--robots", "9", "--steps", "1", "--timeout", "4", "--out", f"{folder}/out")


@pytest.mark.parametrize("knows_port", [True, False])
def test_a_stranger_in_the_place_of_a_rank(knows_port: bool, tmp_path: Path) -> None:
    """It knows Slurm's variables, and can read no file of the user."""
    variables = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())} if knows_port else {}
    with ForkedJob(2, tmp_path / "said", of_slurm, str(tmp_path), variables) as started:
        codes, said = started.finish(), started.said
    assert 0 not in codes and None not in codes, said
    assert not (tmp_path / "out" / "steps.jsonl").exists()
    expected = "is no private file of this user" if knows_port else "ranks [1] of 2 did not connect within 4 s"
    assert expected in said and "Traceback" not in said, said
