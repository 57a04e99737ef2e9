"""Rows and totals of the elementary benchmark: wrong answers, the arithmetic that decided queries, times of single
queries.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import pgccd
from support import timing
from support.elementary import SIGNIFICANT_BITS, Batch

_MICRO = 1e6
_COUNTS = ("asked", "true", "missed", "false_positives")


class Tally:
    """Counts over batches of pgccd's answers, and the seconds they took."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys((*_COUNTS, "unresolved"), 0)
        self._settled = np.zeros(len(SIGNIFICANT_BITS), dtype=np.int64)
        self._seconds = 0.0

    def add(self, batch: Batch, truth: np.ndarray) -> None:
        """One more batch, with the right answers."""
        for key, count in errors(batch.collides, truth).items():
            self._counts[key] += count
        self._counts["unresolved"] += int((batch.status == pgccd.UNRESOLVED).sum())
        self._settled += [int((batch.significant_bits == bits).sum()) for bits in SIGNIFICANT_BITS]
        self._seconds += batch.seconds

    @property
    def true(self) -> int:
        """How many collide."""
        return self._counts["true"]

    @property
    def mean_us(self) -> float | None:
        """Microseconds a query over all batches."""
        return microseconds(self._seconds / self._counts["asked"]) if self._counts["asked"] else None

    def row(self) -> dict[str, Any]:
        """Counts, and the share of queries that each arithmetic decided."""
        share = self._settled / max(1, self._counts["asked"])
        settled = {str(bits): timing.rounded(part) for bits, part in zip(SIGNIFICANT_BITS, share, strict=True)}
        return self._counts | {"settled_by_bits": settled}


def errors(collides: np.ndarray, truth: np.ndarray) -> dict[str, int]:
    """Counts of wrong answers."""
    counts = (len(truth), truth.sum(), (truth & ~collides).sum(), (~truth & collides).sum())
    return dict(zip(_COUNTS, map(int, counts), strict=True))


def percentiles(seconds: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Median and 99th percentile, in microseconds, of single colliding and free queries, and of all; for these also
    the ratio of the two.
    """
    row: dict[str, Any] = {}
    for sort, chosen in (("colliding", truth), ("free", ~truth), ("all", np.ones_like(truth))):
        if chosen.any():
            median, high = np.percentile(seconds[chosen] * _MICRO, [50, 99])
            row[f"{sort}_single_us_p50_p99"] = [timing.rounded(median), timing.rounded(high)]
            if sort == "all":
                row["p99_over_p50"] = timing.rounded(high / median) if median > 0.0 else None
    return row


def slowest(seconds: np.ndarray, batch: Batch, names: np.ndarray) -> dict[str, Any]:
    """The query that took longest: its microseconds, what it is called in its file, and how it was answered."""
    k = int(np.argmax(seconds))
    return {
        "us": microseconds(float(seconds[k])),
        "query": names[k].tolist(),
        "status": pgccd.narrow.Status(int(batch.status[k])).name.lower(),
        "significant_bits": int(batch.significant_bits[k]),
    }


def total(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sums, and means weighted by the number of queries, over files: one row for each sort and method."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["rows"], row["method"]), []).append(row)
    return [{"rows": sort, "method": method} | _total(group) for (sort, method), group in groups.items()]


def slowest_of_all(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each of pgccd's methods, the query that took longest in all rows."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        if "slowest" in row and row["slowest"]["us"] > found.get(row["method"], {"us": -1.0})["us"]:
            found[row["method"]] = _with_place(row)
    return list(found.values())


def microseconds(seconds: float | None) -> float | None:
    """Rounded; None stays None."""
    return None if seconds is None else timing.rounded(seconds * _MICRO)


def _total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {key: sum(row[key] for row in rows) for key in _COUNTS}
    for key, count in (
        ("colliding_us", lambda row: row["true"]),
        ("free_us", lambda row: row["asked"] - row["true"]),
        ("mean_us", lambda row: row["asked"]),
    ):
        out[key] = _mean([(row[key], count(row)) for row in rows if row.get(key) is not None])
    if "settled_by_bits" in rows[0]:
        out["settled_by_bits"] = {
            bits: _mean([(row["settled_by_bits"][bits], row["asked"]) for row in rows])
            for bits in rows[0]["settled_by_bits"]
        }
        out["slowest"] = _with_place(max(rows, key=lambda row: row["slowest"]["us"]))
    return out


def _mean(values: list[tuple[float, int]]) -> float | None:
    weight = sum(count for _, count in values)
    return timing.rounded(sum(value * count for value, count in values) / weight) if weight else None


def _with_place(row: dict[str, Any]) -> dict[str, Any]:
    place = {key: row[key] for key in ("method", "rows", "set", "kind")}
    return place | row["slowest"]
