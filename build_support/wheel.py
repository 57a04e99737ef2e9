"""Builds a wheel for Python 3.11 and later into dist/, without network: python -m build_support.wheel

The kernels are compiled for the GPUs in ARCHITECTURES, unless TORCH_CUDA_ARCH_LIST names others; the other variables
are those of extensions.py. The tag of the wheel names the oldest C library that it runs on, as auditwheel finds it.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
UNREPAIRED = ROOT / "build" / "wheel"
#: Ampere, Ada, Hopper, Blackwell; PTX for later ones.
ARCHITECTURES = "8.0;8.6;8.9;9.0;10.0;12.0+PTX"
#: Libraries of torch, which the wheel does not contain.
PROVIDED = ["libc10.so", "libtorch.so", "libtorch_cpu.so"]


def main() -> None:
    wheel = repair(build())
    print(f"{wheel.relative_to(ROOT)}: {wheel.stat().st_size / 1e6:.1f} MB")
    for entry in zipfile.ZipFile(wheel).infolist():
        if entry.filename.endswith(".so"):
            print(f"    {entry.filename}: {entry.file_size / 1e6:.1f} MB")


def build() -> Path:
    # setuptools would add what earlier builds left there, such as modules that are gone.
    for leftover in [*ROOT.glob("build/lib*"), *ROOT.glob("build/bdist*"), UNREPAIRED]:
        shutil.rmtree(leftover, ignore_errors=True)
    environment = {"TORCH_CUDA_ARCH_LIST": ARCHITECTURES} | os.environ
    options = ["--no-build-isolation", "--no-deps", "--no-index", "--wheel-dir", str(UNREPAIRED)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(ROOT)], env=environment, check=True)
    (wheel,) = UNREPAIRED.glob("*.whl")
    return wheel


def repair(wheel: Path) -> Path:
    """Copies the wheel to dist/ with the tag that it deserves."""
    DIST.mkdir(exist_ok=True)
    if importlib.util.find_spec("auditwheel") is None or shutil.which("patchelf") is None:
        print("auditwheel or patchelf is missing: the wheel fits machines like this one, and no index takes it")
        return Path(shutil.copy(wheel, DIST))
    result = UNREPAIRED / "repaired"
    excluded = [option for library in PROVIDED for option in ("--exclude", library)]
    command = [sys.executable, "-m", "auditwheel", "repair", *excluded, "--wheel-dir", str(result), str(wheel)]
    subprocess.run(command, check=True)
    (repaired,) = result.glob("*.whl")
    return Path(shutil.copy(repaired, DIST))


if __name__ == "__main__":
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # for patchelf
    main()
