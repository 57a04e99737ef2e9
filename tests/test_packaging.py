"""What is built and installed: source distribution, wheel, metadata, and errors of an import that cannot succeed."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import torch
from support.forked_job import ForkedJob

from pgccd import _requirements

ROOT = Path(__file__).resolve().parents[1]
backend = pytest.importorskip("build_support.backend", reason="not run from the repository's root")
cuda_toolkit = pytest.importorskip("build_support.cuda_toolkit")
wheel = pytest.importorskip("build_support.wheel")

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
NO_TORCH = "import sys; sys.modules['torch'] = None\n"
TORCH_OF_VERSION = "import sys, types; torch = sys.modules['torch'] = types.ModuleType('torch')\ntorch.__version__ = "
CPU_WITH = "import builtins, io; read = builtins.open\ndef open_(path, *more, **named):\n"
CPU_WITH += "    if path != '/proc/cpuinfo': return read(path, *more, **named)\n"
CPU_WITH += "    return io.StringIO('processor\\t: 0\\nflags\\t\\t: ' + FLAGS + '\\nbugs\\t\\t:\\n')\n"
CPU_WITH += "builtins.open = open_; FLAGS = "


def run(program: str, folder: Path = ROOT, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(folder)} | variables
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


def import_error(before: str, folder: Path = ROOT) -> str:
    """The last line that Python prints when `import pgccd` fails."""
    done = run(before + "\nimport pgccd", folder)
    assert done.returncode == 1
    return done.stderr.strip().rpartition("\n")[2]


def test_import_without_torch() -> None:
    expected = f"ImportError: pgccd needs torch 2.11 or later, and this Python ({sys.executable}) has none: "
    assert import_error(NO_TORCH) == expected + 'pip install "torch>=2.11"'


@pytest.mark.parametrize("version", ["2.10.1+cu126", "1.13.0", "2.9.0a0+git12"])
def test_import_with_an_old_torch(version: str) -> None:
    expected = f'ImportError: pgccd needs torch 2.11 or later, found torch {version}: pip install "torch>=2.11"'
    assert import_error(f"{TORCH_OF_VERSION}{version!r}") == expected


def test_faults_of_torch_are_its_own(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("import a_part_of_torch")
    shutil.copytree(ROOT / "pgccd", tmp_path / "pgccd", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    assert import_error("", tmp_path) == "ModuleNotFoundError: No module named 'a_part_of_torch'"


@pytest.mark.skipif(_requirements.platform.machine() != "x86_64", reason="flags of x86-64")
def test_import_on_an_old_cpu() -> None:
    flags = "fpu sse4_2 avx f16c xsave movbe abm bmi1 bmi2"
    expected = "ImportError: pgccd needs a CPU with AVX2 and FMA (x86-64-v3: Intel Haswell, AMD Excavator or later); "
    assert import_error(f"{CPU_WITH}{flags!r}") == expected + "this one has no avx2, fma"
    # Nothing compiled, which might not run there, has been loaded.
    program = f"{CPU_WITH}{flags!r}\ntry:\n    import pgccd\nexcept ImportError:\n    import sys\n"
    loaded = run(program + "    print(sorted({'torch', 'numpy', 'pgccd._C'} & set(sys.modules)))")
    assert loaded.stdout.strip() == "[]", loaded.stderr
    # A CPU that has them all, and a system that does not tell, get further.
    enough = " ".join(_requirements.CPU_FLAGS)
    for cpu in (f"{CPU_WITH}{enough!r}", CPU_WITH.replace("return io.StringIO", "raise OSError") + "''"):
        assert "this Python" in import_error(cpu + "\n" + NO_TORCH)


def test_import_of_what_is_not_compiled(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "pgccd", tmp_path / "pgccd", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    text = import_error(f"{TORCH_OF_VERSION}'2.11.0a0+git12'", tmp_path)
    assert text.startswith(f"ImportError: pgccd in {tmp_path}/pgccd is not compiled: run ")
    assert "`make build`" in text and "run Python in another folder" in text


class FailingOperators(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """In place of the compiled operators: they do not load."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.machinery.ModuleSpec(name, self) if name == "pgccd._C" else None

    def exec_module(self, module: Any) -> None:
        raise ImportError("undefined symbol: aoti_torch")


