"""Builds the extension module (build_support/extensions.py); everything else is in pyproject.toml."""

import sys

from setuptools import setup

# Source distributions and metadata need neither torch nor a compiler.
if {"sdist", "egg_info", "dist_info"}.isdisjoint(sys.argv):
    from build_support.extensions import BuildIncrementally, operators_module

    # A wheel serves every Python from 3.11 on, as the module does.
    tag = {"bdist_wheel": {"py_limited_api": "cp311"}}
    setup(ext_modules=[operators_module()], cmdclass={"build_ext": BuildIncrementally}, options=tag)
else:
    setup()
