"""Every operator has its kernels, CUDA included; they are looked up in the compiled library, so no GPU is needed."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import torch

from pgccd import _C, ops
from pgccd.about import describe_installation

CSRC = Path(__file__).resolve().parents[2] / "csrc"
BIND = CSRC / "bind"
# Meshes are prepared, and the baseline runs, on CPUs only.
ON_CPU_ALONE = {"pgccd::prepare_mesh", "pgccd::voxels_touched", "pgccd::voxel_boxes", "pgccd::voxel_pairs"}
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


def test_wrappers_are_exported() -> None:
    for path in Path(ops.__file__).parent.glob("*.py"):
        for name in re.findall(r"^@operator(?:_of_bodies)?\ndef ([a-z]\w*)\(", path.read_text(), re.MULTILINE):
            assert hasattr(ops, name), f"{path.name}: {name} is not in pgccd/ops/__init__.py"


@pytest.mark.parametrize("key", ["CPU", "Meta"])
def test_every_operator_has_a_kernel(key: str) -> None:
    assert operators_with(key) == [name for name in OPERATORS if key != "CPU" or name not in ON_CUDA_ALONE]


def test_every_operator_has_a_cuda_kernel_or_none_has() -> None:
    expected = [name for name in OPERATORS if name not in ON_CPU_ALONE]
    assert operators_with("CUDA") == (expected if built_with_cuda() else [])
    assert describe_installation()["kernels for"] == ("cpu, cuda" if built_with_cuda() else "cpu")


def test_an_operator_stands_in_one_header() -> None:
    """Its function and the line that registers it; ops_cpu.cpp and ops_cuda.cpp register whole headers."""
    registered: list[str] = []
    for path in BIND.glob("*_ops.h"):
        text = path.read_text()
        for name, function in re.findall(r'library\.impl\("(\w+)",\s*PGCCD_BOX\(([\w:<> ]+)\)\)', text):
            registered.append(f"pgccd::{name}")
            bare = re.sub(r"^Ops::(template )?|<[\w:]+>$", "", function)
            found = re.findall(rf"^ *(?:static|inline) [\w:<>, ]+ {bare}\(", text, re.MULTILINE)
            assert len(found) == 1, f"{path.name}: {bare}: {found}"
    assert sorted(registered) == OPERATORS
    texts = {path.name: path.read_text() for path in BIND.iterdir()}
    assert [name for name, text in texts.items() if "library.def(" in text] == ["schemas.cpp"]
    assert {name for name, text in texts.items() if "LIBRARY_IMPL" in text} == {"ops_cpu.cpp", "ops_cuda.cpp"}


def test_operators_are_registered_for_both_sessions() -> None:
    everywhere, on_cpu, on_cuda = (
        set(),
        {"register_mesh_ops", "register_voxel_ops"},
        {"register_peer_ops", "register_graph_ops"},
    )
    operators: dict[str, set[str]] = {}
    for path in BIND.glob("*_ops.h"):
        text = path.read_text()
        everywhere |= set(re.findall(r"template <class Session>\nvoid (register_\w+)", text))
        for name in re.findall(r"\b(register_\w+)\(Library& library\)", text):
            operators[name] = {f"pgccd::{each}" for each in re.findall(r'library\.impl\("(\w+)"', text)}
    assert len(everywhere) == 9
    # These lists decide what is expected of a build with CUDA: they are compared where there is none, too.
    for names, alone in ((on_cpu, ON_CPU_ALONE), (on_cuda, ON_CUDA_ALONE)):
        assert set().union(*(operators[name] for name in names)) == alone
    for file, session, alone in (("ops_cpu.cpp", "CpuSession", on_cpu), ("ops_cuda.cpp", "CudaSession", on_cuda)):
        calls = re.findall(r"^  (register_\w+(?:<\w+>)?)\(library\);", (BIND / file).read_text(), re.MULTILINE)
        assert sorted(calls) == sorted({f"{name}<{session}>" for name in everywhere} | alone), file


def test_kernels_for_cpu_and_cuda_are_overloads_in_one_header() -> None:
    of_templates = "".join(p.read_text() for p in BIND.glob("*_ops.h") if "template <class Session>" in p.read_text())
    called = set(re.findall(r"pgccd::(\w+)(?:<[\w:]+>)?\(\s*(?:Session\(|session\.context)", of_templates))
    assert len(called) > 30
    headers = {path.name: path.read_text() for path in (CSRC / "kernels").rglob("*.h")}
    for name in called:
        on_cpu, on_cuda = (
            [header for header, text in headers.items() if re.search(rf"^\w.*\b{name}\(const {context}&", text, re.M)]
            for context in ("Executor", "DeviceContext")
        )
        assert on_cpu == on_cuda and len(on_cpu) == 1, f"{name}: {on_cpu}, {on_cuda}"
    for path in (path for path in (CSRC / "kernels").rglob("*") if path.is_file()):
        assert not re.search(r"\w_(cpu|cuda)\(const (Executor|DeviceContext)&", path.read_text()), path


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
