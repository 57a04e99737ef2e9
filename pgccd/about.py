"""Information about this build and its backends."""

import torch

from pgccd.ops import build_information

__all__ = ["describe_installation"]


def describe_installation() -> dict[str, str]:
    """Version, commit, compiler, CUDA, torch, devices and backends, by name.

    Example:
        >>> pgccd.about.describe_installation()["kernels for"]
        'cpu...'
    """
    build = build_information()
    kernels = [
        device.lower()
        for device in ("CPU", "CUDA")
        if torch._C._dispatch_has_kernel_for_dispatch_key("pgccd::broad_pairs", device)
    ]
    devices = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    return {
        "pgccd": build["version"],
        "commit": build["commit"] or "unknown",
        "C++ sources": build["sources"],
        "compiler": build["compiler"],
        "CUDA of this build": build["cuda"] or "none",
        "CUDA architectures": build["cuda_architectures"] or "none",
        "kernels for": ", ".join(kernels),
        "torch": torch.__version__,
        "CUDA of torch": torch.version.cuda or "none",
        "CPU threads": str(torch.get_num_threads()),
        "CUDA devices": ", ".join(devices) or "none",
        "communication": ", ".join(_communication_backends()) or "none",
    }


def _communication_backends() -> list[str]:
    if not torch.distributed.is_available():
        return []
    checks = {
        "nccl": torch.distributed.is_nccl_available,
        "gloo": torch.distributed.is_gloo_available,
        "mpi": torch.distributed.is_mpi_available,
    }
    return [name for name, check in checks.items() if check()]


def __dir__() -> list[str]:
    return sorted(__all__)