def import_without_operators() -> None:
    """Beside torch, which this process has imported."""
    for name in [name for name in sys.modules if name.split(".")[0] == "pgccd"]:
        del sys.modules[name]
    sys.meta_path.insert(0, FailingOperators())
    importlib.import_module("pgccd")


def test_operators_that_do_not_load(tmp_path: Path) -> None:
    with ForkedJob(1, tmp_path, import_without_operators) as job:
        assert job.finish() == [1], job.said
    text = job.said.strip().rpartition("\n")[2]
    beside = f"torch {torch.__version__} (CUDA {torch.version.cuda or 'none'})"
    assert text == f"ImportError: the operators of pgccd do not load beside {beside}: undefined symbol: aoti_torch"


def test_an_old_driver_is_named(tmp_path: Path) -> None:
    """Calls the CUDA runtime beside a false driver library, which claims to be of CUDA 12.8."""
    toolkit = cuda_toolkit.find_cuda_toolkit(torch.version.cuda) if torch.version.cuda else None
    if toolkit is None or toolkit.version < "13":
        pytest.skip("no nvcc of CUDA 13")
    (tmp_path / "driver.c").write_text("""
        #include <string.h>
        int cuInit(unsigned flags) { return 0; }
        int cuDriverGetVersion(int* version) { *version = 12080; return 0; }
        int cuGetProcAddress_v2(const char* name, void** found, int version, unsigned long flags, int* status) {
          *found = 0;
          if (!strcmp(name, "cuInit")) *found = cuInit;
          if (!strcmp(name, "cuDriverGetVersion")) *found = cuDriverGetVersion;
          if (!strcmp(name, "cuGetProcAddress")) *found = cuGetProcAddress_v2;
          return *found ? 0 : 500;
        }""")
    (tmp_path / "program.cu").write_text("""
        #include <cstdio>
        #include "kernels/device.cuh"
        int main() {
          int device = 0;
          try { pgccd::check_cuda(cudaGetDevice(&device), "cudaGetDevice"); }
          catch (const std::exception& error) { std::puts(error.what()); }
        }""")
    libraries = cuda_toolkit.static_runtime_directory(toolkit)
    nvcc = [toolkit.home / "bin" / "nvcc", "-std=c++20", f"-I{ROOT / 'csrc'}", f"-L{libraries}", "-cudart", "static"]
    subprocess.run([*nvcc, "program.cu", "-o", "program"], cwd=tmp_path, check=True)
    subprocess.run(["cc", "-shared", "-fPIC", "-w", "driver.c", "-o", "libcuda.so.1"], cwd=tmp_path, check=True)
    environment = os.environ | {"LD_LIBRARY_PATH": str(tmp_path)}
    printed = subprocess.run([tmp_path / "program"], env=environment, capture_output=True, text=True, check=True).stdout
    assert printed.startswith("cudaGetDevice: CUDA driver version is insufficient for CUDA runtime version: ")
    assert f"pgccd was built with CUDA {toolkit.version}, the driver of the GPU supports CUDA 12.8; install" in printed


def test_the_least_torch_is_the_same_everywhere() -> None:
    least = f"torch>={'.'.join(map(str, _requirements.LEAST_TORCH))}"
    assert least in PROJECT["project"]["dependencies"] and least == backend.TORCH
    major, minor = _requirements.LEAST_TORCH
    assert f"OLDEST_TORCH = ({major}, {minor})" in (ROOT / "bootstrap.py").read_text()
    assert f"0x{major:02x}{minor:02x}000000000000ULL" in (ROOT / "build_support" / "extensions.py").read_text()


def test_torch_is_required_by_what_is_compiled_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(backend.build_meta, "get_requires_for_build_wheel", lambda _: [])
    monkeypatch.setattr(backend.build_meta, "get_requires_for_build_editable", lambda _: [])
    assert backend.get_requires_for_build_wheel() == backend.get_requires_for_build_editable() == [backend.TORCH]
    assert backend.get_requires_for_build_sdist is backend.build_meta.get_requires_for_build_sdist
    assert not any(requirement.startswith("torch") for requirement in PROJECT["build-system"]["requires"])


