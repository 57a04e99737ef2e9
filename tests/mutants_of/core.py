"""Mutants of arithmetic: rounding, rotations, exact sums."""

from __future__ import annotations

from mutants_of.mutant import CORE, ON_CORE, Mutant

MUTANTS = [
    Mutant(
        "quaternion-not-divided",
        CORE + "rotation.h",
        "T(2.0) / (w * w + norm_squared(v))",
        "T(2.0)",
        ON_CORE,
    ),
    Mutant(
        "quaternions-not-normalised",
        CORE + "rotation.h",
        "normalized(q1) * conjugate(normalized(q0))",
        "q1 * conjugate(q0)",
        ON_CORE,
        equivalent="the angle is taken from a ratio and the axis divided by its length: both ignore the scale",
    ),
    Mutant(
        "shorter-way",
        CORE + "rotation.h",
        "turn.w < 0.0",
        "false",
        ("motion/test_paths.py",),
    ),
    Mutant(
        "arctangent-one-step",
        CORE + "trig.h",
        "step < 2",
        "step < 1",
        ("motion/test_paths.py",),
    ),
    Mutant(
        "reduction-without-middle",
        CORE + "trig.h",
        "std::fma(-quadrant, half_pi_middle, r)",
        "r",
        ("motion/test_paths.py",),
    ),
    Mutant(
        "reduction-without-low",
        CORE + "trig.h",
        "std::fma(-quadrant, half_pi_low, r)",
        "r",
        ("motion/test_paths.py",),
        equivalent="2^-110 of up to 2^20 quadrants is 2^-90, far below 2^-53; it affects only the relative error near"
        " the zeros, which is unspecified",
    ),
    Mutant(
        "sine-last-term",
        CORE + "trig.h",
        "1.0 / 355687428096000.0",
        "0.0",
        ("motion/test_paths.py", *ON_CORE),
        equivalent="(pi/4)^17 / 17! is 2^-54: less than the margin of the specified 2 units",
    ),
    Mutant(
        "sine-last-two-terms",
        CORE + "trig.h",
        "-1.0 / 1307674368000.0",
        "-q / 355687428096000.0",
        ("motion/test_paths.py", *ON_CORE),
    ),
    Mutant(
        "versine-last-term",
        CORE + "trig.h",
        "1.0 / 6402373705728000.0",
        "0.0",
        ("motion/test_paths.py", *ON_CORE),
        equivalent="(pi/4)^18 / 18! is 2^-59",
    ),
    Mutant(
        "versine-last-two-terms",
        CORE + "trig.h",
        "-1.0 / 20922789888000.0",
        "-q / 6402373705728000.0",
        ("motion/test_paths.py", *ON_CORE),
    ),
]
