"""The log of a run: `steps.jsonl`, one line per step. It is written and read line by line: of a large job it may be
larger than the memory.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, TextIO

from pgccd.checkpoint.files import one_line, replace_text
from pgccd.checkpoint.lock import FolderError
from pgccd.checkpoint.regular import open_regular

LOG_FILE = "steps.jsonl"
# Fields of a line, besides "step", "seconds" and "stage_seconds", that summaries use.
_COUNTS = ("pcs", "contacts", "stopped", "candidates", "unresolved", "touching_at_t0")
_HASHES = ("contacts_hash", "state_hash")
# A file with longer lines is no log: each rank has some 100 bytes of its own.
_LONGEST_LINE = 1 << 26
# Bytes read at a time from the end.
_BLOCK = 1 << 20
# The object of each rank's values stands at the end of a line.
_RANKS = b', "ranks": {'


class StepLog:
    """`steps.jsonl`: one line per step. Continuing a run drops the lines of steps after its checkpoint; only the end of
    the file is read.

    Args:
        folder: of the run.
        steps_made: number of steps whose lines are kept; warns if the last one is missing.
        state_hash: of the last of these steps, as in its line; None: it is not compared.

    Raises:
        FolderError: it cannot be read or written, also from `append` and `sync`; or it is of another run.
    """

    def __init__(self, folder: Path, steps_made: int, state_hash: str | None = None) -> None:
        self.path = folder / LOG_FILE
        if steps_made == 0 or not os.path.lexists(self.path):
            if steps_made:
                warnings.warn(f"{self.path} lacks the {steps_made} steps before the checkpoint", stacklevel=2)
            with self._errors():
                replace_text(self.path, "")
        with self._errors():
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            self._file: TextIO = os.fdopen(descriptor, "a")
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                self._file.close()
                raise FolderError(f"folder: {self.path} is no regular file")
        if steps_made:
            try:
                self._drop_after(steps_made - 1, state_hash)
            except BaseException:
                self._file.close()
                raise

    def _drop_after(self, step: int, state_hash: str | None) -> None:
        """Removes the lines of later steps."""
        kept = 0
        with self._errors(), open_regular(self.path) as file:
            for line, end in _lines_from_end(file):
                record = _record(line)
                if record is None or record["step"] > step:
                    continue
                if record["step"] == step and state_hash not in (None, record["state_hash"]):
                    raise FolderError(
                        f"folder: {self.path} is not of this checkpoint: the state hash of its step {step} is "
                        f"{record['state_hash']}, that of the checkpoint {state_hash}; to continue without it, move it"
                    )
                kept = end
                if record["step"] < step:
                    lacking = f"{step - record['step']} of {step + 1}"
                    warnings.warn(f"{self.path} lacks {lacking} steps made before the checkpoint", stacklevel=3)
                break
            else:
                warnings.warn(f"{self.path} lacks the {step + 1} steps before the checkpoint", stacklevel=3)
        with self._errors():
            os.ftruncate(self._file.fileno(), kept)

    def append(self, record: dict[str, Any]) -> None:
        with self._errors():
            self._file.write(json.dumps(record) + "\n")
            self._file.flush()

    def sync(self) -> None:
        """Waits until all lines are on the disk, where the log must still have its name."""
        with self._errors():
            os.fsync(self._file.fileno())
            if not os.path.samestat(os.fstat(self._file.fileno()), os.stat(self.path)):
                raise FolderError(f"folder: {self.path} has been replaced while the run was writing it")

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise FolderError(f"folder: {self.path} cannot be written: {error.strerror or error}") from error

    def __enter__(self) -> StepLog:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        with suppress(OSError) if error is not None else self._errors():
            self._file.close()


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The records of `steps.jsonl` in `folder` by step, the first of each; without lines that are damaged or
    incomplete. Empty without the file.
    """
    return list(iterate_log(folder))


def iterate_log(folder: Path, with_ranks: bool = True) -> Iterator[dict[str, Any]]:
    """The same, one at a time.

    Args:
        folder: of the run.
        with_ranks: whether records have the object `ranks`, whose size grows with the number of ranks.

    Raises:
        ValueError: the file cannot be read.
    """
    path, last = folder / LOG_FILE, -1
    try:
        with open_regular(path) as file:
            while line := _line(file):
                if not with_ranks and (cut := line.find(_RANKS)) >= 0:
                    line = line[:cut] + b"}"
                record = _record(line)
                if record is not None and record["step"] > last:
                    last = record["step"]
                    yield record
    except FileNotFoundError:
        return
    except OSError as error:
        raise ValueError(one_line(f"{path} cannot be read: {error.strerror or error}")) from error


def _line(file: BufferedReader) -> bytes:
    """The next line; empty at the end."""
    parts, length = [], 0
    while part := file.readline(_BLOCK):
        _require_text(part)
        parts.append(part)
        length += len(part)
        if length >= _LONGEST_LINE:
            raise _too_long()
        if part.endswith(b"\n"):
            break
    return b"".join(parts)


def _require_text(block: bytes) -> None:
    """Refuses holes in a file, whose end may be far away. After a crash a file may end in fewer zeros."""
    if len(block) == _BLOCK and not block.strip(b"\0"):
        raise OSError(errno.EINVAL, "it has holes")


def _lines_from_end(file: BufferedReader) -> Iterator[tuple[bytes, int]]:
    """The lines from the last one backwards, and the place after each. What follows the last newline is no line."""
    end = begin = file.seek(0, os.SEEK_END)
    tail = b""  # what has been read of the line that ends at `end`
    is_whole = False  # whether that ends with a newline
    while begin > 0:
        before, begin = begin, max(0, begin - _BLOCK)
        file.seek(begin)
        block = file.read(before - begin)
        _require_text(block)
        tail = block + tail
        while (newline := tail.rfind(b"\n", 0, len(tail) - is_whole)) >= 0:
            if is_whole:
                yield tail[newline + 1 :], end
            end, tail, is_whole = begin + newline + 1, tail[: newline + 1], True
        if len(tail) > _LONGEST_LINE:
            raise _too_long()
    if is_whole:
        yield tail, end


def _too_long() -> OSError:
    return OSError(errno.EFBIG, f"a line has more than {_LONGEST_LINE} bytes")


def _record(line: bytes) -> dict[str, Any] | None:
    """The record of a line; None if it is damaged."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):  # the process died while writing it, for example
        return None
    return record if _is_record(record) else None


def _is_record(record: Any) -> bool:
    """Whether a line has the fields that summaries use."""
    if not isinstance(record, dict) or not isinstance(record.get("stage_seconds"), dict):
        return False
    counts = [record.get(name) for name in ("step", *_COUNTS)]
    hashes = [record.get(name) for name in _HASHES]
    times = [record.get("seconds"), *record["stage_seconds"].values()]
    return (
        all(type(count) is int and count >= 0 for count in counts)
        and all(isinstance(value, str) for value in hashes)
        and all(type(time) in (int, float) for time in times)
    )
