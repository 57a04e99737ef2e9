"""Mutants of steps on many ranks."""

from __future__ import annotations

from mutants_of.mutant import Mutant

CHANNEL = "pgccd/distributed/guard/channel.py"
ON_GUARD = ("distributed/guard/test_channel.py", "distributed/guard/test_guard.py")

MUTANTS = [
    Mutant("lines-without-number", CHANNEL, 'number + line, "sha256"', 'line, "sha256"', ON_GUARD, switched=False),
    Mutant(
        "lines-one-key-for-both",
        CHANNEL,
        'for side in (b"hub", b"rank"))',
        'for side in (b"hub", b"hub"))',
        ON_GUARD,
        switched=False,
    ),
    Mutant(
        "lines-mac-not-compared",
        CHANNEL,
        "if not hmac.compare_digest(mac, self._mac(line, 1)):",
        "if False:",
        ON_GUARD,
        switched=False,
    ),
    Mutant("lines-repeated", CHANNEL, "self._counts[1] += 1", "pass", ON_GUARD, switched=False),
    Mutant(
        "lines-after-a-wrong-one",
        CHANNEL,
        'self.has_ended, self._received = True, b""',
        "self.has_ended = False",
        ON_GUARD,
        switched=False,
    ),
    Mutant(
        "verdicts-as-they-come",
        CHANNEL,
        'c if c.isprintable() else c.encode("unicode_escape").decode()',
        "c",
        ON_GUARD,
        switched=False,
    ),
    Mutant(
        "world-without-census",
        "pgccd/distributed/world/world.py",
        "IdChecksum.of_ranks(self.comm, self.id).require(self.id_checksum)",
        "pass",
        ("distributed/halo/test_migrate.py",),
        switched=False,
    ),
    Mutant(
        "census-counts-only",
        "pgccd/distributed/halo/migrate.py",
        "if self != expected:",
        "if self.count != expected.count:",
        ("distributed/halo/test_migrate.py",),
        switched=False,
    ),
    Mutant(
        "census-hashes-only",
        "pgccd/distributed/halo/migrate.py",
        "if self != expected:",
        "if self.ids != expected.ids:",
        ("distributed/halo/test_migrate.py",),
        switched=False,
    ),
    Mutant(
        "distributed-simulation-without-census",
        "pgccd/sim/simulation.py",
        "IdChecksum(tally.robots, tally.id_hash).require(self._expected)",
        "pass",
        ("distributed/halo/test_migrate.py",),
        switched=False,
    ),
    Mutant(
        "resolved-ghosts-never-change",
        "pgccd/distributed/detection/share.py",
        'held.ghosts["changed"]',
        'torch.zeros_like(held.ghosts["changed"])',
        ("distributed/world/test_resolve.py",),
        switched=False,
    ),
    Mutant(
        "resolved-ghosts-are-at-rest",
        "pgccd/distributed/world/resolve.py",
        'share.held.ghosts["rest"]',
        'torch.ones_like(share.held.ghosts["rest"])',
        ("distributed/world/test_resolve.py",),
        switched=False,
    ),
    Mutant(
        "resolved-without-contacts-of-others",
        "pgccd/distributed/world/resolve.py",
        "comm.any(len(hits) > 0)",
        "comm.any(len(hits) > 1)",
        ("distributed/world/test_resolve.py",),
        switched=False,
    ),
    Mutant(
        "stopped-body-turns-on",
        "pgccd/resolution/trajectories.py",
        "torch.where(stopped, 0.0, step.rotation)",
        "step.rotation",
        ("resolution/test_trajectories.py",),
        switched=False,
    ),
    Mutant(
        "stopped-body-goes-on",
        "pgccd/resolution/trajectories.py",
        "stopped | newly",
        "newly",
        ("resolution/test_trajectories.py",),
        switched=False,
    ),
]
