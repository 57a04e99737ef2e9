"""Prepares .venv to build, run and test pgccd: `make demo` and `make test` run it once. Standard library only.

With a network it installs torch, the packages named in pyproject.toml and, where there is a GPU, a CUDA compiler. If
the Python that runs it already has torch, that torch is used and never replaced. Without a network, missing packages
are skipped. An existing .venv is kept.

Environment: PGCCD_CUDA=auto|0|1 as in setup.py. auto, the default, installs a CUDA compiler only where torch sees a GPU
and no nvcc is found; 1 installs it wherever none is found, and fails without.
"""

import sys

if sys.version_info < (3, 11):  # noqa: UP036 (said before an import fails)
    raise SystemExit(f"pgccd needs Python 3.11 or later; {sys.executable} is {sys.version.split()[0]}: set PYTHON=...")

import functools
import json
import os
import subprocess
import time
import tomllib
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
LOG = ROOT / "build" / "bootstrap.log"
CONSTRAINTS = VENV / "constraints.txt"

TORCH = "torch==2.13.0"  # built for CUDA 13.0
OLDEST_TORCH = (2, 11)  # minimum of the stable ABI that the extension is compiled for
CUDA_COMPILER_WHEELS = {  # by the major version of torch's CUDA
    "13": [
        "nvidia-cuda-nvcc==13.0.88",
        "nvidia-nvvm==13.0.88",
        "nvidia-cuda-crt==13.0.88",
        "nvidia-cuda-cccl==13.0.85",
        "nvidia-cuda-runtime==13.0.96",
    ]
}
PIP_INSTALL = [VENV_PYTHON, "-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--progress-bar=off"]
PIP_INSTALL += ["--no-compile"]  # most modules are never imported; Python compiles the rest on import
HEARTBEAT_SECONDS = 15

PRINT_TORCH = """
import json, torch
print(json.dumps({"version": str(torch.__version__), "cuda": torch.version.cuda, "gpus": torch.cuda.device_count()}))
"""
PRINT_SITE_DIRECTORIES = """
import json, sys
print(json.dumps([entry for entry in sys.path if entry.endswith(("site-packages", "dist-packages"))]))
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
    try:
        return requirement.specifier.contains(importlib.metadata.version(requirement.name), prereleases=True)
    except importlib.metadata.PackageNotFoundError:
        return False
print(json.dumps([text for text in sys.argv[1:] if not is_met(text)]))
"""


def main() -> None:
    started = time.monotonic()
    os.chdir(ROOT)
    os.environ["PATH"] = os.pathsep.join([str(VENV_PYTHON.parent), os.environ.get("PATH", "")])
    LOG.parent.mkdir(exist_ok=True)
    LOG.write_text("")
    create_environment()
    setting = os.environ.get("PGCCD_CUDA", "auto")
    if setting not in ("auto", "0", "1"):
        raise SystemExit(f"PGCCD_CUDA={setting}: expected auto, 0 or 1")
    torch = install_torch()
    install_packages()
    if torch["cuda"] is not None and setting != "0":
        install_cuda_compiler(torch["cuda"], has_gpu=torch["gpus"] > 0, is_forced=setting == "1")
    install_project()
    cache_bytecode()
    say(f"ready after {time.monotonic() - started:.0f} s")


def cache_bytecode() -> None:
    """Imports common modules once to cache their bytecode. With PYTHONDONTWRITEBYTECODE, importing torch would take
    twice as long in each of the many rank and test processes.
    """
    if sys.dont_write_bytecode:
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        modules = "import torch.distributed.run, torch.distributed.checkpoint"
        subprocess.run([VENV_PYTHON, "-c", modules], env=environment, check=False)


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


def install_torch() -> dict:
    torch = find_torch(VENV_PYTHON)
    if torch is None:
        run(f"installing {TORCH} (a large download)", [*PIP_INSTALL, "--timeout=30", TORCH])
        torch = find_torch(VENV_PYTHON)
    if torch is None:
        raise SystemExit(f"torch was installed but cannot be imported; see {LOG}")
    say(f"torch {torch['version']}, CUDA {torch['cuda'] or 'none'}")
    CONSTRAINTS.write_text(f"torch=={torch['version']}\n")
    return torch


