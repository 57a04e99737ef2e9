"""Host builds of C++ programs over csrc's headers, with the library's flags, to test device code on the host."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

CSRC = Path(__file__).resolve().parents[2] / "csrc"
FLAGS = ("-std=c++20", "-march=x86-64-v3", "-ffp-contract=off")


def run_program(text: str, folder: Path, optimization: str = "-O2") -> str:
    """Compiles and runs a program, and returns its output; fails with its output unless it returns 0."""
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    source, program = folder / "program.cpp", folder / "program"
    source.write_text(text)
    subprocess.run([compiler, *FLAGS, optimization, f"-I{CSRC}", str(source), "-o", str(program)], check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    return done.stdout
