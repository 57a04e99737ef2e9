"""All mutants, by what they change; see tests/mutants.py."""

from mutants_of import (
    arms,
    bounds,
    boxes,
    broad,
    core,
    distance,
    elements,
    exit_distance,
    files,
    narrow,
    ranks,
    readers,
    rounds,
    search,
    separation,
    solids,
    solver,
    traverse,
    voxels,
)
from mutants_of.mutant import Mutant

__all__ = ["MUTANTS", "Mutant"]

_MODULES = (
    arms,
    bounds,
    boxes,
    broad,
    core,
    distance,
    elements,
    exit_distance,
    files,
    narrow,
    ranks,
    readers,
    rounds,
    search,
    separation,
    solids,
    solver,
    traverse,
    voxels,
)
MUTANTS = [mutant for module in _MODULES for mutant in module.MUTANTS]
