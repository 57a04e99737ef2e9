"""Summary of a finished run: its statistics."""

from typing import Any

from pgccd.sim.runner import Run


def totals(run: Run) -> dict[str, Any]:
    """Robots, steps, pcs and contacts over all steps, and mean seconds per step."""
    return {
        "robots": run.model.config.robots,
        "steps": run.steps_made,
        "pcs": _sum(run, "pcs"),
        "contacts": _sum(run, "contacts"),
        "seconds_per_step": f"{_sum(run, 'seconds') / max(1, len(run.records)):.6f}",
    }


def summary_lines(run: Run) -> list[str]:
    """Lines of a table: quantity, value, reference value."""
    steps, robots = max(1, len(run.records)), run.model.config.robots
    pcs, contacts, stopped = _sum(run, "pcs"), _sum(run, "contacts"), _sum(run, "stopped")
    slowest = max((record["seconds"] for record in run.records), default=0.0)
    rows = [
        ("potentially colliding pairs (pcs), all steps", f"{pcs:,}", f"{pcs / steps / robots:.3f} a robot and step"),
        ("contacts (colliding pairs), all steps", f"{contacts:,}", f"{contacts / steps / robots:.4f} a robot and step"),
        ("robots stopped, mean of a step", f"{stopped / steps:,.1f}", f"{stopped / steps / robots:.2%}"),
        ("candidate feature pairs, all steps", f"{_sum(run, 'candidates'):,}", ""),
        ("unresolved contacts, all steps", f"{_sum(run, 'unresolved'):,}", ""),
        ("contacts at the start of a step, all steps", f"{_sum(run, 'touching_at_t0'):,}", "0: no robots overlap"),
        ("seconds of a step, mean", f"{_sum(run, 'seconds') / steps:.4f}", f"slowest {slowest:.4f}"),
    ]
    for stage in run.records[0]["stage_seconds"] if run.records else ():
        seconds = sum(record["stage_seconds"].get(stage, 0.0) for record in run.records)
        rows.append((f"  {stage}", f"{seconds / steps:.4f}", ""))
    if run.records:
        rows.append(("contacts hash of the last step", run.records[-1]["contacts_hash"], ""))
        rows.append(("state hash after it", run.records[-1]["state_hash"], ""))
    width = max(len(name) for name, _, _ in rows)
    return [f"{name:<{width}}  {value:>16}  {note}".rstrip() for name, value, note in rows]


def _sum(run: Run, name: str) -> Any:
    return sum(record[name] for record in run.records)
