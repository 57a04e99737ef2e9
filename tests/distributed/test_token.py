"""Only processes of the job get its token, from any source."""

from __future__ import annotations

import stat
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch.distributed as dist

from pgccd.distributed.launch import token
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.token import share_token

SIZE = 3


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(token.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "pgccd"


def share(store: dist.Store) -> list[bytes]:
    places = [Placement("srun", rank, SIZE, 0) for rank in range(SIZE)]
    with ThreadPoolExecutor(SIZE) as threads:
        return list(threads.map(lambda place: share_token(store, place, 20.0), places))


def test_through_a_file_that_others_cannot_read(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = []
    read = token._read

    def read_and_look(path: Path) -> bytes:
        modes.append(stat.S_IMODE(path.stat().st_mode))
        return read(path)

    monkeypatch.setattr(token, "_read", read_and_look)
    store = dist.HashStore()
    found = share(store)
    assert len(set(found)) == 1 and len(found[0]) == 32
    assert modes == [0o600] * (SIZE - 1)
    assert store.get("token/by store") == b""
    assert list(cache.iterdir()) == []
    assert share(dist.HashStore()) != found


def test_through_the_store_where_there_is_no_common_folder(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(token, "_read", lambda path: b"")
    with pytest.warns(UserWarning, match="2 ranks see no file of rank 0.*set PGCCD_JOB_TOKEN"):
        found = share(dist.HashStore())
    assert len(set(found)) == 1 and len(found[0]) == 32


def test_through_the_environment(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(token.VARIABLE, "a secret")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert share(dist.HashStore()) == [b"a secret"] * SIZE
    assert not cache.exists()


def test_what_is_no_token_is_not_taken_for_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "token"
    assert token._read(path) == b"" and token._read(tmp_path) == b""
    for content in (b"", b"x" * 31, b"x" * 33):
        path.write_bytes(content)
        assert token._read(path) == b""
    path.write_bytes(b"x" * 32)
    assert token._read(path) == b"x" * 32
    monkeypatch.setattr(token.os, "getuid", lambda: path.stat().st_uid + 1)  # another user's
    assert token._read(path) == b""
    assert token._write(b"x", path / "below a file") is None


def test_ranks_that_do_not_come(cache: Path) -> None:
    with pytest.raises(RuntimeError, match="^not all of 3 ranks connected within 0.1 s$"):
        share_token(dist.HashStore(), Placement("srun", 0, SIZE, 0), 0.1)
    assert list(cache.iterdir()) == []
