"""What pgccd needs to be imported, and errors that say what is missing. Imported first, before any compiled code."""

import importlib.util
import platform
import sys

LEAST_TORCH = (2, 11)  # of the stable ABI that the operators are compiled for
#: CPU flags, by their names in Linux, that x86-64-v3 adds to x86-64-v2. The modules are compiled for x86-64-v3.
CPU_FLAGS = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}


def check() -> None:
    """Raises an ImportError that names what is missing."""
    if platform.machine() == "x86_64" and (missing := CPU_FLAGS - _cpu_flags()):
        raise ImportError(
            "pgccd needs a CPU with AVX2 and FMA (x86-64-v3: Intel Haswell, AMD Excavator or later); "
            f"this one has no {', '.join(sorted(missing))}"
        )
    wanted = f"torch {LEAST_TORCH[0]}.{LEAST_TORCH[1]} or later"
    install = f'pip install "torch>={LEAST_TORCH[0]}.{LEAST_TORCH[1]}"'
    try:
        import torch
    except ModuleNotFoundError as error:
        if error.name != "torch":  # a fault of the torch that is there
            raise
        raise ImportError(f"pgccd needs {wanted}, and this Python ({sys.executable}) has none: {install}") from error
    if tuple(int(number) for number in torch.__version__.split(".")[:2]) < LEAST_TORCH:
        raise ImportError(f"pgccd needs {wanted}, found torch {torch.__version__}: {install}")
    if importlib.util.find_spec("pgccd._C") is None:
        raise ImportError(
            f"pgccd in {__file__.rpartition('/')[0]} is not compiled: run "
            "`make build` in a source folder; to use an installed pgccd, run Python in another folder"
        )


def operators_do_not_load(error: ImportError) -> ImportError:
    """What is raised if the compiled operators cannot be loaded."""
    import torch

    return ImportError(
        f"the operators of pgccd do not load beside torch {torch.__version__} (CUDA {torch.version.cuda or 'none'}): "
        f"{error}"
    )


def _cpu_flags() -> set[str]:
    """Flags of the first CPU; all required flags where Linux does not tell."""
    try:
        with open("/proc/cpuinfo") as lines:
            for line in lines:
                if line.startswith("flags"):
                    return set(line.split())
    except OSError:
        pass
    return CPU_FLAGS


check()
