"""Figures 4, 5 and 6 of Du, Liu & Suzumura (2017), redrawn."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from support.evaluation import WORLDS, world_of

Result = dict[str, Any]
Row = dict[str, Any]

_COLOURS = {"PCCCD": "#9a9a9a", "PGCCD": "#0072b2", "PGCCD+LB": "#d55e00", "PGCCD, by cost": "#009e73"}
_BY_SIZE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9")


def figure4(result: Result) -> Figure:
    """Speedup over PCCCD by number of robots; and times."""
    figure, panels = plt.subplots(2, len(WORLDS), figsize=(15, 6.4), sharex=True)
    for (above, below), (world, space) in zip(panels.T, WORLDS.items(), strict=True):
        for system in ("PGCCD", "PGCCD+LB", "PCCCD"):
            # PCCCD does not depend on the partition. Its best number of ranks has a speedup of 1.
            same = [row for row in result["rows"] if (row["system"], row["pattern"]) == (system, space.pattern)]
            rows = [row for row in same if (row["speedup"] == 1 if system == "PCCCD" else world_of(row) == world)]
            robots = [row["robots"] for row in rows]
            label = f"{system}, {'GPU' if rows and rows[0]['device'] == 'cuda' else 'CPU'}"
            if system != "PCCCD":
                above.plot(robots, [row["speedup"] for row in rows], "o-", color=_COLOURS[system], label=label)
            below.plot(robots, [row["ms"]["median"] for row in rows], "o-", color=_COLOURS[system], label=label)
        above.set(title=f"{world}, {result['ranks']} ranks")
        below.set(xlabel="robots (700 triangles each)", yscale="log")
        below.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        below.set_xticks(sorted({row["robots"] for row in result["rows"]}))
        below.legend(frameon=False, fontsize=8)
    panels[0][0].set_ylabel("times as fast as PCCCD")
    panels[1][0].set_ylabel("milliseconds a step")
    top = 1.1 * max(row["speedup"] for row in result["rows"])
    for axes in panels[0]:
        axes.set_ylim(0, top)
    _share_y(panels[1])
    return figure


def figure5(result: Result) -> Figure:
    """Time of a step by number of ranks."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.2))
    sizes = sorted({row["robots"] for row in result["rows"]})
    for axes, pattern in zip(panels, ("random", "skewed"), strict=True):
        for robots, colour in zip(sizes, _BY_SIZE, strict=False):
            for system, style in (("PGCCD", "o:"), ("PGCCD+LB", "s-")):
                rows = [
                    row
                    for row in result["rows"]
                    if (row["robots"], row["pattern"]) == (robots, pattern)
                    and (row["system"] == system or row["ranks"] == 1)
                ]
                rows.sort(key=lambda row: row["ranks"])
                times = [row["ms"]["median"] for row in rows]
                label = f"{robots:,}{', balanced' if system == 'PGCCD+LB' else ''}"
                axes.plot([row["ranks"] for row in rows], times, style, color=colour, label=label)
        axes.set(xlabel="ranks", title=f"{pattern} world", yscale="log")
        axes.set_xticks(sorted({row["ranks"] for row in result["rows"]}))
    panels[0].set_ylabel("milliseconds a step")
    _share_y(panels)
    panels[1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), title="robots")
    return figure


def figure6(result: Result) -> Figure:
    """Time of a step relative to no balancing, and imbalance, by threshold of load balancing."""
    figure, panels = plt.subplots(2, len(WORLDS), figsize=(15, 6.0), sharex=True)
    sizes = sorted({row["robots"] for row in result["rows"]})
    for (above, below), world in zip(panels.T, WORLDS, strict=True):
        for robots, colour in zip(sizes, _BY_SIZE, strict=False):
            rows = [row for row in result["rows"] if world_of(row) == world and row["robots"] == robots]
            unbalanced = next(row["ms"]["median"] for row in rows if row["system"] == "PGCCD")
            _threshold_panel(above, rows, lambda row, base=unbalanced: row["ms"]["median"] / base, colour)
            _threshold_panel(below, rows, lambda row: row["imbalance"], colour)
        above.set(title=f"{world}, {result['ranks']} ranks")
        below.set(xlabel="threshold (%)")
    panels[0][0].set_ylabel("time of a step over that without balancing")
    panels[1][0].set_ylabel("largest load over mean load")
    for row, low in zip(panels, (0.0, 1.0), strict=True):
        _share_y(row)
        for axes in row:
            axes.set_ylim(bottom=low)
    panels[0][-1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _threshold_panel(axes: Axes, rows: list[Row], value: Any, colour: str) -> None:
    balanced = sorted((row for row in rows if row["system"] == "PGCCD+LB"), key=lambda row: row["threshold"])
    thresholds = [100 * row["threshold"] for row in balanced]
    size = f"{rows[0]['robots']:,}"
    axes.plot(thresholds, [value(row) for row in balanced], "s-", color=colour, label=f"{size}, one cell a step")
    for system, label, style in (("PGCCD", "no balancing", ":"), ("PGCCD, by cost", "by cost (default)", "--")):
        height = next(value(row) for row in rows if row["system"] == system)
        axes.axhline(height, linestyle=style, color=colour, label=f"{size}, {label}")
    axes.set_xticks(thresholds)


def _share_y(panels: Any) -> None:
    low = min(axes.get_ylim()[0] for axes in panels)
    high = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(low, high)
        if axes.get_yscale() == "log":
            ticks = [m * 10.0**e for e in range(-3, 6) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
            axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.yaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_minor_formatter(NullFormatter())


def ablations(result: Result) -> Figure:
    """Each question's variants, relative to the first."""
    questions = list(dict.fromkeys(row["question"] for row in result["rows"]))
    figure, panels = plt.subplots(1, len(questions), figsize=(2.6 * len(questions), 3.6))
    for axes, question in zip(panels, questions, strict=True):
        rows = [row for row in result["rows"] if row["question"] == question]
        names = [row["variant"].replace(" ", "\n", 1) for row in rows]
        heights = [row["ms"]["median"] for row in rows]
        axes.bar(names, heights, color=[_COLOURS["PGCCD"], *[_COLOURS["PCCCD"]] * (len(rows) - 1)])
        for name, height in zip(names, heights, strict=True):
            axes.text(name, height, f"{height:.3g}", ha="center", va="bottom", fontsize=7)
        axes.set(title=question, ylim=(0, 1.15 * max(heights)))
        axes.tick_params(axis="x", labelsize=7)
    panels[0].set_ylabel("milliseconds")
    figure.suptitle(f"{result['robots']:,} robots, one thing changed at a time", fontsize=9)
    return figure