def test_source_distribution(tmp_path: Path) -> None:
    """It is made without torch, and contains all that builds, tests and explains."""
    left_out = (".git", ".venv", "build", "dist", "out", "__pycache__", "*.so", "*.egg-info", ".*_cache")
    tree = shutil.copytree(ROOT, tmp_path / "tree", ignore=shutil.ignore_patterns(*left_out))
    (tree / "pgccd" / "_C.abi3.so").write_bytes(b"of another machine")
    program = f"{NO_TORCH}from build_support import backend\n"
    program += "print(backend.get_requires_for_build_sdist())\nprint(backend.build_sdist('..'))"
    done = run(program, tree)
    assert done.returncode == 0, done.stderr
    version = PROJECT["project"]["version"]
    with tarfile.open(tmp_path / f"pgccd-{version}.tar.gz") as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    expected = [path for folder in ("build_support", "csrc", "docs", "examples", "pgccd") for path in files_of(folder)]
    expected += ["setup.py", "Makefile", "bootstrap.py", "CHANGELOG.md", "SECURITY.md", "tests/support/truth.py"]
    assert [name for name in expected if name not in names and not name.startswith("docs/tutorials/")] == []
    assert not any(name.endswith((".so", ".pyc")) for name in names)


def files_of(folder: str) -> list[str]:
    found = [path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if path.is_file()]
    return [str(path) for path in found if path.suffix not in (".so", ".pyc")]


def test_all_files_of_the_package_are_installed() -> None:
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["pgccd"]
    others = [name.removeprefix("pgccd/") for name in files_of("pgccd") if not name.endswith(".py")]
    assert "py.typed" in others
    assert [name for name in others if not any(fnmatch(name, pattern) for pattern in patterns)] == []


