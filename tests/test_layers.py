"""Dependencies between layers, read from #include and import lines; and file lengths."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CSRC, PACKAGE, TESTS = ROOT / "csrc", ROOT / "pgccd", ROOT / "tests"
CUDA_HEADERS = ("cub/", "cuda", "cooperative_groups", "cuda_runtime", "thrust/", "nv/")
TORCH_HEADERS = ("torch/", "ATen/", "c10/", "Python.h")
MOST_LINES = {"header": 400, "kernel": 400, "python": 600, "test": 600}


def drawn() -> dict[str, set[str]]:
    """For each folder in the drawing of docs/explanation/architecture.md, from above, the folders that it may use."""
    text = (ROOT / "docs/explanation/architecture.md").read_text().split("## Packages", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| `([a-z/]+)/` \|[^|]*\|([^|]*)\|$", text, re.MULTILINE)
    return {name: set(re.findall(r"`([a-z]+)`", used)) for name, used in rows}


def sources() -> list[Path]:
    found = [p for p in CSRC.rglob("*") if p.suffix in {".h", ".cpp", ".cu", ".cuh"}]
    assert len(found) > 20
    return sorted(found)


def includes(path: Path) -> list[tuple[bool, str]]:
    """(is quoted, name) of each #include."""
    found = re.findall(r'^\s*#\s*include\s+(["<])([^">]+)[">]', path.read_text(), re.MULTILINE)
    return [(mark == '"', name) for mark, name in found]


def python_files(*folders: Path) -> list[Path]:
    return sorted(p for folder in folders for p in folder.rglob("*.py") if "__pycache__" not in p.parts)


def imports(path: Path, only_top_level: bool = False) -> set[str]:
    """Dotted names of the modules that a file imports; `from pgccd import x` counts as pgccd.x."""
    tree = ast.parse(path.read_text())
    found = set()
    for node in tree.body if only_top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = path.relative_to(ROOT).parent.parts
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def test_layers_include_only_what_they_may() -> None:
    wrong, may_include = [], drawn()
    for path in sources():
        layer = path.relative_to(CSRC).parts[0]
        for quoted, name in includes(path):
            if quoted and name.split("/")[0] not in {layer, *may_include[f"csrc/{layer}"]}:
                wrong.append(f"{path.relative_to(ROOT)} includes {name}")
            if not quoted and layer != "bind" and name.startswith(TORCH_HEADERS):
                wrong.append(f"{path.relative_to(ROOT)} includes {name}")
            in_kernel = layer == "kernels" and path.suffix in {".cu", ".cuh"}
            if not quoted and name.startswith(CUDA_HEADERS) and not in_kernel and layer != "bind":
                wrong.append(f"{path.relative_to(ROOT)} includes {name}")
            # Standard headers have neither a folder nor a suffix, except experimental and math.h-like ones.
            if not quoted and layer == "core" and not re.fullmatch(r"[a-z_0-9]+", name):
                wrong.append(f"{path.relative_to(ROOT)} includes <{name}>, which is not a standard header")
    assert wrong == []


def test_library_calls_take_types_of_functions() -> None:
    """CUB asks on the host for the type of a function's result, which a lambda for the device does not tell."""
    calls = 0
    for path in sources():
        text = path.read_text()
        lambdas = re.findall(r"auto (\w+) = \[[^\]]*\] *__device__", text)
        for call in re.findall(r"cub::Device\w+::[^;]*;", text):
            calls += 1
            wrong = [name for name in ("__device__", *lambdas) if re.search(rf"\b{name}\b", call)]
            assert wrong == [], f"{path.relative_to(ROOT)}: {call[:60]}: {wrong}"
    assert calls > 8


def test_kernels_wait_for_previous_ones() -> None:
    """A launch may begin before the previous kernel has ended: each kernel first waits for it."""
    kernels = 0
    for path in sources():
        text = path.read_text()
        assert "<<<" not in text, f"{path.relative_to(ROOT)}: launch_kernel launches kernels"
        for signature, body in re.findall(r"__global__([^{;]*)\{\s*([^;]*;)", text):
            assert body == "wait_for_previous_kernels();", f"{path.relative_to(ROOT)}:{signature}"
            kernels += 1
    assert kernels > 30


def test_stages_do_not_know_one_another() -> None:
    """Only pipeline, distance and arms include other stages, and no stage includes them."""
    wrong = []
    for path in sources():
        parts = path.relative_to(CSRC).parts
        if parts[0] == "kernels" and len(parts) > 2 and parts[1] not in {"pipeline", "distance", "arms"}:
            for quoted, name in includes(path):
                other = name.split("/")
                if quoted and other[0] == "kernels" and len(other) > 2 and other[1] != parts[1]:
                    wrong.append(f"{path.relative_to(ROOT)} includes {name}")
    assert wrong == []


def test_constructors_send_no_messages_and_run_no_search() -> None:
    sending = {"exchange", "exchange_counts", "all_gather", "barrier", "gather_objects", "broadcast_object", "send"}
    sending |= {"together", "on_first", "require_agreement", "require_alike", "first_row", "migrate", "of_ranks"}
    searching = {"detect", "detect_moving", "find_pass", "start_search", "search_padded", "capture", "replay", "step"}
    found, constructors = [], 0
    for path in python_files(PACKAGE):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef) or node.name not in ("__init__", "__post_init__"):
                continue
            constructors += 1
            for used in ast.walk(node):
                name = ast.unparse(used) if isinstance(used, (ast.Attribute, ast.Name)) else ""
                last = name.rpartition(".")[2]
                on_comm = re.search(r"\bcomm\.(any|min|sum|background)$", name)
                # A rotation is a value computed from two orientations.
                operator = name.startswith("ops.") and name[4:].islower() and name != "ops.rotations_between"
                if last in sending | searching or on_comm or operator:
                    found.append(f"{path.relative_to(ROOT)}: {name}")
    assert found == [] and constructors > 50