def install_packages() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [
        *project["build-system"]["requires"],
        *project["project"]["dependencies"],
        *(requirement for extra in project["project"]["optional-dependencies"].values() for requirement in extra),
    ]
    missing = install_what_is_missing("packages", wanted)
    if missing:
        say(f"continuing without {', '.join(missing)}")


def install_cuda_compiler(torch_cuda: str, has_gpu: bool, is_forced: bool) -> None:
    home = ask(VENV_PYTHON, PRINT_CUDA_TOOLKIT, torch_cuda)
    wheels = CUDA_COMPILER_WHEELS.get(torch_cuda.split(".")[0])
    if home is None and not has_gpu and not is_forced:
        say("no GPU and no nvcc: building for CPUs only (PGCCD_CUDA=1 builds for GPUs too)")
        return
    if home is None and wheels and index_is_reachable():
        # Reinstall all of them, even those that torch brought along: nvcc finds the others only in its own folder.
        everything = ["--ignore-installed", "--no-deps", *wheels]
        run("installing the CUDA compiler", [*PIP_INSTALL, "--timeout=10", *everything], must_succeed=False)
        home = ask(VENV_PYTHON, PRINT_CUDA_TOOLKIT, torch_cuda)
    say(f"CUDA compiler in {home}" if home else f"no CUDA {torch_cuda} compiler: building for CPUs only")


def install_project() -> None:
    # compat: a path in a .pth file. Type checkers and editors cannot resolve the import hooks of the other modes.
    options = ["--verbose", "--no-index", "--no-build-isolation", "--no-deps", "--config-settings=editable_mode=compat"]
    run("compiling and installing pgccd", [*PIP_INSTALL, *options, "--editable", "."])


def install_what_is_missing(what: str, requirements: Sequence[str]) -> list[str]:
    """Installs unmet requirements; returns those that could not be installed."""
    missing = ask(VENV_PYTHON, PRINT_UNMET, *requirements)
    if not missing or not index_is_reachable():
        return missing
    install = [*PIP_INSTALL, "--timeout=10", "--retries=2", "--constraint", CONSTRAINTS]
    if not run(f"installing {what}", [*install, *missing], must_succeed=False):
        for requirement in missing:  # a requirement unavailable on this platform must not block the others
            run(f"installing {requirement}", [*install, requirement], must_succeed=False)
    return ask(VENV_PYTHON, PRINT_UNMET, *requirements)


@functools.cache
def index_is_reachable() -> bool:
    # pip instead of a socket, because it uses configured mirrors and proxies.
    probe = ["--dry-run", "--ignore-installed", "--no-deps", "--timeout=5", "--retries=0", "wheel"]
    return run("looking for the package index", [*PIP_INSTALL, *probe], must_succeed=False)


def find_torch(python: Path | str) -> dict | None:
    """Version, CUDA version and GPUs of the torch that `python` imports; None if it is missing or too old."""
    torch = ask(python, PRINT_TORCH)
    if torch and tuple(int(number) for number in torch["version"].split(".")[:2]) < OLDEST_TORCH:
        return None
    return torch


def ask(python: Path | str, program: str, *arguments: str):
    """JSON output of `program` run by `python`; None if it fails."""
    answer = subprocess.run([python, "-c", program, *arguments], capture_output=True, text=True)
    return json.loads(answer.stdout) if answer.returncode == 0 else None


def run(what: str, command: Sequence[str | Path], must_succeed: bool = True) -> bool:
    """Runs a command with its output in the log; the terminal gets one line, and a heartbeat."""
    say(what)
    started = next_sign = time.monotonic()
    with LOG.open("a") as log:
        print("$", *command, file=log, flush=True)
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        while process.poll() is None:
            next_sign += HEARTBEAT_SECONDS
            try:
                process.wait(timeout=max(next_sign - time.monotonic(), 0))
            except subprocess.TimeoutExpired:
                last_line = LOG.read_text(errors="replace").rstrip().rpartition("\n")[2]
                say(f"  {time.monotonic() - started:.0f} s: {last_line[:90]}")
    if process.returncode and must_succeed:
        print(*LOG.read_text(errors="replace").splitlines()[-60:], sep="\n")
        raise SystemExit(f"bootstrap: {what} failed; the whole log is {LOG}")
    return process.returncode == 0


def say(message: str) -> None:
    print(f"bootstrap: {message}", flush=True)


if __name__ == "__main__":
    main()
