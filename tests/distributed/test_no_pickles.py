"""No pickle crosses a connection: no file of the package calls what sends or reads pickles.

This test imports nothing but the sources.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path for folder in ("pgccd", "examples") for path in (ROOT / folder).rglob("*.py") if path.is_file())
# Modules that make pickles, or read them.
MODULES = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "multiprocessing"}
MODULES |= {"torch.multiprocessing", "torch.distributed.rpc", "torch.distributed.checkpoint"}
# torch.distributed's functions of objects.
OF_OBJECTS = {"gather_object", "all_gather_object", "scatter_object_list", "broadcast_object_list"}
OF_OBJECTS |= {"send_object_list", "recv_object_list", "_object_to_tensor", "_tensor_to_object"}
# mpi4py's methods of objects; those of buffers begin with a capital letter.
OF_MPI = {"bcast", "gather", "scatter", "allgather", "alltoall", "reduce", "allreduce", "scan", "exscan"}
OF_MPI |= {"send", "recv", "isend", "irecv", "ssend", "issend", "bsend", "ibsend", "sendrecv", "mrecv", "improbe"}


def uses(text: str) -> list[str]:
    """What a source uses that makes pickles of values, or reads them."""
    tree = ast.parse(text)
    has_mpi, found = "mpi4py" in text, []
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
            found += [alias.name for alias in node.names if alias.name in OF_OBJECTS]
        found += [name for name in names if name in MODULES or name.split(".")[0] in MODULES]
        if isinstance(node, ast.Attribute) and node.attr in OF_OBJECTS:
            found.append(node.attr)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called, owner = node.func.attr, ast.unparse(node.func.value)
            of_mpi = called in OF_MPI and owner.split(".")[-1].strip("_") in ("world", "comm", "COMM_WORLD", "mpi")
            if has_mpi and of_mpi:
                found.append(f"{owner}.{called}")
            given = {word.arg: ast.unparse(word.value) for word in node.keywords}
            if owner == "torch" and called == "load" and given.get("weights_only", "True") != "True":
                found.append("torch.load")
            if given.get("allow_pickle", "False") != "False":
                found.append(f"{owner}.{called}")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_makes_or_reads_pickles(path: Path) -> None:
    assert uses(path.read_text()) == []


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from pickle import loads",
        "from torch import multiprocessing",
        "import torch.distributed.rpc as rpc",
        "dist.gather_object(1, None)",
        "from torch.distributed import broadcast_object_list as send",
        "send = dist.all_gather_object",
        "from mpi4py import MPI\nMPI.COMM_WORLD.bcast(1)",
        "import mpi4py\nself._world.gather(1)",
        "torch.load('x', weights_only=False)",
        "np.load('x', allow_pickle=True)",
    ],
)
def test_each_way_is_noticed(text: str) -> None:
    assert len(uses(text)) >= 1


def test_what_is_safe_is_not_noticed() -> None:
    assert (
        uses("from mpi4py import MPI\nself._world.Bcast(x)\nself._objects.gather(1)\nnp.load('x')\nimport json") == []
    )
