"""Progress of a run on a terminal, or as plain lines."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

_SECONDS_BETWEEN_LINES = 5.0


class Progress(Protocol):
    """Display of the progress of a run."""

    def advance(self, record: dict[str, Any]) -> None: ...


class _Lines:
    """Plain lines for files and pipes: the first step, the last, and one every few seconds."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._last = -_SECONDS_BETWEEN_LINES

    def advance(self, record: dict[str, Any]) -> None:
        now = time.monotonic()
        if now - self._last < _SECONDS_BETWEEN_LINES and record["step"] + 1 < self._steps:
            return
        self._last = now
        sys.stderr.write(f"step {record['step'] + 1}/{self._steps}  {_figures(record)}\n")
        sys.stderr.flush()


def _figures(record: dict[str, Any]) -> str:
    slow = sorted(record["stage_seconds"].items(), key=lambda item: -item[1])[:3]
    stages = ", ".join(f"{stage} {1e3 * seconds:.0f}" for stage, seconds in slow)
    return f"pcs {record['pcs']:,}  contacts {record['contacts']:,}  {1e3 * record['seconds']:.0f} ms ({stages})"


@contextmanager
def terminal_progress(steps_made: int, steps: int) -> Iterator[Progress]:
    """A rich progress bar if rich is installed and standard error is a terminal, else plain lines."""
    try:
        import rich.console
        import rich.progress
    except ImportError:
        yield _Lines(steps)
        return
    console = rich.console.Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(steps)
        return
    columns = [
        rich.progress.TextColumn("step"),
        rich.progress.MofNCompleteColumn(),
        rich.progress.BarColumn(),
        rich.progress.TimeRemainingColumn(),
        rich.progress.TextColumn("{task.description}"),
    ]
    with rich.progress.Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=steps, completed=steps_made)

        class Bar:
            def advance(self, record: dict[str, Any]) -> None:
                bar.update(task, completed=record["step"] + 1, description=_figures(record))

        yield Bar()
