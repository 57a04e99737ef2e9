"""Mutants of steps on many ranks."""

from __future__ import annotations

from mutants_of.mutant import Mutant

MUTANTS = [
    Mutant(
        "world-without-census",
        "pgccd/distributed/world/world.py",
        "Census.of_ranks(self.comm, self.id).require(self.census)",
        "pass",
        ("distributed/test_census.py",),
        switched=False,
    ),
    Mutant(
        "census-counts-only",
        "pgccd/distributed/halo/migrate.py",
        "if self != expected:",
        "if self.count != expected.count:",
        ("distributed/test_census.py",),
        switched=False,
    ),
    Mutant(
        "census-hashes-only",
        "pgccd/distributed/halo/migrate.py",
        "if self != expected:",
        "if self.ids != expected.ids:",
        ("distributed/test_census.py",),
        switched=False,
    ),
    Mutant(
        "distributed-simulation-without-census",
        "pgccd/sim/distributed/simulation.py",
        "Census(tally.robots, tally.id_hash).require(self._expected)",
        "pass",
        ("distributed/test_census.py",),
        switched=False,
    ),
]
