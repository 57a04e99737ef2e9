"""pgccd compared with other programs, one panel per question."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Result = dict[str, Any]
Row = dict[str, Any]

_OURS, _PEER = "#0072b2", "#9a9a9a"
_UNITS = {
    "pairs": "milliseconds a pair",
    "many bodies": "milliseconds a step",
    "broad phase": "milliseconds a scene",
    "line search": "milliseconds a direction",
}
_ERRORS = ("missed", "extra", "longer", "shorter")


def peers(result: Result) -> Figure:
    """Median times on a logarithmic axis; next to each bar its time and the errors or omissions."""
    questions: dict[str, list[Row]] = {}
    for row in result["rows"]:
        questions.setdefault(row["question"], []).append(row)
    heights = [len(rows) + 1.8 for rows in questions.values()]
    figure, panels = plt.subplots(
        len(questions), 1, figsize=(9, 0.26 * sum(heights)), height_ratios=heights, squeeze=False
    )
    for axes, (question, rows) in zip(panels[:, 0], questions.items(), strict=True):
        _panel(axes, question, rows)
    return figure


def _panel(axes: Axes, question: str, rows: list[Row]) -> None:
    times = [row["ms"]["median"] for row in rows]
    for place, (row, time) in enumerate(zip(rows, times, strict=True)):
        axes.barh(place, time, color=_OURS if row["program"].startswith("pgccd") else _PEER)
        axes.text(1.06 * time, place, f"{time:.3g}{_errors(row)}", va="center", fontsize=7)
    axes.set_yticks(range(len(rows)), [f"{row['program']} {row['version']}" for row in rows], fontsize=7)
    axes.set(xscale="log", xlim=(min(times) / 2, max(times) * 60), title=f"{question}: {_scene(rows[0])}")
    axes.set_xlabel(_UNITS.get(question, "milliseconds"), fontsize=8)
    axes.invert_yaxis()


def _errors(row: Row) -> str:
    found = [f"{row[name]:,} {name}" for name in _ERRORS if row.get(name)]
    of = f" of {row['true']:,}" if row.get("missed") and row.get("true") else ""
    return f"   {', '.join(found)}{of}" if found else ""


def _scene(row: Row) -> str:
    facts = {
        "pairs": lambda: f"first toi of two bodies of {row['triangles']} triangles, {row['pairs']} pairs",
        "many bodies": lambda: f"{row['robots']:,} robots of 700 triangles, one step",
        "broad phase": lambda: f"{row['bodies']:,} swept spheres, {row['pairs_a_body']:.3g} true pairs a body",
        "line search": lambda: f"{row['robots']} soft robots, {row['vertices']:,} vertices, how far they may move",
    }
    made = facts.get(row["question"], lambda: "every contact, and how far it may move")
    return f"{made()}, {row['device']}"
