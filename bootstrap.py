"""Prepares .venv to build and run pgccd, and for what make is asked to do. Standard library only.

    python3 bootstrap.py [PURPOSE ...]    purposes: test, docs, lint, wheel, bench-peers

With a network it installs torch, what building, pgccd itself and the pictures of `make demo` need, where there is a GPU
a CUDA compiler, and for each purpose its packages of pyproject.toml. If the Python that runs it already has torch, that
torch is used and never replaced. Without a network, missing packages are skipped. An existing .venv is kept, and pgccd
is compiled unless it has been. For each purpose of which no package is missing it leaves .venv/pgccd-for-PURPOSE.

Environment: PGCCD_CUDA=auto|0|1 as in build_support/extensions.py. auto, the default, installs a CUDA compiler only
where torch sees a GPU and no nvcc is found; 1 installs it wherever none is found, and fails without.
"""

import sys

if sys.version_info < (3, 11):  # noqa: UP036 (said before an import fails)
    raise SystemExit(f"pgccd needs Python 3.11 or later; {sys.executable} is {sys.version.split()[0]}: set PYTHON=...")

import concurrent.futures
import fcntl
import functools
import json
import os
import subprocess
import tomllib
import venv
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
EXTENSION = ROOT / "build" / "pgccd-extension"  # make's stamp
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
# Without torch, which must fit what is there.
REQUIREMENTS = [*PROJECT["build-system"]["requires"], *PROJECT["project"]["dependencies"]]
REQUIREMENTS = [requirement for requirement in REQUIREMENTS if not requirement.startswith("torch>")]
EXTRAS = PROJECT["project"]["optional-dependencies"]
# Extras by purpose; those of `make demo` are always installed.
DEMO = ["viz"]
PURPOSES = {
    "test": ["mesh", "viz", "live", "robots", "mpi", "test"],
    "docs": ["docs"],
    "lint": ["lint", "live"],
    "wheel": ["wheel"],
    "bench-peers": ["peers", "mesh", "viz"],
}

TORCH = "torch==2.13.0"  # built for CUDA 13.0, as the compiler in pyproject.toml
OLDEST_TORCH = (2, 11)
PIP_INSTALL = [VENV_PYTHON, "-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--progress-bar=off"]
PIP_INSTALL += ["--no-compile"]  # most modules are never imported; Python compiles the rest on import

PRINT_TORCH = """
import json, torch
print(json.dumps({"version": str(torch.__version__), "cuda": torch.version.cuda, "gpus": torch.cuda.device_count()}))
"""
PRINT_SITE_DIRECTORIES = """
import json, sys
print(json.dumps([entry for entry in sys.path if entry.endswith(("site-packages", "dist-packages"))]))
"""
PRINT_FILE_OF_PACKAGE = """
import importlib.util, json, os
os.chdir("/")
found = importlib.util.find_spec("pgccd")
print(json.dumps(found and found.origin))
"""
PRINT_CUDA_TOOLKIT = """
import json, sys
from build_support.cuda_toolkit import find_cuda_toolkit
toolkit = find_cuda_toolkit(sys.argv[1])
print(json.dumps(toolkit and str(toolkit.home)))
"""
PRINT_UNMET = """
import importlib.metadata, json, sys
from pip._vendor.packaging.requirements import Requirement
def is_met(text):
    requirement = Requirement(text)
    if requirement.marker and not requirement.marker.evaluate():
        return True  # not for this Python
    try:
        return requirement.specifier.contains(importlib.metadata.version(requirement.name), prereleases=True)
    except importlib.metadata.PackageNotFoundError:
        return False
print(json.dumps([text for text in sys.argv[1:] if not is_met(text)]))
"""


def main(purposes: list[str]) -> None:
    os.chdir(ROOT)
    setting = os.environ.get("PGCCD_CUDA", "auto")
    if setting not in ("auto", "0", "1"):
        raise SystemExit(f"PGCCD_CUDA={setting}: expected auto, 0 or 1")
    if unknown := sorted(set(purposes) - set(PURPOSES)):
        raise SystemExit(f"bootstrap: expected purposes among {', '.join(PURPOSES)}, got {', '.join(unknown)}")
    Path("build").mkdir(exist_ok=True)
    with open("build/bootstrap.lock", "w") as lock:  # make may ask for several purposes at a time
        fcntl.flock(lock, fcntl.LOCK_EX)
        prepare(setting, purposes)


def prepare(setting: str, purposes: list[str]) -> None:
    create_environment()
    torch = install_torch()
    install_packages(torch["version"], REQUIREMENTS)
    if torch["cuda"] is not None and setting != "0":
        install_cuda_compiler(torch["cuda"], has_gpu=torch["gpus"] > 0, is_forced=setting == "1")
    extras = [requirement for extra in packages_of(purposes) for requirement in EXTRAS[extra]]
    # compat: a path in a .pth file. Type checkers and editors cannot resolve the import hooks of the other modes.
    options = ["--no-index", "--no-build-isolation", "--no-deps", "--config-settings=editable_mode=compat"]
    # Other packages are downloaded while compilers run.
    with concurrent.futures.ThreadPoolExecutor() as beside:
        others = beside.submit(install_packages, torch["version"], extras)
        if not is_installed():
            if not install("pgccd, compiled in place", *options, "--editable", "."):
                raise SystemExit("bootstrap: pgccd could not be compiled")
            EXTENSION.touch()
        others.result()
    for purpose in purposes:
        if not missing_of([requirement for extra in PURPOSES[purpose] for requirement in EXTRAS[extra]]):
            (VENV / f"pgccd-for-{purpose}").touch()


