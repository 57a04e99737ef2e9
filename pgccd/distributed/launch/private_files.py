"""Small files that only this user can read, in a folder that the machines of a job may share."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from pgccd.checkpoint.regular import open_regular

_MOST_BYTES = 4096


def folders() -> list[Path]:
    """Where such files are written: the first of these that can be. The last one is of this machine only."""
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return [Path(cache) / "pgccd", Path(tempfile.gettempdir()) / f"pgccd-{os.getuid()}"]


def write_private(content: bytes, name: str | None = None) -> Path | None:
    """Writes a file with mode 0600, complete as soon as it has its name; None if that is not possible.

    Args:
        content: at most 4096 bytes.
        name: of the file, replaced if it exists; default: a random one.
    """
    for folder in folders():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            descriptor, made = tempfile.mkstemp(prefix="token-", dir=folder)  # mode 0600
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
            if name is None:
                return Path(made)
            os.replace(made, folder / name)
            return folder / name
        except OSError:
            continue
    return None


def read_private(path: Path) -> bytes:
    """The content of such a file; empty if it does not exist, is no regular file, belongs to another user, or can be
    read or written by others.
    """
    try:
        with open_regular(path, _MOST_BYTES, follows_links=False) as file:
            status = os.fstat(file.fileno())
            is_own = status.st_uid == os.getuid() and not status.st_mode & 0o077
            return file.read(_MOST_BYTES) if is_own else b""
    except (OSError, ValueError):  # ValueError: no path can be so
        return b""


def refresh(folder: Path) -> None:
    """Makes network file systems look for new files of a folder."""
    with suppress(OSError):
        os.listdir(folder)
