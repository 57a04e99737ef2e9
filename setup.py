"""Builds the two extension modules (build_support/extensions.py); everything else is in pyproject.toml."""

import sys

from setuptools import setup

# Source distributions and metadata need neither torch nor a compiler.
if {"sdist", "egg_info", "dist_info"}.isdisjoint(sys.argv):
    from build_support.extensions import BuildIncrementally, extension_modules

    setup(ext_modules=extension_modules(), cmdclass={"build_ext": BuildIncrementally})
else:
    setup()
