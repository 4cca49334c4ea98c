"""Finds where the steps of a program depend on theta: a loop whose number of iterations differs between two thetas.

Reverse mode holds such steps fixed and differences do not, so that they differ by the discretisation error. A program whose
loops all have fixed lengths has no such excuse.
"""

from __future__ import annotations

import ast
import linecache
import sys
from collections import Counter
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from bench.simulator.simulator import Simulator

SKIPPED = tuple(
    f"/{name}/" for name in ("jax", "jaxlib", "torch", "numpy", "bench/model", "bench/gradient", "bench/examine")
)
"""Folders whose loops are those of a library, not of the program."""


def changing_loop(simulator: Simulator, thetas: np.ndarray, w: np.ndarray | None) -> str:
    """Return a while loop whose length depends on theta, as ``the loop at ode.py:17``; empty where none is known.

    A JAX program is read: a loop whose condition depends on theta. Other Python code runs under a trace at
    ``thetas (d, n)``. Loops of compiled code are not seen.
    """
    place = _loop_of_jax(simulator, thetas[:, 0], w)
    if place or simulator.library == "jax":
        return place
    runs = [rounds_of_loops(simulator, theta, w) for theta in thetas.T]
    for file, line in sorted(set.intersection(*map(set, runs))):
        if len({rounds[file, line] for rounds in runs}) > 1:
            return f"the loop at {Path(file).name}:{line}"
    return ""


def rounds_of_loops(simulator: Simulator, theta: np.ndarray, w: np.ndarray | None) -> Counter[tuple[str, int]]:
    """Return by file and line of a while loop how often its condition is computed by one call of the cost at ``theta (d,)``."""
    rounds: Counter[tuple[str, int]] = Counter()

    def enter(frame: FrameType, event: str, argument: Any) -> Any:
        file = frame.f_code.co_filename
        lines = set() if any(folder in file for folder in SKIPPED) else _while_loops(file)

        def follow(frame: FrameType, event: str, argument: Any) -> Any:
            if event == "line" and frame.f_lineno in lines:
                rounds[file, frame.f_lineno] += 1
            return follow

        return follow if lines else None

    simulator.trace(enter, *(part for part in (theta[:, None], w) if part is not None))
    return rounds


@cache
def _while_loops(file: str) -> set[int]:
    """Return the line at which each round of each while loop of a file begins.

    A for loop runs over a list, whose length is often the number of contacts rather than of steps.
    """
    try:
        nodes = ast.walk(ast.parse("".join(linecache.getlines(file))))
    except SyntaxError:
        return set()
    loops = [node for node in nodes if isinstance(node, ast.While)]
    # the condition of `while True` is not computed
    return {(loop.body[0] if isinstance(loop.test, ast.Constant) else loop).lineno for loop in loops}


# ------------------------------------------------------------------------------------------------------------- JAX


def _loop_of_jax(simulator: Simulator, theta: np.ndarray, w: np.ndarray | None) -> str:
    """Return ``a while loop`` for a JAX program with a while loop whose condition depends on theta; empty without one."""
    if "jax" not in sys.modules:
        return ""
    import jax

    noise = [] if w is None else [w[:, 0]]
    try:
        closed = jax.make_jaxpr(lambda vector: simulator.call(vector, *noise))(jax.numpy.asarray(theta))
    except Exception:  # a program that JAX cannot read has no such loop
        return ""
    places: list[str] = []
    _depends(closed.jaxpr, [True] * len(closed.jaxpr.invars), places)
    return places[0] if places else ""


def _depends(jaxpr: Any, given: list[bool], places: list[str]) -> list[bool]:
    """Return which outputs of a JAX program depend on inputs that do, and append the places of while loops that do."""
    known = {id(variable): one for variable, one in zip(jaxpr.invars, given, strict=True)}

    def reads(variables: Any) -> list[bool]:
        return [known.get(id(variable), False) for variable in variables]

    for equation in jaxpr.eqns:
        inputs, inner = reads(equation.invars), _programs(equation)
        outputs = [any(inputs)] * len(equation.outvars)
        if equation.primitive.name == "while":
            first, second = equation.params["cond_nconsts"], equation.params["body_nconsts"]
            carried = inputs[first + second :]
            for _ in range(len(carried) + 1):
                after = _depends(equation.params["body_jaxpr"].jaxpr, inputs[first : first + second] + carried, [])
                carried = [a or b for a, b in zip(carried, after, strict=True)]
            if any(_depends(equation.params["cond_jaxpr"].jaxpr, inputs[:first] + carried, [])):
                places.append("a while loop")
            _depends(equation.params["body_jaxpr"].jaxpr, inputs[first : first + second] + carried, places)
            outputs = carried
        elif any(inputs):
            for program in inner:
                _depends(program, _fitted(inputs, len(program.invars)), places)
        known |= {id(variable): one for variable, one in zip(equation.outvars, outputs, strict=True)}
    return reads(jaxpr.outvars)


def _fitted(inputs: list[bool], count: int) -> list[bool]:
    """Return the inputs of an inner program: the last of the equation's, or all of them where their number differs."""
    return inputs[-count:] if len(inputs) >= count else [True] * count


def _programs(equation: Any) -> list[Any]:
    """Return the inner programs of an equation, such as the branches of a condition."""
    inner = []
    for value in equation.params.values():
        for one in value if isinstance(value, tuple | list) else [value]:
            one = getattr(one, "jaxpr", one)
            inner += [one] if hasattr(one, "eqns") else []
    return inner