def test_versions_agree() -> None:
    version = PROJECT["project"]["version"]
    assert re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == version  # type: ignore[index]
    assert re.search(r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == version  # type: ignore[index]


def test_only_formatters_and_the_compiler_are_pinned() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    assert {"docs", "lint", "live", "mesh", "mpi", "peers", "robots", "test", "viz", "wheel"} == set(extras)
    pinned = {name for name, requirements in extras.items() if any("==" in one for one in requirements)}
    assert pinned == {"lint"} and not any("==" in one for one in PROJECT["project"]["dependencies"])
    assert all("==13.0." in one for one in PROJECT["dependency-groups"]["cuda-compiler"])


def test_actions_are_pinned() -> None:
    used = []
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        used += re.findall(r"uses: *(\S+)", path.read_text())
    remote = [name for name in used if not name.startswith("./")]
    assert len(remote) > 4 and [name for name in remote if not re.fullmatch(r"[\w./-]+@v\d+\.\d+\.\d+", name)] == []


def flags_of(command: str, toolkit: str) -> None:
    """Prints those of setup.py."""
    os.environ |= {"CUDA_HOME": toolkit, "PGCCD_CUDA": "1", "TORCH_CUDA_ARCH_LIST": "8.0;9.0+PTX"}
    sys.argv = ["setup.py", command]
    extensions = importlib.import_module("build_support.extensions")
    operators = extensions.operators_module()
    made = [operators.extra_compile_args, operators.extra_link_args, operators.libraries, operators.library_dirs]
    print(json.dumps(made))  # noqa: T201


@pytest.mark.parametrize("command", ["build_ext", "bdist_wheel"])
@pytest.mark.skipif(torch.version.cuda is None, reason="torch has no CUDA")
def test_flags(command: str, tmp_path: Path) -> None:
    """Wheels are stripped and compressed; builds in place have line tables. Both link the CUDA runtime statically."""
    assert torch.version.cuda is not None
    version = f"{torch.version.cuda.partition('.')[0]}.9"
    for name in ("bin", "lib", "include"):
        (tmp_path / name).mkdir()
    (tmp_path / "lib" / "libcudart_static.a").touch()
    (tmp_path / "bin" / "nvcc").write_text(f"#!/bin/sh\necho Cuda compilation tools, release {version}, V{version}\n")
    (tmp_path / "bin" / "nvcc").chmod(0o755)
    with ForkedJob(1, tmp_path / "said", flags_of, command, str(tmp_path)) as job:
        assert job.finish() == [0], job.said
    compiled, linked, libraries, folders = json.loads(job.said)
    assert "cudart_static" in libraries and not {"cudart", "torch_cuda", "c10_cuda"} & set(libraries)
    assert str(tmp_path / "lib") in folders
    for flags in compiled.values():
        text = " ".join(flags)
        assert ("-g0" in text) == (command == "bdist_wheel") != ("-g1" in text) and "-ffp-contract=off" in text
    assert ("-lineinfo" in compiled["nvcc"]) == (command == "build_ext")
    assert ("--compress-mode=size" in compiled["nvcc"]) == (command == "bdist_wheel")
    assert "--fmad=false" in compiled["nvcc"] and "-gencode=arch=compute_90,code=compute_90" in compiled["nvcc"]
    assert ("-Wl,--strip-all" in linked) == (command == "bdist_wheel")


def test_a_toolkit_without_the_static_runtime(tmp_path: Path) -> None:
    toolkit = cuda_toolkit.CudaToolkit(tmp_path, "13.0")
    with pytest.raises(FileNotFoundError, match=f"^no libcudart_static.a under {tmp_path}: install the CUDA runtime"):
        cuda_toolkit.static_runtime_directory(toolkit)
    (tmp_path / "lib64").mkdir()
    (tmp_path / "lib64" / "libcudart_static.a").touch()
    assert cuda_toolkit.static_runtime_directory(toolkit) == tmp_path / "lib64"
    versions = {"12.4": False, "12.8": True, "12.10": True, "13.0": True}
    assert {text: cuda_toolkit.CudaToolkit(tmp_path, text).compresses for text in versions} == versions


@pytest.mark.parametrize("given", [None, "9.0"])
def test_wheels_are_for_all_gpus(given: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And without modules that earlier builds have left."""
    monkeypatch.setattr(wheel, "ROOT", tmp_path)
    monkeypatch.setattr(wheel, "UNREPAIRED", tmp_path / "build" / "wheel")
    monkeypatch.delenv("TORCH_CUDA_ARCH_LIST", raising=False)
    if given:
        monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", given)
    (tmp_path / "build" / "lib.linux-x86_64-cpython-311" / "pgccd").mkdir(parents=True)
    (tmp_path / "build" / "objects").mkdir()
    calls = []

    def build(command: list[str], env: dict[str, str], check: bool) -> None:
        calls.append((command, env["TORCH_CUDA_ARCH_LIST"]))
        (tmp_path / "build" / "wheel").mkdir()
        (tmp_path / "build" / "wheel" / "pgccd-1-cp311-cp311-linux_x86_64.whl").touch()

    monkeypatch.setattr(wheel.subprocess, "run", build)
    assert wheel.build().name == "pgccd-1-cp311-cp311-linux_x86_64.whl"
    ((command, architectures),) = calls
    assert {"--no-index", "--no-deps", "--no-build-isolation"} <= set(command)
    assert architectures == (given or "8.0;8.6;8.9;9.0;10.0;12.0+PTX")
    assert sorted(path.name for path in (tmp_path / "build").iterdir()) == ["objects", "wheel"]


@pytest.mark.slow
def test_wheel_in_a_fresh_environment(tmp_path: Path) -> None:
    """The newest wheel in dist/ finds a contact, and mypy reads its types, in an environment that has nothing but what
    torch's has.
    """
    wheels = sorted((ROOT / "dist").glob("pgccd-*-cp311-abi3-*.whl"), key=lambda path: path.stat().st_mtime)
    if not wheels:
        pytest.skip("no wheel in dist/: make wheel")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    (packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (packages / "torch.pth").write_text(str(Path(torch.__file__).parents[1]))
    python = tmp_path / "venv" / "bin" / "python"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    options = ["--quiet", "--no-index", "--no-deps", "--ignore-installed"]
    subprocess.run([python, "-m", "pip", "install", *options, wheels[-1]], env=environment, check=True)
    program = (ROOT / "tests" / "test_user_code.py").read_text()
    (tmp_path / "program.py").write_text(program + "\n\ntest_contacts()\nprint(pgccd.__file__)\n")
    command = [python, "program.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.startswith(str(packages)), done.stdout + done.stderr
    pytest.importorskip("mypy")
    command = [python, "-m", "mypy", "--cache-dir", str(tmp_path / "cache"), "program.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0 and "Success" in done.stdout, done.stdout
