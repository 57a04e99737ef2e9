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


def cudart_link_directory(toolkit: CudaToolkit, scratch: Path) -> Path:
    """The folder in which the linker finds `libcudart.so`.

    The PyPI wheels contain only the versioned name, `libcudart.so.13`; for them it creates a link in `scratch`.
    """
    library_directories = [toolkit.home / name for name in ("lib64", "lib")]
    for directory in library_directories:
        if (directory / "libcudart.so").exists():
            return directory
    versioned = sorted(path for directory in library_directories for path in directory.glob("libcudart.so.*"))
    if not versioned:
        raise FileNotFoundError(f"no libcudart.so under {toolkit.home}: install the CUDA runtime, or set PGCCD_CUDA=0")
    scratch.mkdir(parents=True, exist_ok=True)
    link = scratch / "libcudart.so"
    link.unlink(missing_ok=True)
    link.symlink_to(versioned[-1])
    return scratch


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
