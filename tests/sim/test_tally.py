"""The counts of a rank's searches, summed over its passes into the figures of one step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pgccd.resolution.counts import GatheredCounts
from pgccd.runtime.sizes import COUNT_ROWS
from pgccd.sim.reports import REPORTED
from pgccd.sim.step_graph import CommittedStep
from pgccd.sim.tally import COUNTED, WORK

intervals = st.tuples(st.integers(0, 30), st.integers(0, 12)).map(lambda given: (given[0], given[0] + given[1]))


@given(
    st.integers(1, 3).flatmap(lambda count: st.lists(st.lists(intervals, min_size=count, max_size=count), min_size=1))
)
def test_passes_searched_side_by_side_count_once(ranks: list[list[tuple[int, int]]]) -> None:
    counts = np.zeros((len(ranks), len(ranks[0]), len(COUNT_ROWS)), dtype=np.int64)
    counts[:, :, COUNT_ROWS["traverse_began"]] = [[begin for begin, _ in passes] for passes in ranks]
    counts[:, :, COUNT_ROWS["narrow_ended"]] = [[end for _, end in passes] for passes in ranks]
    counts[:, :, COUNT_ROWS["pairs_written"]] = 7
    work = GatheredCounts(np.arange(len(ranks)), counts).work
    busy = [len({moment for begin, end in passes for moment in range(begin, end)}) for passes in ranks]
    assert work[:, WORK.index("nanoseconds")].tolist() == busy
    assert work[:, WORK.index("pcs")].tolist() == [7 * len(ranks[0])] * len(ranks)
    assert work[:, WORK.index("secondary_contacts")].tolist() == list(range(len(ranks)))


def test_stages_of_a_replayed_step_do_not_overlap() -> None:
    counts = np.zeros((2, 2, len(COUNT_ROWS)), dtype=np.int64)
    names = ("broad_began", "broad_ended", "traverse_began", "traverse_ended", "narrow_ended")
    for number, times in enumerate(
        [(0, 10, 10, 40, 60), (5, 25, 25, 65, 75)]
    ):  # ghosts' pairs: 15 longer than own pairs
        for name, time in zip(names, times, strict=True):
            counts[1, number, COUNT_ROWS[name]] = 10**6 * time
    summaries = np.zeros((2, COUNTED + REPORTED), dtype=np.int64)
    record = CommittedStep(0, 1, 0.1, 1, GatheredCounts(np.zeros(2, np.int64), counts), summaries).record
    expected = {"broad": 0.01, "traverse": 0.03, "narrow": 0.02, "halo": 0.015, "respond": 0.025}
    assert record["stage_seconds"] == pytest.approx(expected)
    counts[1, 1, COUNT_ROWS["narrow_ended"]] = 55 * 10**6
    record = CommittedStep(0, 1, 0.1, 1, GatheredCounts(np.zeros(2, np.int64), counts), summaries).record
    assert record["stage_seconds"] == pytest.approx(expected | {"halo": 0.0, "respond": 0.04})
    alone = GatheredCounts(np.zeros(2, np.int64), counts[:, :1])
    assert "halo" not in CommittedStep(0, 1, 0.1, 1, alone, summaries).record["stage_seconds"]
