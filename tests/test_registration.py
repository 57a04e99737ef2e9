"""Every operator has its kernels, CUDA included; they are looked up in the compiled library, so no GPU is needed."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import torch

from pgccd import _C, ops
from pgccd.about import describe_installation

CSRC = Path(__file__).resolve().parents[1] / "csrc"
# The baseline runs on CPUs only.
ON_CPU_ALONE = {"pgccd::voxels_touched", "pgccd::voxel_boxes", "pgccd::voxel_pairs"}
# Messages between GPUs.
ON_CUDA_ALONE = {"pgccd::peer_gather", "pgccd::peer_minimum", "pgccd::has_conditional_nodes"}
ON_CUDA_ALONE |= {"pgccd::begin_conditional", "pgccd::end_conditional"}
OPERATORS = sorted(name for name in torch._C._dispatch_get_all_op_names() if name.startswith("pgccd::"))


def operators_with(key: str) -> list[str]:
    return [name for name in OPERATORS if torch._C._dispatch_has_kernel_for_dispatch_key(name, key)]


def built_with_cuda() -> bool:
    return describe_installation()["CUDA of this build"] != "none"


def kernels_of(path: Path) -> list[str]:
    """Names of a file's __global__ functions."""
    return [
        re.sub(r"__\w+__\([^)]*\)", "", text).split("(")[0].split()[-1]  # drops __launch_bounds__(...)
        for text in re.split(r"^\s*__global__", path.read_text(), flags=re.MULTILINE)[1:]
    ]


def test_every_operator_is_declared_and_wrapped() -> None:
    wrappers = "".join(path.read_text() for path in Path(ops.__file__).parent.glob("*.py"))
    wrapped = set(re.findall(r"^@operator\ndef _?(\w+)\(", wrappers, re.MULTILINE))
    for name in re.findall(r"^@operator_of_bodies\ndef (\w+)\(", wrappers, re.MULTILINE):
        wrapped |= {f"{name}_rigid", f"{name}_deforming"}
    assert {f"pgccd::{name}" for name in wrapped} == set(OPERATORS)
    assert len(OPERATORS) >= 15


@pytest.mark.parametrize("key", ["CPU", "Meta"])
def test_every_operator_has_a_kernel(key: str) -> None:
    assert operators_with(key) == [name for name in OPERATORS if key != "CPU" or name not in ON_CUDA_ALONE]


def test_every_operator_has_a_cuda_kernel_or_none_has() -> None:
    expected = [name for name in OPERATORS if name not in ON_CPU_ALONE]
    assert operators_with("CUDA") == (expected if built_with_cuda() else [])
    assert describe_installation()["kernels for"] == ("cpu, cuda" if built_with_cuda() else "cpu")


def test_code_for_the_device_is_inside() -> None:
    if not built_with_cuda():
        pytest.skip("built without CUDA")
    sources = [path for path in CSRC.rglob("*") if path.suffix in (".cu", ".cuh")]
    kernels = {name for path in sources for name in kernels_of(path)}
    assert len(kernels) > 10
    binary = Path(_C.__file__).read_bytes()
    assert b".nv_fatbin" in binary
    # The CUDA runtime looks up kernels by name.
    assert [name for name in sorted(kernels) if name.encode() not in binary] == []


def test_cuda_kernels_are_built_where_there_is_a_compiler() -> None:
    cuda_toolkit = pytest.importorskip("build_support.cuda_toolkit", reason="not run from the repository's root")
    if os.environ.get("PGCCD_CUDA") == "0" or torch.version.cuda is None:
        pytest.skip("CUDA kernels are not wanted, or torch has none itself")
    toolkit = cuda_toolkit.find_cuda_toolkit(torch.version.cuda)
    if toolkit is None:
        pytest.skip(f"no nvcc fits CUDA {torch.version.cuda} of torch")
    # A build with PGCCD_CUDA=0 is tested with that setting.
    assert built_with_cuda(), f"nvcc {toolkit.version} in {toolkit.home}, but the extension has no CUDA kernels"
    assert describe_installation()["CUDA architectures"] != "none"
