"""Plots of the results: reads bench/results/*.json, writes bench/results/*.png. (Needs matplotlib.)"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402  (the backend first)
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter  # noqa: E402
from support import cluster_plots, evaluation_plots, peer_plots, results  # noqa: E402

Result = dict[str, Any]

# pgccd in colour, peers in grey. Stages have the same colours in all figures (colour-blind safe).
_OURS, _PEER = "#0072b2", "#9a9a9a"
_STAGES = {
    "plan": "#56b4e9", "bounds": "#cc79a7", "broad": "#e69f00", "traverse": "#0072b2",
    "narrow": "#009e73", "respond": "#d55e00", "hash": "#b0b0b0",
}  # fmt: skip

_BROAD_PHASES = {"sweep": "#e69f00", "grid": "#0072b2", "lbvh": "#009e73"}


def main() -> None:
    """Draws every result that has a figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--results", type=Path, default=results.FOLDER, help="folder of the JSON files and the pictures"
    )
    arguments = parser.parse_args()
    plt.rcParams.update(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 150, "axes.titlesize": 9}
    )
    for path in sorted(arguments.results.glob("*.json")):
        result = results.read(path)
        draw = _FIGURES.get(result["name"])
        if draw is None:
            continue
        figure = draw(result)
        figure.text(0.01, 0.005, _origin(result), fontsize=6, color="#606060")
        figure.tight_layout(rect=(0, 0.03, 1, 1))
        figure.savefig(path.with_suffix(".png"))
        plt.close(figure)
        print(path.with_suffix(".png").name)


def _world(result: Result) -> Figure:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
    rows = result["rows"]
    robots = [row["robots"] for row in rows]
    left.loglog(robots, [row["ms"]["median"] for row in rows], "o-", color=_OURS, label="detect, whole step")
    left.loglog(robots, [row["floor_ms"]["operations"] for row in rows], "--", color=_PEER, label="floor: operations")
    left.loglog(robots, [row["floor_ms"]["bytes"] for row in rows], ":", color=_PEER, label="floor: bytes")
    left.set(xlabel="robots (700 triangles each)", ylabel="milliseconds a step", title="Exact first toi of every pair")
    left.legend(frameon=False)
    below = [0.0] * len(rows)
    labels = [f"{count:,}" for count in robots]
    for stage in rows[0]["stage_ms"]:
        share = [1e3 * row["stage_ms"][stage] / row["robots"] for row in rows]
        right.bar(labels, share, bottom=below, label=stage, color=_STAGES.get(stage))
        below = [a + b for a, b in zip(below, share, strict=True)]
    right.set(xlabel="robots", ylabel="microseconds a robot", title="By stage")
    right.set_ylim(0.0, 1.25 * max(below))
    right.legend(frameon=False, fontsize=7, ncols=4, loc="upper center")
    return figure


def _broad_phase(result: Result) -> Figure:
    figure, axes = plt.subplots(figsize=(6.5, 4.0))
    _broad_phase_scenes(axes, result["scenes"])
    where = "one GPU" if "gpu" in result["made"]["device"] else f"{result['threads']} CPU thread"
    axes.set_title(f"{result['bodies']:,} swept spheres by scene (true pairs a body), {where}")
    return figure


def _broad_phase_scenes(axes: Axes, scenes: list[Result]) -> None:
    for offset, (name, colour) in enumerate(_BROAD_PHASES.items()):
        places = [index + 0.27 * (offset - 1) for index in range(len(scenes))]
        axes.barh(places, [scene["ms"][name] for scene in scenes], height=0.25, color=colour, label=name)
    labels = [f"{scene['scene']} ({scene['pairs_a_body']:.2g})" for scene in scenes]
    axes.set_yticks(range(len(scenes)), labels, fontsize=7)
    axes.set(xscale="log", xlabel="milliseconds")
    _label_1_2_5(axes)
    axes.invert_yaxis()
    axes.legend(frameon=False, fontsize=7)


