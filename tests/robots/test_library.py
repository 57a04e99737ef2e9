"""The C header: it compiles as C and C++, and programs find what Python finds."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from support.arms import beams, boxes, loaded

from pgccd.robots import motion_library

ROOT = Path(__file__).resolve().parents[2]
HEADER, EXAMPLE = ROOT / "csrc/library", ROOT / "examples/library/rrt_connect.cpp"

# Reads motions (start, goal) from a file of doubles and prints what is found of each.
PROGRAM = """
#include <pgccd.h>
#include <stdio.h>
#include <stdlib.h>

int main(int count, char** arguments) {
  char message[512];
  double ends[16];
  uint8_t valid[2];
  pgccd_validator *validator, *other;
  FILE* in;
  if (count != 3) return 3;
  validator = pgccd_validator_load(arguments[1], message, sizeof(message));
  if (!validator) {
    puts(message);
    return 2;
  }
  other = pgccd_validator_clone(validator);
  in = fopen(arguments[2], "rb");
  printf("%d %d\\n", (int)pgccd_coordinate_count(validator), (int)pgccd_body_count(validator));
  while (in && fread(ends, sizeof(double), 8, in) == 8) {
    pgccd_motion motion;
    const int verdict = pgccd_check_motion(validator, ends, ends + 4, 0, &motion);
    const int is_free = pgccd_check_motion(other, ends, ends + 4, 0, NULL) == PGCCD_FREE;
    pgccd_check_states(other, ends, 2, valid);
    printf("%d %.17g %d %d %d %d %d\\n", verdict, motion.free_until, (int)motion.bodies[0], (int)motion.bodies[1],
           is_free, valid[0], valid[1]);
  }
  fclose(in);
  pgccd_validator_free(validator);
  pgccd_validator_free(other);
  return 0;
}
"""


@pytest.mark.parametrize(("compiler", "suffix", "standard"), [("cc", "c", "c99"), ("c++", "cpp", "c++11")])
def test_the_header_is_c_and_cpp(compiler: str, suffix: str, standard: str, tmp_path: Path) -> None:
    if shutil.which(compiler) is None:
        pytest.skip("no compiler")
    source = tmp_path / f"program.{suffix}"
    source.write_text(PROGRAM)
    flags = [f"-std={standard}", "-pedantic", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", f"-I{HEADER}"]
    subprocess.run([compiler, *flags, str(source)], check=True)


def test_files_that_are_no_validators(tmp_path: Path) -> None:
    robot = loaded(beams(2), tmp_path)
    robot.motion_validator().save(tmp_path / "arm.pgccd")
    whole = (tmp_path / "arm.pgccd").read_bytes()
    rng = np.random.default_rng(0)
    changed = bytearray(whole)
    cases = [(b"", "too short"), (whole[:40], "too short|damaged"), (b"x" * 4000, "not a validator")]
    cases += [(whole[:-9], "damaged")]
    for place in rng.integers(24, len(whole), 200):
        changed[place] ^= 1 << int(rng.integers(8))
        cases.append((bytes(changed), "damaged"))
        changed[place] = whole[place]
    message = ctypes.create_string_buffer(512)
    for content, expected in cases:
        (tmp_path / "other").write_bytes(content)
        assert not motion_library._library.pgccd_validator_load(bytes(tmp_path / "other"), message, 512)
        assert any(each in message.value.decode() for each in expected.split("|")), message.value
    assert not motion_library._library.pgccd_validator_load(bytes(tmp_path / "none"), message, 512)
    assert b"cannot be read" in message.value
    handle = motion_library._library.pgccd_validator_load(bytes(tmp_path / "arm.pgccd"), message, 512)
    assert handle
    motion_library._library.pgccd_validator_free(handle)
    with pytest.raises(OSError, match="cannot be written"):
        robot.motion_validator().save(tmp_path / "no" / "arm.pgccd")


def test_tables_are_checked() -> None:
    tables = [torch.zeros(1)] * 31
    for given, message in ((tables[:5], "expected 31 tables"), (tables, "table 8: expected two rows or more")):
        with pytest.raises(ValueError, match=message):
            motion_library.NativeValidator.of(given, 1, 0.0, 1e-3)


def test_cmake_finds_all_sources(tmp_path: Path) -> None:
    if shutil.which("cmake") is None:
        pytest.skip("no CMake")
    subprocess.run(["cmake", "-S", str(HEADER), "-B", str(tmp_path)], check=True)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_programs(tmp_path: Path) -> None:
    """The library as CMake builds it, in a C program and in the planner of the examples."""
    if shutil.which("cmake") is None or shutil.which("cc") is None:
        pytest.skip("no CMake or compiler")
    build, prefix = tmp_path / "build", tmp_path / "prefix"
    subprocess.run(["cmake", "-S", str(HEADER), "-B", str(build), f"-DCMAKE_INSTALL_PREFIX={prefix}"], check=True)
    subprocess.run(["cmake", "--build", str(build), "--target", "install", "-j", "2"], check=True)
    (library,) = prefix.rglob("libpgccd.so")
    (tmp_path / "program.c").write_text(PROGRAM)
    options = [f"-I{prefix / 'include'}", f"-L{library.parent}", f"-Wl,-rpath,{library.parent}", "-lpgccd", "-pthread"]
    for compiler, source, name in (("cc", tmp_path / "program.c", "check"), ("c++", EXAMPLE, "plan")):
        subprocess.run([compiler, "-O2", str(source), *options, "-o", str(tmp_path / name)], check=True)
    rng = np.random.default_rng(6)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 3, 0.5, 1.2)
    validator = robot.motion_validator(obstacles)
    validator.save(tmp_path / "arm.pgccd")
    ends = rng.uniform(-1, 1, (60, 2, 4))
    (tmp_path / "motions").write_bytes(ends.tobytes())
    files = [str(tmp_path / "arm.pgccd"), str(tmp_path / "motions")]
    done = subprocess.run([str(tmp_path / "check"), *files], check=True, capture_output=True, text=True)
    head, *lines = done.stdout.splitlines()
    assert head == f"4 {robot.body_count + 3}" and len(lines) == 60
    states = validator.check_states(torch.tensor(ends.reshape(-1, 4))).reshape(-1, 2)
    for line, (a, b), valid in zip(lines, ends, states.tolist(), strict=True):
        verdict, until, *rest = line.split()
        found = validator.check(a, b)
        assert int(verdict) == found.verdict and float(until) == found.free_until
        assert [int(each) for each in rest[2:]] == [int(found.free_until == 1.0), *map(int, valid)]
    start, goal = [[0.3, -0.8, 0.2, 0.4], [-0.6, 0.9, -0.4, 0.1]]
    if not bool(validator.check_states([start, goal]).all()):
        raise AssertionError("choose other ends")
    given = [str(x) for x in (*start, *goal)]
    done = subprocess.run([str(tmp_path / "plan"), files[0], *given], check=True, capture_output=True, text=True)
    path = torch.tensor([[float(x) for x in line.split()] for line in done.stdout.splitlines()], dtype=torch.float64)
    assert path[0].tolist() == start and path[-1].tolist() == goal
    assert bool(robot.certify(path[None], obstacles).free[0])
    refused = subprocess.run([str(tmp_path / "check"), files[1], files[1]], capture_output=True, text=True)
    assert refused.returncode == 2 and "not a validator" in refused.stdout
