"""Finds where the steps of a program depend on theta: a loop whose number of iterations differs between two thetas.

Reverse mode holds such steps fixed and differences do not, so that they differ by the discretisation error. A program whose
loops all have fixed lengths has no such excuse.
"""

from __future__ import annotations

import ast
import itertools
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
LOOPS = (ast.For, ast.While, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


def changing_loop(simulator: Simulator, thetas: np.ndarray, w: np.ndarray | None) -> str:
    """Return a loop whose length depends on theta, as ``the loop at ode.py:17``; empty where none is known.

    A JAX program is read: a loop that does not count to a number. Other Python code runs under a trace at
    ``thetas (d, n)``. Loops of compiled code are seen where they call a Python function.
    """
    place = _loop_of_jax(simulator, thetas[:, 0], w)
    if place or simulator.library == "jax":
        return place
    runs = [rounds for rounds in (rounds_of_loops(simulator, theta, w) for theta in thetas.T) if rounds]
    for file, line in sorted(set.intersection(*map(set, runs)) if runs else ()):
        if len({rounds[file, line] for rounds in runs}) > 1:
            return f"the loop at {Path(file).name}:{line}"
    return ""


def rounds_of_loops(simulator: Simulator, theta: np.ndarray, w: np.ndarray | None) -> Counter[tuple[str, int]]:
    """Return by file and line how often a while loop, or a function that compiled code calls, runs in a cost at ``theta (d,)``.

    Empty where the cost is not a number, since its loops may have been cut off.
    """
    rounds: Counter[tuple[str, int]] = Counter()
    running: list[tuple[FrameType | None, int]] = []  # frames, each with its last instruction that entered another

    def enter(frame: FrameType, event: str, argument: Any) -> Any:
        file, caller = frame.f_code.co_filename, frame.f_back
        while running and running[-1][0] is not caller:
            running.pop()
        if caller is not None:
            # one call of a package's compiled code, in no loop of its file, enters Python functions again and again
            site, line, outer = (caller, caller.f_lasti), caller.f_lineno, caller.f_code.co_filename
            is_loop = any(loop.lineno <= line <= loop.end_lineno for loop in _loops(outer)) or _is_skipped(outer)
            if site in running[-1:] and "site-packages" in outer and not is_loop:
                rounds[outer, line] += 1
            running[-1:] = [site]
        running.append((frame, -1))
        lines = _while_loops(file)

        def follow(frame: FrameType, event: str, argument: Any) -> Any:
            if event == "line" and frame.f_lineno in lines:
                rounds[file, frame.f_lineno] += 1
            return follow

        return follow if lines else None

    costs = simulator.trace(enter, *(part for part in (theta[:, None], w) if part is not None))
    return rounds if np.isfinite(costs).all() else Counter()


def _is_skipped(file: str) -> bool:
    return any(folder in file for folder in SKIPPED)


@cache
def _loops(file: str) -> list[Any]:
    """Return the loops of a file of the program."""
    if _is_skipped(file):
        return []
    try:
        nodes = ast.walk(ast.parse("".join(linecache.getlines(file))))
    except SyntaxError:
        return []
    return [node for node in nodes if isinstance(node, LOOPS)]


@cache
def _while_loops(file: str) -> set[int]:
    """Return the line at which each round of each while loop of a file begins.

    A for loop runs over a list, whose length is often the number of contacts rather than of steps.
    """
    loops = [node for node in _loops(file) if isinstance(node, ast.While)]
    # the condition of `while True` is not computed
    return {(loop.body[0] if isinstance(loop.test, ast.Constant) else loop).lineno for loop in loops}


# ------------------------------------------------------------------------------------------------------------- JAX


def _loop_of_jax(simulator: Simulator, theta: np.ndarray, w: np.ndarray | None) -> str:
    """Return ``a while loop`` for a JAX program with one that does not count; empty without one."""
    if "jax" not in sys.modules:
        return ""
    import jax

    noise = [] if w is None else [w[:, 0]]
    try:
        closed = jax.make_jaxpr(lambda vector: simulator.call(vector, *noise))(jax.numpy.asarray(theta))
    except Exception:  # a program that JAX cannot read has no such loop
        return ""
    return "a while loop" * _has_open_loop(closed.jaxpr)


def _has_open_loop(program: Any) -> bool:
    """Return whether a program of JAX has a while loop whose condition reads more than integers, as ``fori_loop`` does."""
    for equation in program.eqns:
        if equation.primitive.name == "while":
            condition = equation.params["cond_jaxpr"].jaxpr
            read = {id(v) for v in itertools.chain(condition.outvars, *(one.invars for one in condition.eqns))}
            if any(id(v) in read and v.aval.dtype.kind not in "iu" for v in condition.invars):
                return True
        if any(map(_has_open_loop, _programs(equation))):
            return True
    return False


def _programs(equation: Any) -> list[Any]:
    """Return the inner programs of an equation, such as the branches of a condition."""
    inner = []
    for value in equation.params.values():
        for one in value if isinstance(value, tuple | list) else [value]:
            one = getattr(one, "jaxpr", one)
            inner += [one] if hasattr(one, "eqns") else []
    return inner
