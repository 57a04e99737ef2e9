"""Finds a CUDA compiler that matches the installed torch. Standard library only."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple


class CudaToolkit(NamedTuple):
    """A folder that contains bin/nvcc, and nvcc's release, such as "13.0"."""

    home: Path
    version: str

    @property
    def compresses(self) -> bool:
        """Whether nvcc can be asked to compress device code for size, at the cost of time when it is first loaded."""
        major, minor = self.version.split(".")
        return (int(major), int(minor)) >= (12, 8)


def find_cuda_toolkit(torch_cuda_version: str) -> CudaToolkit | None:
    """The first toolkit with torch's major CUDA version (torch refuses to build with another)."""
    for home in _candidate_homes():
        version = _nvcc_release(home / "bin" / "nvcc")
        if version and version.split(".")[0] == torch_cuda_version.split(".")[0]:
            return CudaToolkit(home, version)
    return None


def architecture_flags(architectures: str) -> list[str]:
    """nvcc options for a list such as "8.0;9.0+PTX" (names as in TORCH_CUDA_ARCH_LIST).

    torch adds such flags itself only if no other flag contains "arch", which `-march` does.
    """
    flags = []
    for name in re.split(r"[ ;]+", architectures.strip()):
        match = re.fullmatch(r"(\d+)\.(\d+[af]?)(\+PTX)?", name)
        if not match:
            raise ValueError(f"TORCH_CUDA_ARCH_LIST: expected names such as 9.0 or 9.0+PTX, got {name!r}")
        number = match[1] + match[2]
        flags.append(f"-gencode=arch=compute_{number},code=sm_{number}")
        if match[3]:
            flags.append(f"-gencode=arch=compute_{number},code=compute_{number}")
    return flags


def static_runtime_directory(toolkit: CudaToolkit) -> Path:
    """The folder of the CUDA runtime that is linked statically."""
    # An installed toolkit, a conda environment or the PyPI wheels, and a cross-compiling toolkit.
    for directory in ("lib64", "lib", "targets/x86_64-linux/lib"):
        if (toolkit.home / directory / "libcudart_static.a").exists():
            return toolkit.home / directory
    raise FileNotFoundError(
        f"no libcudart_static.a under {toolkit.home}: install the CUDA runtime, or set PGCCD_CUDA=0"
    )


def _candidate_homes() -> Iterator[Path]:
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        if os.environ.get(variable):
            yield Path(os.environ[variable])
    if compiler := shutil.which("nvcc"):
        yield Path(compiler).resolve().parents[1]
    yield Path("/usr/local/cuda")
    # The wheels nvidia-cuda-nvcc, nvidia-nvvm, ... are installed into one folder of site-packages.
    for entry in sys.path:
        yield from sorted(Path(entry, "nvidia").glob("cu[0-9]*"))


def _nvcc_release(compiler: Path) -> str | None:
    try:
        answer = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        return None
    release = re.search(r"release (\d+\.\d+)", answer.stdout)
    return release[1] if release else None
