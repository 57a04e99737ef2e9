"""The extension module, and how it is compiled. Needs torch and a C++20 compiler.

`pgccd._C` holds the operators, on the stable ABIs of torch and Python: one binary serves torch 2.11 and later, and
Python 3.11 and later.

Environment: PGCCD_CUDA=auto|0|1 (build the CUDA kernels if possible, never, or fail without them), CUDA_HOME,
TORCH_CUDA_ARCH_LIST, CXX, MAX_JOBS (parallel compilers), NVCC_APPEND_FLAGS.
"""

import fcntl
import hashlib
import logging
import os
import platform
import subprocess
import sys
import tomllib
from glob import glob
from pathlib import Path

from setuptools import Extension

from build_support.cuda_toolkit import CudaToolkit, architecture_flags, find_cuda_toolkit, static_runtime_directory

try:
    import torch
except ImportError as error:
    raise SystemExit(
        "pgccd is built against torch, and this Python has none.\n"
        "Run `make build`, or install torch and then: pip install --no-build-isolation --no-deps -e ."
    ) from error

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build"
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # for the venv's ninja


def choose_cuda_toolkit() -> CudaToolkit | None:
    """The toolkit to build with, or None for a build without CUDA kernels."""
    wish = os.environ.get("PGCCD_CUDA", "auto")
    if wish not in ("auto", "0", "1"):
        raise SystemExit(f"PGCCD_CUDA={wish}: expected auto, 0 or 1")
    toolkit = find_cuda_toolkit(torch.version.cuda) if torch.version.cuda and wish != "0" else None
    if wish == "1" and toolkit is None:
        raise SystemExit(f"PGCCD_CUDA=1, but no nvcc fits torch {torch.__version__} (its CUDA: {torch.version.cuda})")
    return toolkit


def choose_cuda_architectures() -> str:
    """TORCH_CUDA_ARCH_LIST if set, otherwise the GPUs present or Hopper, with PTX for newer GPUs."""
    if wish := os.environ.get("TORCH_CUDA_ARCH_LIST"):
        return wish
    capabilities = {torch.cuda.get_device_capability(index) for index in range(torch.cuda.device_count())}
    return ";".join(f"{major}.{minor}" for major, minor in sorted(capabilities or {(9, 0)})) + "+PTX"


def describe_commit() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True) if (ROOT / ".git").exists() else None
    return answer.stdout.strip() if answer and answer.returncode == 0 else "unknown"


