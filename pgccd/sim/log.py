"""The log of a run: `steps.jsonl`, one line per step."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from pgccd.checkpoint.files import replace_text
from pgccd.checkpoint.lock import FolderError

LOG_FILE = "steps.jsonl"
# Fields of a line, besides "step", "seconds" and "stage_seconds", that summaries use.
_COUNTS = ("pcs", "contacts", "stopped", "candidates", "unresolved", "touching_at_t0")
_HASHES = ("contacts_hash", "state_hash")


class StepLog:
    """`steps.jsonl`: one line per step. Continuing a run drops the lines of steps after its checkpoint.

    Args:
        folder: of the run.
        steps_made: number of steps whose lines are kept; warns if lines are missing.

    Raises:
        FolderError: it cannot be written; also from `append` and `sync`.
    """

    def __init__(self, folder: Path, steps_made: int) -> None:
        self.path = folder / LOG_FILE
        #: Records of all steps of the run so far.
        self.records = [record for record in read_log(folder) if record["step"] < steps_made] if steps_made else []
        if len(self.records) < steps_made:
            missing = steps_made - len(self.records)
            warnings.warn(f"{self.path} lacks {missing} of {steps_made} steps made before the checkpoint", stacklevel=2)
        with self._errors():
            replace_text(self.path, "".join(json.dumps(record) + "\n" for record in self.records))
            self._file: TextIO = open(self.path, "a")  # noqa: SIM115  (closed by __exit__)

    def append(self, record: dict[str, Any]) -> None:
        self.records.append(record)
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
    path = folder / LOG_FILE
    records: dict[int, dict[str, Any]] = {}
    for line in path.read_bytes().split(b"\n") if path.is_file() else []:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):  # the process died while writing it, for example
            continue
        if _is_record(record):
            records.setdefault(record["step"], record)
    return [records[step] for step in sorted(records)]


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
