"""The counts of a rank's searches, summed over its parts into the figures of one step."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pgccd.detection.capacity import COUNT_ROWS
from pgccd.sim.tally import WORK, GatheredCounts

intervals = st.tuples(st.integers(0, 30), st.integers(0, 12)).map(lambda given: (given[0], given[0] + given[1]))


@given(
    st.integers(1, 3).flatmap(lambda parts: st.lists(st.lists(intervals, min_size=parts, max_size=parts), min_size=1))
)
def test_parts_searched_side_by_side_count_once(ranks: list[list[tuple[int, int]]]) -> None:
    counts = np.zeros((len(ranks), len(ranks[0]), len(COUNT_ROWS)), dtype=np.int64)
    counts[:, :, COUNT_ROWS["traverse_began"]] = [[begin for begin, _ in parts] for parts in ranks]
    counts[:, :, COUNT_ROWS["narrow_ended"]] = [[end for _, end in parts] for parts in ranks]
    counts[:, :, COUNT_ROWS["pairs_written"]] = 7
    work = GatheredCounts(np.arange(len(ranks)), counts).work
    busy = [len({moment for begin, end in parts for moment in range(begin, end)}) for parts in ranks]
    assert work[:, WORK.index("nanoseconds")].tolist() == busy
    assert work[:, WORK.index("pcs")].tolist() == [7 * len(ranks[0])] * len(ranks)
    assert work[:, WORK.index("secondary_contacts")].tolist() == list(range(len(ranks)))