def _label_1_2_5(axes: Axes) -> None:
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _narrow_phase(result: Result) -> Figure:
    panels: tuple[tuple[str, str, str], ...] = (
        ("exact list", "colliding_us", "Colliding queries of the scenes"),
        ("candidates", "mean_us", "Pairs with overlapping boxes"),
        ("queries", "free_us", "Free queries of the query files"),
    )
    panels = tuple(panel for panel in panels if any(row["rows"] == panel[0] for row in result["totals"]))
    figure, all_axes = plt.subplots(1, len(panels), figsize=(3.4 * len(panels), 3.4), squeeze=False)
    for axes, (sort, key, title) in zip(all_axes[0], panels, strict=True):
        rows = [row for row in result["totals"] if row["rows"] == sort and row[key] is not None]
        # One word per line, so that neighbours do not overlap.
        names = [row["method"].replace(" ", "\n").replace("-", "-\n") for row in rows]
        heights = [row[key] for row in rows]
        axes.bar(names, heights, color=[_colour(name) for name in names])
        for row, name, height in zip(rows, names, heights, strict=True):
            wrong = f"{row['missed']} missed\n{row['false_positives']} false pos.\nof {row['asked']:,}"
            axes.text(name, height * 1.1, f"{height:.3g} µs\n{wrong}", ha="center", fontsize=6)
        axes.set(yscale="log", title=title, ylim=(min(heights) / 2, max(heights) * 8))
        axes.tick_params(axis="x", labelsize=7)
    all_axes[0][0].set_ylabel("microseconds a query (mean)")
    return figure


def _growth(result: Result) -> Figure:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
    worlds = [row for row in result["rows"] if row["scene"] == "standard"]
    others = [row for row in result["rows"] if row["scene"] != "standard"]
    left.loglog([row["bodies"] for row in worlds], [row["ms"]["median"] for row in worlds], "o-", color=_OURS)
    left.set(xlabel="robots, standard world", ylabel="milliseconds a step", title="First contact of every pair")
    if worlds:
        peak = worlds[-1]["peak_bytes_a_body"]
        left.text(0.05, 0.9, f"{peak:,.0f} bytes a robot at most, in the largest", transform=left.transAxes, fontsize=7)
    names = [f"{row['scene']}\n{row['bodies']:,} bodies" for row in others]
    heights = [row["ms"]["median"] for row in others]
    right.bar(names, heights, color=_OURS)
    for name, row, height in zip(names, others, heights, strict=True):
        counts = f"{row['pcs_a_body']:.3g} pairs\n{row['candidates_a_body']:.3g} cand."
        right.text(name, height * 1.1, f"{height:.3g} ms\n{counts}", ha="center", fontsize=6)
    right.set(yscale="log", title="Other scenes, with pairs and candidates a body")
    if heights:
        right.set(ylim=(min(heights) / 2, max(heights) * 6))
    right.tick_params(axis="x", labelsize=5)
    return figure


_FIGURES: dict[str, Callable[[Result], Figure]] = {
    "world": _world,
    "broad_phase": _broad_phase,
    "growth": _growth,
    "peers": peer_plots.peers,
    "narrow_phase": _narrow_phase,
    "cluster_scaling": cluster_plots.scaling,
    "frame_pairs": cluster_plots.frame_pairs,
    "figure4": evaluation_plots.figure4,
    "figure5": evaluation_plots.figure5,
    "figure6": evaluation_plots.figure6,
    "ablations": evaluation_plots.ablations,
}


def _colour(name: str) -> str:
    return _OURS if name.startswith("pgccd") else _PEER


def _origin(result: Result) -> str:
    made = result["made"]
    device = made["device"].get("gpu", made["device"]["cpu"])
    return f"{device}, {made['device']['threads']} threads; pgccd {made['versions']['commit']}; {made['date']}"


if __name__ == "__main__":
    main()
