"""Values that comments of a page's blocks promise: `hits.toi  # 0.21: within the segment`."""

from __future__ import annotations

import ast
import re
from typing import Any

import numpy as np
import torch

#: Comments that begin with a value; prose follows a colon.
_VALUE = re.compile(r"#\s*((?:[-\d\[('\"]|True|False|inf|tensor\().*)$")
_NUMBER = re.compile(r"(?<![\w.])-?(?:inf\b|\d+(?:\.\d+)?)")


def run_checked(text: str, name: str, names: dict[str, Any]) -> list[str]:
    """Runs a block, statement by statement, in a namespace. What expressions do not have of the values behind them."""
    lines, wrong = text.split("\n"), []
    for node in ast.parse(text).body:
        code = ast.get_source_segment(text, node) or ""
        where = f"{name}, line {node.lineno}"
        comment = _VALUE.search(lines[(node.end_lineno or 1) - 1][node.end_col_offset or 0 :])
        if not isinstance(node, ast.Expr) or "print(" in code:
            module = ast.Module([node], [])
            exec(compile(module, where, "exec"), names)
            continue
        value = eval(compile(ast.Expression(node.value), where, "eval"), names)
        if comment and (missing := missing_of(comment[1].split(": ")[0], value)):
            wrong.append(f"{where}: {code}: {value}, without {missing}")
    return wrong


def missing_of(promised: str, value: Any) -> list[str]:
    """Numbers and words of a comment that a value does not have. Numbers count with the digits that are written."""
    leaves = list(_leaves(value))
    numbers = [float(leaf) for leaf in leaves if not isinstance(leaf, str)]
    words = [leaf for leaf in leaves if isinstance(leaf, str)] + [str(bool(n)) for n in numbers if n in (0.0, 1.0)]
    quoted = re.findall(r"'([^']*)'", promised)
    missing = [word for word in (*quoted, *re.findall(r"\b(?:True|False)\b", promised)) if word not in words]
    for text in _NUMBER.findall(re.sub(r"'[^']*'", "", promised)):
        digits = len(text.partition(".")[2])
        off = min((abs(float(text) - each) for each in numbers if each != float(text)), default=np.inf)
        if float(text) not in numbers and off > 1.01 * 10.0**-digits:
            missing.append(text)
    return missing


def _leaves(value: Any) -> Any:
    if isinstance(value, torch.Tensor | np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        for each in value:
            yield from _leaves(each)
    elif isinstance(value, bool | int | float | str):
        yield value
