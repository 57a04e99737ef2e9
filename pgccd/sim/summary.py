"""Summary of a finished run: its statistics."""

from collections import Counter
from typing import Any

from pgccd.sim.runner import Run

_SUMMED = ("pcs", "contacts", "stopped", "candidates", "unresolved", "touching_at_t0")


class Totals:
    """Sums over the log of a run, which is read once.

    Args:
        run: a finished one.
    """

    def __init__(self, run: Run) -> None:
        self.robots, self.steps = run.model.config.robots, run.steps_made
        self.logged, self.slowest, self.seconds = 0, 0.0, 0.0
        self._sums: Counter[str] = Counter()
        self._stages: dict[str, float] = {}
        self._last: dict[str, Any] = {}
        for record in run.iterate():
            if not self.logged:
                self._stages = dict.fromkeys(record["stage_seconds"], 0.0)
            self.logged += 1
            self.seconds += record["seconds"]
            self.slowest = max(self.slowest, record["seconds"])
            self._sums.update({name: record[name] for name in _SUMMED})
            for stage in self._stages:
                self._stages[stage] += record["stage_seconds"].get(stage, 0.0)
            self._last = record

    @property
    def figures(self) -> dict[str, Any]:
        """Robots, steps, pcs and contacts over all steps, and mean seconds per step."""
        return {
            "robots": self.robots,
            "steps": self.steps,
            "pcs": self._sums["pcs"],
            "contacts": self._sums["contacts"],
            "seconds_per_step": f"{self.seconds / max(1, self.logged):.6f}",
        }

    @property
    def lines(self) -> list[str]:
        """Lines of a table: quantity, value, reference value."""
        steps, robots, sums = max(1, self.logged), self.robots, self._sums
        per_step = f"{sums['pcs'] / steps / robots:.3f} a robot and step"
        colliding = f"{sums['contacts'] / steps / robots:.4f} a robot and step"
        stopped = sums["stopped"] / steps
        rows = [
            ("potentially colliding pairs (pcs), all steps", f"{sums['pcs']:,}", per_step),
            ("contacts (colliding pairs), all steps", f"{sums['contacts']:,}", colliding),
            ("robots stopped, mean of a step", f"{stopped:,.1f}", f"{stopped / robots:.2%}"),
            ("candidate feature pairs, all steps", f"{sums['candidates']:,}", ""),
            ("unresolved contacts, all steps", f"{sums['unresolved']:,}", ""),
            ("contacts at the start of a step, all steps", f"{sums['touching_at_t0']:,}", "0: no robots overlap"),
            ("seconds of a step, mean", f"{self.seconds / steps:.4f}", f"slowest {self.slowest:.4f}"),
        ]
        rows += [(f"  {stage}", f"{seconds / steps:.4f}", "") for stage, seconds in self._stages.items()]
        if self._last:
            rows.append(("contacts hash of the last step", self._last["contacts_hash"], ""))
            rows.append(("state hash after it", self._last["state_hash"], ""))
        width = max(len(name) for name, _, _ in rows)
        return [f"{name:<{width}}  {value:>16}  {note}".rstrip() for name, value, note in rows]
