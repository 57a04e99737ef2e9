"""Rows and totals of the elementary benchmark: errors, deciding arithmetic and times of single queries."""

from __future__ import annotations

from typing import Any

import numpy as np

import pgccd
from support import timing
from support.elementary import SIGNIFICANT_BITS, Batch

_MICRO = 1e6
_COUNTS = ("asked", "true", "missed", "false_positives")


class Tally:
    """Counts and seconds over batches of pgccd's results."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys((*_COUNTS, "unresolved"), 0)
        self._settled = np.zeros(len(SIGNIFICANT_BITS), dtype=np.int64)
        self._seconds = 0.0

    def add(self, batch: Batch, truth: np.ndarray) -> None:
        """Adds a batch and its truth."""
        for key, count in errors(batch.collides, truth).items():
            self._counts[key] += count
        self._counts["unresolved"] += int((batch.status == pgccd.Status.UNRESOLVED).sum())
        self._settled += [int((batch.significant_bits == bits).sum()) for bits in SIGNIFICANT_BITS]
        self._seconds += batch.seconds

    @property
    def true(self) -> int:
        """Number of colliding queries."""
        return self._counts["true"]

    @property
    def mean_us(self) -> float | None:
        """Microseconds per query over all batches."""
        return microseconds(self._seconds / self._counts["asked"]) if self._counts["asked"] else None

    def row(self) -> dict[str, Any]:
        """Counts, and the fraction of queries that each arithmetic decided."""
        share = self._settled / max(1, self._counts["asked"])
        settled = {str(bits): timing.rounded(part) for bits, part in zip(SIGNIFICANT_BITS, share, strict=True)}
        return self._counts | {"settled_by_bits": settled}


def errors(collides: np.ndarray, truth: np.ndarray) -> dict[str, int]:
    """Counts of queries, true contacts, misses and false positives."""
    counts = (len(truth), truth.sum(), (truth & ~collides).sum(), (~truth & collides).sum())
    return dict(zip(_COUNTS, map(int, counts), strict=True))


def percentiles(seconds: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Median and 99th percentile, in microseconds, of single colliding and free queries, and of all; for the latter
    also their ratio.
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
    """The slowest query: its microseconds, its name in the file, and its result."""
    k = int(np.argmax(seconds))
    return {
        "us": microseconds(float(seconds[k])),
        "query": names[k].tolist(),
        "status": pgccd.Status.names()[int(batch.status[k])].lower(),
        "significant_bits": int(batch.significant_bits[k]),
    }


def total(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sums over files, and means weighted by number of queries: one row per kind and method."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["rows"], row["method"]), []).append(row)
    return [{"rows": sort, "method": method} | _total(group) for (sort, method), group in groups.items()]


def slowest_of_all(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The slowest query of all rows, for each of pgccd's methods."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        if "slowest" in row and row["slowest"]["us"] > found.get(row["method"], {"us": -1.0})["us"]:
            found[row["method"]] = _with_place(row)
    return list(found.values())


def microseconds(seconds: float | None) -> float | None:
    """Seconds as rounded microseconds; None stays None."""
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