def test_only_ops_names_the_operators() -> None:
    naming = [p for p in python_files(PACKAGE) if re.search(r"torch\.ops\.pgccd|torch\.ops\b", p.read_text())]
    assert naming == [PACKAGE / "ops" / "library.py"]
    assert [p for p in python_files(PACKAGE) if "pgccd._C" in imports(p)] == naming


def test_trimesh_is_imported_lazily_and_in_one_place() -> None:
    using = [p for p in python_files(PACKAGE) if any(n.split(".")[0] == "trimesh" for n in imports(p))]
    meshes = PACKAGE / "geometry" / "mesh_files.py"
    allowed = {meshes} | set(python_files(PACKAGE / "viz"))  # viz loads meshes with it
    assert set(using) <= allowed and meshes in using
    for path in using:
        assert not any(n.split(".")[0] == "trimesh" for n in imports(path, only_top_level=True)), path


def test_the_drawing_has_every_folder() -> None:
    folders = {path.parent.relative_to(PACKAGE).as_posix() for path in PACKAGE.glob("*/**/__init__.py")}
    layers = {f"csrc/{path.relative_to(CSRC).parts[0]}" for path in sources()}
    assert set(drawn()) == folders | layers


def test_packages_import_only_what_the_drawing_says() -> None:
    may_import = {name: used for name, used in drawn().items() if "/" not in name}
    rooms = {f"pgccd.{name}" for name in may_import} - {"pgccd.ops"}
    for name, below in may_import.items():
        known = {f"pgccd.{other}" for other in {name, *below}}
        for path in python_files(PACKAGE / name):
            used = {".".join(module.split(".")[:2]) for module in imports(path)} & rooms
            assert used <= known, path


def test_packages_are_drawn_above_those_that_they_use() -> None:
    names = list(drawn())
    for name, used in drawn().items():
        folder = "csrc/" if name.startswith("csrc/") else ""
        assert all(names.index(folder + other) > names.index(name) for other in used), name


def test_single_modules_know_only_scenes_and_motions() -> None:
    for path in PACKAGE.glob("*.py"):
        # __init__ imports the others for type checkers only: see test_package.
        if path.stem not in {"cli", "__main__", "__init__"}:
            used = {".".join(name.split(".")[:2]) for name in imports(path)} & {f"pgccd.{name}" for name in drawn()}
            assert used <= {"pgccd.geometry", "pgccd.motion", "pgccd.ops"}, path


def test_folders_of_ranks_import_only_those_below() -> None:
    folders = [name.partition("/")[2] for name in drawn() if name.startswith("distributed/")]
    root = PACKAGE / "distributed"
    assert [path.name for path in root.glob("*.py")] == ["__init__.py"]
    for level, folder in enumerate(folders):
        below = {f"pgccd.distributed.{name}" for name in folders[level:]}
        for path in python_files(root / folder):
            used = {".".join(n.split(".")[:3]) for n in imports(path) if n.startswith("pgccd.distributed")}
            assert used <= below, path


def test_stages_do_not_import_one_another() -> None:
    stages = {"broad", "traverse", "narrow"}
    for stage in stages:
        used = imports(PACKAGE / "search" / f"{stage}.py")
        assert not used & {f"pgccd.search.{other}" for other in stages - {stage}}, stage


def test_modules_do_not_import_one_another_in_circles() -> None:
    """What is imported for type checkers only does not count."""
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in python_files(PACKAGE)}
    using = {name: run_time_imports(path) & modules.keys() for name, path in modules.items()}
    ends: set[str] = set()
    while leaves := {name for name, used in using.items() if name not in ends and used <= ends | {name}}:
        ends |= leaves
    assert sorted(set(modules) - ends) == []


def run_time_imports(path: Path) -> set[str]:
    """As `imports` at the top level, without blocks for type checkers."""
    tree = ast.parse(path.read_text())
    found = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_few_files_know_what_carries_messages() -> None:
    knowing = {
        library: {path.name for path in python_files(PACKAGE) if any(n.startswith(library) for n in imports(path))}
        for library in ("torch.distributed", "mpi4py")
    }
    assert knowing["torch.distributed"] == {
        "torch_comm.py",
        "nccl.py",
        "mpi_comm.py",
        # These start from a store shared by all ranks.
        "connect.py",
        "existing.py",
        "rendezvous.py",
        "agreement.py",
        "token.py",
    }
    assert knowing["mpi4py"] == {"mpi_comm.py", "rendezvous.py"}


def test_oracle_shares_nothing_with_the_product() -> None:
    for path in python_files(TESTS / "oracle"):
        assert not any(name.split(".")[0] == "pgccd" for name in imports(path)), path


@pytest.mark.parametrize(
    ("what", "paths"),
    [
        ("header", [p for p in sources() if p.suffix in {".h", ".cuh"}]),
        ("kernel", [p for p in sources() if p.suffix in {".cpp", ".cu"}]),
        ("python", python_files(PACKAGE)),
        ("test", python_files(TESTS)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_files_stay_small(what: str, paths: list[Path]) -> None:
    lines = {str(p.relative_to(ROOT)): len(p.read_text().splitlines()) for p in paths}
    assert {name: count for name, count in lines.items() if count > MOST_LINES[what]} == {}