def packages_of(purposes: list[str]) -> list[str]:
    """The extras to install."""
    return [*DEMO, *(extra for purpose in purposes for extra in PURPOSES[purpose])]


def is_installed() -> bool:
    """Whether pgccd has been compiled and installed in place: make compiles it again where that is needed."""
    return ask(VENV_PYTHON, PRINT_FILE_OF_PACKAGE) == str(ROOT / "pgccd" / "__init__.py") and bool(
        list((ROOT / "pgccd").glob("_C*.so"))
    )


def create_environment() -> None:
    parent = find_torch(sys.executable)
    if VENV_PYTHON.exists() and ask(VENV_PYTHON, "print(1)") and (parent is None or find_torch(VENV_PYTHON)):
        say("using the environment in .venv")
        return
    say(f"making .venv, {'on top of the torch of' if parent else 'with'} {sys.executable}")
    try:
        venv.create(VENV, clear=True, symlinks=True, with_pip=True)
    except subprocess.CalledProcessError as error:
        raise SystemExit(
            f"{sys.executable} cannot make a virtual environment; on Debian and Ubuntu: apt install python3-venv"
        ) from error
    if parent:
        # ensurepip's old setuptools would hide the parent's.
        subprocess.run([VENV_PYTHON, "-m", "pip", "uninstall", "--quiet", "--yes", "setuptools"], check=True)
        # system_site_packages does not suffice: a venv made from a venv does not see that venv's packages.
        packages = next((VENV / "lib").glob("python*/site-packages"))
        lines = [f"import site; site.addsitedir({entry!r})\n" for entry in ask(sys.executable, PRINT_SITE_DIRECTORIES)]
        (packages / "parent-environment.pth").write_text("".join(lines))


def install_torch() -> dict[str, Any]:
    torch = find_torch(VENV_PYTHON) or (install(TORCH, "--timeout=30", TORCH) and find_torch(VENV_PYTHON))
    if not torch:
        raise SystemExit(f"bootstrap: {TORCH} could not be installed")
    say(f"torch {torch['version']}, CUDA {torch['cuda'] or 'none'}")
    return torch


def install_packages(torch_version: str, wanted: list[str]) -> None:
    """Installs those wanted that are missing, as far as they can be had; never another torch."""
    missing = missing_of(wanted)
    if missing and index_is_reachable():
        constraints = VENV / "constraints.txt"
        constraints.write_text(f"torch=={torch_version}\n")
        options = ["--timeout=10", "--retries=2", "--constraint", str(constraints)]
        if not install("packages", *options, *missing):
            for requirement in missing:  # a requirement unavailable on this platform must not block the others
                install(requirement, *options, requirement)
        missing = missing_of(wanted)
    if missing:
        say(f"continuing without {', '.join(missing)}")


def missing_of(wanted: list[str]) -> list[str]:
    """The requirements that .venv does not meet."""
    return list(ask(VENV_PYTHON, PRINT_UNMET, *wanted))


def install_cuda_compiler(torch_cuda: str, has_gpu: bool, is_forced: bool) -> None:
    home = ask(VENV_PYTHON, PRINT_CUDA_TOOLKIT, torch_cuda)
    if home is None and not has_gpu and not is_forced:
        say("no GPU and no nvcc: building for CPUs only (PGCCD_CUDA=1 builds for GPUs too)")
        return
    if home is None and torch_cuda.startswith("13.") and index_is_reachable():
        # Reinstall all of them, even those that torch brought along: nvcc finds the others only in its own folder.
        wheels = PROJECT["dependency-groups"]["cuda-compiler"]
        install("the CUDA compiler", "--timeout=10", "--ignore-installed", "--no-deps", *wheels)
        home = ask(VENV_PYTHON, PRINT_CUDA_TOOLKIT, torch_cuda)
    say(f"CUDA compiler in {home}" if home else f"no CUDA {torch_cuda} compiler: building for CPUs only")


@functools.cache
def index_is_reachable() -> bool:
    # pip instead of a socket, because it uses configured mirrors and proxies.
    probe = ["-qqq", "--dry-run", "--ignore-installed", "--no-deps", "--timeout=5", "--retries=0", "wheel"]
    is_reachable = subprocess.run([*PIP_INSTALL, *probe], stdin=subprocess.DEVNULL).returncode == 0
    say(f"the package index is {'' if is_reachable else 'not '}reachable")
    return is_reachable


def find_torch(python: Path | str) -> dict[str, Any] | None:
    """Version, CUDA version and GPUs of the torch that `python` imports; None if it is missing or too old."""
    torch = ask(python, PRINT_TORCH)
    if torch and tuple(int(number) for number in torch["version"].split(".")[:2]) < OLDEST_TORCH:
        return None
    return torch


def ask(python: Path | str, program: str, *arguments: str) -> Any:
    """JSON output of `program` run by `python`; None if it fails."""
    answer = subprocess.run([python, "-c", program, *arguments], capture_output=True, text=True)
    return json.loads(answer.stdout) if answer.returncode == 0 else None


def install(what: str, *arguments: str) -> bool:
    """Runs pip, with its output in the terminal; returns whether it succeeded."""
    say(f"installing {what}")
    return subprocess.run([*PIP_INSTALL, *arguments], stdin=subprocess.DEVNULL).returncode == 0


def say(message: str) -> None:
    print(f"bootstrap: {message}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
