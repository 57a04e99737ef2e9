"""Builds the two extension modules; everything else is in pyproject.toml.

`pgccd._C`     the operators, on torch's stable ABI: one binary serves torch 2.11 and later, and every Python 3.11+.
`pgccd._host`  host-side work on numpy arrays and the build information, by pybind11, without torch headers.

Environment: PGCCD_CUDA=auto|0|1 (build the CUDA kernels if possible, never, or fail without them), CUDA_HOME,
TORCH_CUDA_ARCH_LIST, CXX, MAX_JOBS (parallel compilers), NVCC_APPEND_FLAGS.
"""

import fcntl
import logging
import os
import platform
import shlex
import subprocess
import sys
import tomllib
from glob import glob
from pathlib import Path

from setuptools import Extension, setup

ROOT = Path(__file__).resolve().parent
BUILD = ROOT / "build"
sys.path.insert(0, str(ROOT))  # a PEP 517 build does not add the project's folder to the path
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # for the venv's ninja

from build_support.cuda_toolkit import (  # noqa: E402
    CudaToolkit,
    architecture_flags,
    cudart_link_directory,
    find_cuda_toolkit,
)

try:
    import torch
except ImportError as error:
    raise SystemExit(
        "pgccd is built against the torch you run it with, and this Python has none.\n"
        "Run `make build`, or install torch and then: pip install --no-build-isolation --no-deps -e ."
    ) from error


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


def describe_compiler() -> str:
    answer = subprocess.run(
        [*shlex.split(os.environ.get("CXX", "c++")), "--version"], stdout=subprocess.PIPE, text=True, check=True
    )
    return answer.stdout.splitlines()[0]


def pybind11_include() -> str:
    """The header folder of the pybind11 package or, if that is missing, of the copy inside torch."""
    try:
        import pybind11
    except ImportError:
        return TORCH_INCLUDE
    return pybind11.get_include()


TORCH_INCLUDE = str(Path(torch.__file__).parent / "include")
toolkit = choose_cuda_toolkit()
architectures = choose_cuda_architectures() if toolkit else ""
if toolkit:
    # cpp_extension reads both on import or later: set them first.
    os.environ["CUDA_HOME"] = str(toolkit.home)
    os.environ["TORCH_CUDA_ARCH_LIST"] = architectures

# Silences its warning that there is no GPU: none is needed to compile.
logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
from torch.utils.cpp_extension import BuildExtension, CppExtension, CUDAExtension  # noqa: E402

# No contraction and no fast-math, on either compiler: CPU and CUDA must give the same bits.
# x86-64-v3 makes fma() one instruction; ARMv8 has it anyway.
# -g1, -lineinfo: line tables for profilers.
# errno and floating-point traps are unused; without them square roots and comparisons vectorise.
HOST_FLAGS = [
    "-O3",
    "-g1",
    "-ffp-contract=off",
    "-fno-fast-math",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
]
if platform.machine() == "x86_64":
    HOST_FLAGS.append("-march=x86-64-v3")
# -isystem: no warnings about third-party headers.
CXX_FLAGS = ["-std=c++20", *HOST_FLAGS, "-isystem", TORCH_INCLUDE]
NVCC_FLAGS = ["-std=c++20", "-O3", "-lineinfo", "--fmad=false", "--expt-relaxed-constexpr", "--extended-lambda"]
NVCC_FLAGS += architecture_flags(architectures) if toolkit else []
NVCC_FLAGS += ["-Xcompiler=" + ",".join(HOST_FLAGS), "-isystem", TORCH_INCLUDE]

TORCH_MACROS = [("TORCH_TARGET_VERSION", "0x020b000000000000ULL")]  # the stable ABI as of torch 2.11
CUDA_MACROS = [("USE_CUDA", None), ("PGCCD_WITH_CUDA", None)]

HOST_MODULE_SOURCE = "csrc/bind/host_module.cpp"


def operators_module() -> Extension:
    sources = glob("csrc/kernels/**/*.cpp", recursive=True) + glob("csrc/bind/*.cpp")
    sources = [source for source in sources if source != HOST_MODULE_SOURCE]
    options = {
        "include_dirs": [str(ROOT / "csrc")],
        "define_macros": TORCH_MACROS,
        "extra_compile_args": {"cxx": CXX_FLAGS, "nvcc": NVCC_FLAGS},
        "depends": glob("csrc/**/*.h", recursive=True),
        # If the compiler links its C++ library statically, the symbols of that copy must not mix with torch's:
        # formatting an error message would crash.
        "extra_link_args": ["-Wl,--exclude-libs,ALL"],
        "py_limited_api": True,
    }
    if toolkit is None:
        return CppExtension("pgccd._C", sorted(sources), **options)
    sources += glob("csrc/kernels/**/*.cu", recursive=True) + glob("csrc/bind/*.cu")
    options["define_macros"] = TORCH_MACROS + CUDA_MACROS
    options["library_dirs"] = [str(cudart_link_directory(toolkit, BUILD / "cuda-link"))]
    return CUDAExtension("pgccd._C", sorted(sources), **options)


def host_module() -> Extension:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    build_information = {
        "PGCCD_VERSION": version,
        "PGCCD_BUILD_COMMIT": describe_commit(),
        "PGCCD_BUILD_COMPILER": describe_compiler(),
        "PGCCD_BUILD_TORCH": torch.__version__,
        "PGCCD_BUILD_CUDA": toolkit.version if toolkit else "",
        "PGCCD_BUILD_CUDA_ARCHITECTURES": architectures,
    }
    return Extension(
        "pgccd._host",
        [HOST_MODULE_SOURCE, *sorted(glob("csrc/mesh/*.cpp"))],
        include_dirs=[str(ROOT / "csrc")],
        define_macros=[(name, f'"{value}"') for name, value in build_information.items()],
        extra_compile_args={"cxx": ["-isystem", pybind11_include(), *CXX_FLAGS]},
        depends=glob("csrc/**/*.h", recursive=True),
        language="c++",
    )


class BuildIncrementally(BuildExtension):
    """torch's ninja build, with the object files kept between builds (pip would use a fresh folder each time)."""

    def run(self) -> None:
        BUILD.mkdir(exist_ok=True)
        with open(BUILD / "lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # parallel builds would overwrite each other's files
            super().run()

    def build_extension(self, extension: Extension) -> None:
        # One folder per module: each has its own build.ninja.
        self.build_temp = str(BUILD / "objects" / sys.implementation.cache_tag / extension.name)
        super().build_extension(extension)


setup(
    ext_modules=[operators_module(), host_module()],
    cmdclass={"build_ext": BuildIncrementally},
)
