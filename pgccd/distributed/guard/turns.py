"""Time as a thread sees it: by its turns, not by a clock, since the whole job may be suspended."""

from __future__ import annotations

import time

# The most that one turn counts.
_LONGEST_TURN = 1.0


class TurnClock:
    """Seconds during which this process has run. One turn counts at most a second, however long the process was stopped
    meanwhile, or its interpreter busy.
    """

    def __init__(self) -> None:
        #: Seconds since the start, as of the last turn.
        self.now = 0.0
        self._last = time.monotonic()

    def turn(self) -> float:
        """Called by one thread, in each of its turns; returns `now`."""
        last, self._last = self._last, time.monotonic()
        self.now += max(0.0, min(self._last - last, _LONGEST_TURN))
        return self.now
