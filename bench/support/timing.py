"""Timing of calls, and summaries of durations."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch


def seconds(work: Callable[[], Any], device: torch.device | str = "cpu") -> tuple[float, Any]:
    """Duration of one call and its result: device events on a GPU (the call's own work only), otherwise wall-clock
    time.
    """
    if torch.device(device).type != "cuda":
        start = time.perf_counter()
        result = work()
        return time.perf_counter() - start, result
    torch.cuda.synchronize()
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    begin.record()
    result = work()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end) * 1e-3, result


def host_loop() -> float:
    """Seconds to add up 400,000 numbers in plain Python: shows whether the core is slower than before or shared."""
    start, total = time.perf_counter(), 0
    for _ in range(20):
        for number in range(20_000):
            total += number
    return time.perf_counter() - start


def alone_ms(row: dict[str, Any]) -> float:
    """Milliseconds of a step of one rank. Rows of 0.1.0 have those of a loop without ranks besides."""
    return float((row.get("single_process_ms") or row["ms"])["median"])


def summary(samples: list[float], unit: float = 1e3) -> dict[str, float]:
    """Median and spread of durations in seconds, as milliseconds (or 1 / `unit` seconds)."""
    values = np.array(samples) * unit
    low, median, high = np.percentile(values, [10, 50, 90])
    return {
        "median": rounded(median),
        "low10": rounded(low),
        "high90": rounded(high),
        "mean": rounded(values.mean()),
        "samples": len(values),
    }


def rounded(value: float) -> float:
    """Four significant digits: more would be noise."""
    return float(f"{value:.4g}")
