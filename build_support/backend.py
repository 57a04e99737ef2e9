"""The build backend: that of setuptools, with torch among the requirements of what is compiled against it.

torch is not in `build-system.requires`: a source distribution needs none.
"""

from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 (the hooks of PEP 517 and PEP 660)

#: The least torch whose stable ABI has what the operators call; binaries run on this and later ones.
TORCH = "torch>=2.11"


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    return [*build_meta.get_requires_for_build_wheel(config_settings), TORCH]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    return [*build_meta.get_requires_for_build_editable(config_settings), TORCH]
