"""The log of a run: `steps.jsonl`, one line per step."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from typing import Any, TextIO

LOG_FILE = "steps.jsonl"


class StepLog:
    """`steps.jsonl`: one line per step. Continuing a run drops the lines of steps after its checkpoint.

    Args:
        folder: of the run.
        steps_made: number of steps whose lines are kept; warns if lines are missing.
    """

    def __init__(self, folder: Path, steps_made: int) -> None:
        self.path = folder / LOG_FILE
        #: Records of all steps of the run so far.
        self.records = [record for record in read_log(folder) if record["step"] < steps_made] if steps_made else []
        if len(self.records) < steps_made:
            missing = steps_made - len(self.records)
            warnings.warn(f"{self.path} lacks {missing} of {steps_made} steps made before the checkpoint", stacklevel=2)
        unfinished = self.path.with_suffix(".unfinished")
        unfinished.write_text("".join(json.dumps(record) + "\n" for record in self.records))
        os.replace(unfinished, self.path)
        self._file: TextIO = open(self.path, "a")  # noqa: SIM115  (closed by __exit__)

    def append(self, record: dict[str, Any]) -> None:
        self.records.append(record)
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()

    def sync(self) -> None:
        """Waits until all lines are on the disk."""
        os.fsync(self._file.fileno())

    def __enter__(self) -> StepLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The records of `steps.jsonl`, up to the first incomplete line; empty without the file."""
    path = folder / LOG_FILE
    records = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):  # the process died while writing it
            break
        if not isinstance(record, dict) or type(record.get("step")) is not int:
            break
        records.append(record)
    return records
