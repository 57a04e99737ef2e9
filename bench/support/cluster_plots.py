"""Figures of scaling over ranks."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Result = dict[str, Any]

_PARTS = {
    "detect": "#0072b2", "respond": "#d55e00", "halo": "#e69f00", "migrate": "#009e73", "balance": "#cc79a7",
    "plan": "#56b4e9", "hash": "#b0b0b0", "waiting": "#606060", "rest": "#dddddd",
}  # fmt: skip
_SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def scaling(result: Result) -> Figure:
    """Time of a step by stage and number of ranks; and speedup over one process."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 3.6), width_ratios=(3, 1))
    rows = [row for row in result["rows"] if row["pattern"] == "random" and row["overlap"] and "disturbed" not in row]
    fastest = {(row["scaling"], row["ranks"], row["robots"]): row for row in sorted(rows, key=_median, reverse=True)}
    _stack(left, list(fastest.values()))
    for (label, speeds), colour in zip(_series(rows), _SERIES, strict=False):
        right.plot(*zip(*speeds, strict=True), "o-", color=colour, label=label)
    most = max(row["ranks"] for row in rows)
    right.plot([1, most], [1, most], ":", color="#9a9a9a", label="ideal")
    right.set(xlabel="ranks", title="Times the speed of one process", xticks=sorted({row["ranks"] for row in rows}))
    right.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _median(row: dict[str, Any]) -> float:
    return float(row["ms"]["median"])


def _stack(axes: Axes, rows: list[dict[str, Any]]) -> None:
    order = {"strong": ("robots", "ranks"), "weak": ("ranks", "robots")}
    rows = sorted(rows, key=lambda row: [row["scaling"], *(row[name] for name in order[row["scaling"]])])
    names = [f"{_size(row)}\non {row['ranks']}" for row in rows]
    below = [0.0] * len(rows)
    for part, colour in _PARTS.items():
        # Overlapping work adds up to more than the whole step.
        heights = [max(0.0, row["mean_of_ranks_ms"].get(part, 0.0)) for row in rows]
        axes.bar(range(len(rows)), heights, bottom=below, color=colour, label=part, width=0.7)
        below = [base + height for base, height in zip(below, heights, strict=True)]
    axes.plot(range(len(rows)), [row["ms"]["median"] for row in rows], "k_", markersize=16, label="whole step")
    axes.set_xticks(range(len(rows)), names, fontsize=7)
    axes.set(
        ylabel="milliseconds a step (mean of ranks)",
        title="A step: robots on ranks, random world (halo while detecting)",
    )
    axes.legend(frameon=False, fontsize=6, ncols=2)


def _series(rows: list[dict[str, Any]]) -> list[tuple[str, list[tuple[int, float]]]]:
    """Speedups over one process by number of ranks, for each world size and transport."""
    series = []
    for base in (row for row in rows if row["ranks"] == 1):
        is_weak, single = base["scaling"] == "weak", base["single_process_ms"]["median"]
        for transport in sorted({row["transport"] for row in rows} - {base["transport"]}):
            speeds = [(1, single / base["ms"]["median"])]
            for row in sorted(rows, key=lambda row: row["ranks"]):
                ranks = row["ranks"]
                robots = base["robots"] * (ranks if is_weak else 1)
                if (row["scaling"], row["transport"], row["robots"]) == (base["scaling"], transport, robots):
                    speeds.append((ranks, single / row["ms"]["median"] * (ranks if is_weak else 1)))
            if len(speeds) > 1:
                series.append((f"{_size(base)} {'a rank' if is_weak else 'in all'}, {transport}", speeds))
    return series


def _size(row: dict[str, Any]) -> str:
    return f"{row['robots'] / 1e6:g} M"


def frame_pairs(result: Result) -> Figure:
    """Every colliding feature pair of public frame pairs, by stage."""
    figure, axes = plt.subplots(figsize=(6, 3.6))
    rows = [row for row in result["rows"] if row["report"] == "all" and row["initial"] == "report"]
    colours = {"bounds": "#cc79a7", "broad": "#e69f00", "traverse": "#0072b2", "narrow": "#009e73"}
    below = [0.0] * len(rows)
    for stage, colour in colours.items():
        heights = [row["stage_ms"].get(stage, 0.0) for row in rows]
        axes.bar(range(len(rows)), heights, bottom=below, color=colour, label=stage, width=0.6)
        below = [base + height for base, height in zip(below, heights, strict=True)]
    axes.plot(range(len(rows)), [row["ms"]["median"] for row in rows], "k_", markersize=24, label="whole call")
    names = [f"{row['scene']}\n{row['faces']:,} faces\n{row['contacts']:,} contacts" for row in rows]
    axes.set_xticks(range(len(rows)), names, fontsize=7)
    axes.set(ylabel="milliseconds", title="All colliding feature pairs with their toi, self-collisions included")
    axes.set_ylim(top=1.25 * max(row["ms"]["median"] for row in rows))
    axes.legend(frameon=False, fontsize=7, ncols=5, loc="upper center")
    return figure