def digest_sources() -> str:
    """Of the C++ and CUDA sources, by which ranks compare what they run: binaries differ from build to build."""
    digest = hashlib.sha256()
    for path in sorted(Path("csrc").rglob("*")):
        if path.suffix in (".h", ".cpp", ".cu", ".cuh"):
            digest.update(f"{path.as_posix()}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


TORCH_INCLUDE = str(Path(torch.__file__).parent / "include")
toolkit = choose_cuda_toolkit()
architectures = choose_cuda_architectures() if toolkit else ""
if toolkit:
    # cpp_extension reads both on import or later: set them first.
    os.environ["CUDA_HOME"] = str(toolkit.home)
    os.environ["TORCH_CUDA_ARCH_LIST"] = architectures

# Silences its warning that there is no GPU: none is needed to compile.
logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
from torch.utils.cpp_extension import BuildExtension, CppExtension  # noqa: E402

# Wheels are small; builds in place have line tables for profilers.
IS_WHEEL = "bdist_wheel" in sys.argv

# No contraction and no fast-math, on either compiler: CPU and CUDA must give the same bits.
# x86-64-v3 makes fma() one instruction; ARMv8 has it anyway.
# errno and floating-point traps are unused; without them square roots and comparisons vectorise.
HOST_FLAGS = [
    "-O3",
    "-ffp-contract=off",
    "-fno-fast-math",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-g0" if IS_WHEEL else "-g1",
]
if platform.machine() == "x86_64":
    HOST_FLAGS.append("-march=x86-64-v3")
# -isystem: no warnings about third-party headers.
CXX_FLAGS = ["-std=c++20", *HOST_FLAGS, "-isystem", TORCH_INCLUDE]
NVCC_FLAGS = ["-std=c++20", "-O3", "--fmad=false", "--expt-relaxed-constexpr", "--extended-lambda"]
NVCC_FLAGS += ["-Xcompiler=" + ",".join(HOST_FLAGS), "-isystem", TORCH_INCLUDE]
if toolkit:
    targets = architecture_flags(architectures)
    NVCC_FLAGS += [*targets, f"--threads={min(len(targets), os.cpu_count() or 1)}"]
    if not IS_WHEEL:
        NVCC_FLAGS.append("-lineinfo")
    elif toolkit.compresses:
        NVCC_FLAGS.append("--compress-mode=size")
LINK_FLAGS = ["-Wl,--strip-all"] if IS_WHEEL else []

TORCH_MACROS = [("TORCH_TARGET_VERSION", "0x020b000000000000ULL")]  # the stable ABI as of torch 2.11
CUDA_MACROS = [("USE_CUDA", None), ("PGCCD_WITH_CUDA", None)]
# The CUDA runtime is linked statically: the library then loads beside a torch of any CUDA version, or of none. libtorch
# brings torch's CUDA library where there is one; cuda_session.h declares its one function that is called as weak.
CUDA_LIBRARIES = ["cudart_static", "rt", "dl", "pthread"]
CUDA_LINK_FLAGS = ["-Wl,--push-state,--no-as-needed", "-ltorch", "-Wl,--pop-state"]

#: build_facts.h, written before compilers start.
FACTS = BUILD / "facts"


def operators_module() -> Extension:
    sources = glob("csrc/kernels/**/*.cpp", recursive=True)
    for folder in ("bind", "library", "mesh"):
        sources += glob(f"csrc/{folder}/*.cpp")
    options = {
        "include_dirs": [str(ROOT / "csrc"), str(FACTS)],
        "define_macros": TORCH_MACROS,
        "extra_compile_args": {"cxx": CXX_FLAGS, "nvcc": NVCC_FLAGS},
        "depends": glob("csrc/**/*.h", recursive=True),
        # Symbols of libraries that are linked statically, such as a compiler's own C++ library, must not mix with those
        # of torch's copies: formatting an error message would crash.
        "extra_link_args": ["-Wl,--exclude-libs,ALL", *LINK_FLAGS],
        "py_limited_api": True,
    }
    if toolkit:
        sources += glob("csrc/kernels/**/*.cu", recursive=True) + glob("csrc/bind/*.cu")
        options["define_macros"] = TORCH_MACROS + CUDA_MACROS
        options["include_dirs"] += [str(toolkit.home / "include")]
        options["libraries"] = CUDA_LIBRARIES
        options["library_dirs"] = [str(static_runtime_directory(toolkit))]
        options["extra_link_args"] += CUDA_LINK_FLAGS
    return CppExtension("pgccd._C", sorted(sources), **options)


def write_facts() -> None:
    """A header with a macro for each fact about this build; only one source includes it."""
    facts = {
        "VERSION": tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"],
        "COMMIT": describe_commit(),
        "SOURCES": digest_sources(),
        "CUDA": toolkit.version if toolkit else "",
        "CUDA_ARCHITECTURES": architectures,
    }
    FACTS.mkdir(exist_ok=True)
    text = "".join(f'#define PGCCD_{name} "{value}"\n' for name, value in facts.items())
    header = FACTS / "build_facts.h"
    if not header.exists() or header.read_text() != text:
        header.write_text(text)


class BuildIncrementally(BuildExtension):
    """torch's ninja build, with the object files kept between builds (pip would use a fresh folder each time)."""

    def run(self) -> None:
        BUILD.mkdir(exist_ok=True)
        with open(BUILD / "lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # parallel builds would overwrite each other's files
            write_facts()
            super().run()

    def build_extension(self, extension: Extension) -> None:
        # Wheels have flags, and so objects, of their own.
        self.build_temp = str(BUILD / ("wheel-objects" if IS_WHEEL else "objects"))
        super().build_extension(extension)
