"""Choice of the architectures that nvcc compiles for."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

import pytest

cuda_toolkit = pytest.importorskip("build_support.cuda_toolkit", reason="not run from the repository's root")


def test_every_architecture_is_named_to_the_compiler() -> None:
    assert cuda_toolkit.architecture_flags("8.0;9.0+PTX") == [
        "-gencode=arch=compute_80,code=sm_80",
        "-gencode=arch=compute_90,code=sm_90",
        "-gencode=arch=compute_90,code=compute_90",
    ]


@pytest.mark.parametrize("bad", ["", "Hopper", "9", "9.0+SASS"])
def test_other_names_are_refused(bad: str) -> None:
    with pytest.raises(ValueError, match="TORCH_CUDA_ARCH_LIST"):
        cuda_toolkit.architecture_flags(bad)


def load_bootstrap() -> Any:
    spec = importlib.util.spec_from_file_location("bootstrap", Path(__file__).resolve().parents[2] / "bootstrap.py")
    assert spec is not None and spec.loader is not None
    bootstrap = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bootstrap)
    return bootstrap


@pytest.mark.parametrize("is_reachable", [False, True])
def test_torch_is_never_replaced(is_reachable: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bootstrap = load_bootstrap()
    installed: list[str] = []
    monkeypatch.setattr(bootstrap, "VENV", tmp_path)
    monkeypatch.setattr(bootstrap, "ask", lambda _python, _program, *requirements: list(requirements))
    monkeypatch.setattr(bootstrap, "index_is_reachable", lambda: is_reachable)
    monkeypatch.setattr(bootstrap, "install", lambda _what, *arguments: installed.extend(arguments))
    monkeypatch.setattr(bootstrap, "say", lambda _: None)
    bootstrap.install_packages("2.13.0+cu130", bootstrap.REQUIREMENTS + bootstrap.EXTRAS["test"])
    assert ("numpy>=1.26" in installed) == ("pytest>=8" in installed) == is_reachable
    assert not any(name.startswith("torch>") or name == "torch" for name in installed)
    if is_reachable:
        assert installed[installed.index("--constraint") + 1] == str(tmp_path / "constraints.txt")
        assert (tmp_path / "constraints.txt").read_text() == "torch==2.13.0+cu130\n"


def test_the_demo_needs_no_packages_of_other_purposes() -> None:
    bootstrap = load_bootstrap()
    assert bootstrap.packages_of([]) == ["viz"]
    others = {name for name in bootstrap.EXTRAS if name not in ("viz", "mesh", "live", "robots", "mpi")}
    assert others == {"test", "docs", "lint", "wheel", "peers"}
    for purpose in bootstrap.PURPOSES:
        extras = bootstrap.packages_of([purpose])
        assert set(extras) <= set(bootstrap.EXTRAS)
        assert others & set(extras) == {purpose.removeprefix("bench-")}
    needed = {re.split(r"[>=]", each)[0] for each in bootstrap.REQUIREMENTS + bootstrap.EXTRAS["viz"]}
    assert needed == {"setuptools", "ninja", "numpy", "rich", "safetensors", "matplotlib"}


def test_unknown_purposes_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    bootstrap = load_bootstrap()
    monkeypatch.setattr(bootstrap, "ROOT", tmp_path)
    with pytest.raises(SystemExit, match="expected purposes among test, .*, got tests"):
        bootstrap.main(["tests", "lint"])


def test_what_is_for_other_pythons_is_not_missing() -> None:
    bootstrap = load_bootstrap()
    wanted = ["nothing-such>=1; python_version < '3.0'", "nothing-such>=1; python_version > '3.0'", "numpy>=1"]
    assert bootstrap.ask(sys.executable, bootstrap.PRINT_UNMET, *wanted) == wanted[1:2]


@pytest.mark.parametrize("wish", [None, "auto", "0", "1"])
@pytest.mark.parametrize("gpus", [0, 1])
@pytest.mark.parametrize("home", [None, "/opt/cuda"])
def test_compiler_is_downloaded_only_where_it_is_needed(
    wish: str | None, gpus: int, home: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bootstrap = load_bootstrap()
    commands: list[Any] = []
    monkeypatch.setattr(bootstrap, "ask", lambda *_: home)
    monkeypatch.setattr(bootstrap, "install", lambda what, *_: commands.append(what) or True)
    monkeypatch.setattr(bootstrap, "say", lambda _: None)
    monkeypatch.setattr(bootstrap, "install_torch", lambda: {"version": "2.13.0", "cuda": "13.0", "gpus": gpus})
    monkeypatch.setattr(bootstrap, "create_environment", lambda: None)
    monkeypatch.setattr(bootstrap, "install_packages", lambda *_: None)
    monkeypatch.setattr(bootstrap, "index_is_reachable", lambda: True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bootstrap, "ROOT", tmp_path)
    monkeypatch.setenv("PATH", "/usr/bin")
    monkeypatch.delenv("PGCCD_CUDA", raising=False)
    if wish is not None:
        monkeypatch.setenv("PGCCD_CUDA", wish)
    monkeypatch.setattr(bootstrap, "EXTENSION", tmp_path / "stamp")
    bootstrap.main([])
    expected = home is None and (wish == "1" or (gpus > 0 and wish != "0"))
    assert ("the CUDA compiler" in commands) == expected and commands[-1] == "pgccd, compiled in place"
