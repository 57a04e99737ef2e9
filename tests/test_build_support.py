"""Choosing what nvcc compiles for."""

from __future__ import annotations

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
