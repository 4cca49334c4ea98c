"""Source code of a kernel: loops over time steps around loops over lanes, with one rollout per lane.

Each value is computed in the outermost possible loop: once per call if it depends only on parameters, once per step if
it is the same in all lanes, once per lane before or after the time loop, otherwise in each step of each lane. The
forward pass stores the carries that the backward pass reads. The backward pass recomputes the other values of a step.

A kernel does this for each block of lanes, a method of :class:`_Kernel` each:

1. before the time loop, compute the first carries and the values that the loop reads
2. forward loop: store the carries of the step in ``kept``, then make the step
3. after the loop, write the value; or, for a derivative, seed the cotangents of the carries
4. backward loop: add each step's contribution to the derivative, and step the cotangents back
5. add what the start and the values from before the loop contribute

Variables in the generated code, numbered by node unless stated otherwise:

- ``u``: the same in all lanes and steps (uniform); ``r``: its reciprocal
- ``s``: the same in all lanes of a step
- ``v``: of one lane, in one loop over lanes

Slots are the places of ``lane`` that hold a value per lane from one loop over lanes to the next, named here by

- ``c``: a carry, by its number
- ``k``: a value from before the time loop that is read later
- ``a``: the cotangent (adjoint) of a carry, by its number
- ``t``: the sum over steps of contributions to the cotangent of a ``k`` value (total)
- ``o``: the contribution of a step to the entry of the result that a table of indices names, by the number of the table
- ``big``, ``wild``: whether an angle or a slope was too large
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from .backward import LOOKUPS, TIMED, Backward, backward, closure, dependent
from .functions import helpers
from .graph import Node, reached
from .trace import Loop

LANES = 32
"""Number of rollouts in the innermost loop; batch sizes are multiples of it."""
HEAD = '''\
"""{title}"""
import math

import numpy as np
from numba import njit

F = np.{dtype}
# a cost that overflows has no gradient, finite as its slope may be; it is looked at where slopes are beyond this
BEYOND = F({beyond!r})
# an unsigned index cannot mean "from the end", which would keep loops from being vectorised
at = np.uint64
{helpers}

@njit(nogil=True, error_model="numpy", fastmath={{"contract"}}, cache=False)
def kernel(parameter, constant, index, horizon, theta, theta_row, theta_column, scored, scored_row, scored_column,
           noise, noise_row, out, out_row, rows, start, stop):
    """Fill columns start to stop of ``out``; return whether all angles were small enough for fast sine and cosine, and
    whether all slopes are below ``BEYOND``."""
'''
LANE = f"for l in range({LANES}):"
WIDE = LOOKUPS | {"theta", "scored", "noise", "carry", "final", "adjoint", "total", "before"}
"""Leaves that differ between lanes."""


def source(loop: Loop, dtype: str, wrt: str | None, rows: int, title: str) -> str:
    """Return source of a module whose ``kernel`` computes the function, or its derivative ``(rows, B)`` by ``wrt``.

    ``wrt`` is None, ``theta`` or ``scored``.
    """
    kernel = _Kernel(loop, wrt, rows)
    used = helpers({CALLS[node.op] for node in kernel.nodes if node.op in CALLS})
    head = HEAD.format(title=title, dtype=dtype, beyond=float(np.finfo(dtype).max) ** 0.25, helpers=used)
    return head + _renumbered("\n".join(f"    {line}" for line in kernel.lines())) + "\n"


def _block(head: str, lines: list[str]) -> list[str]:
    """Return the lines below a head; nothing without lines."""
    return [head, *(f"    {line}" for line in lines)] if lines else []


class _Kernel:
    """Generates the body of a kernel: blocks of lines, from the inner loops outwards."""

    def __init__(self, loop: Loop, wrt: str | None, rows: int) -> None:
        self.loop, self.graph, self.wrt = loop, loop.graph, wrt
        self.back = back = backward(loop, self._needed([loop.result]), wrt) if wrt else Backward()
        after = [*back.seeds.values(), *back.ends.values()] if wrt else [loop.result]
        # a derivative may need fewer carries than the value: for example, it does not read the accumulated cost
        needed = self._needed([*after, *(loop.step[i] for i in back.history)], back.history)
        # the carries that the backward pass reads are first and contiguous
        carries = dict.fromkeys([*back.history, *needed])
        self.forward, self.starts = ({i: part[i] for i in carries} for part in (loop.step, loop.first))
        inside = [*self.forward.values(), *back.inside()]
        self.nodes = reached([*self.starts.values(), *inside, *after])
        self.wide, self.timed = (dependent(self.nodes, leaves) for leaves in (WIDE, TIMED))
        self.crossing = self._crossing(inside, after) if loop.length else {}
        """The values from before the time loop that are read in it or after it, leaves included."""
        self.marks = ["big"] * any(n.op in ("sin", "cos") for n in self.nodes) + ["wild"] * (wrt == "theta")
        self.slots = {name: f"lane[{i * LANES} + l]" for i, name in enumerate(self._slot_names())}
        """The code of each slot by its name."""
        self.known = {i: self.slots[f"k{i}"] for i in self.crossing}
        """The slots of values from before the time loop, by the numbers of their nodes."""
        self.finals = self._leaves("final", "c", self.forward) | self.known
        self.width = len(back.history) * LANES
        """Number of stored carries of all lanes in one step."""
        entries = np.sort([loop.indices[table] for table in back.tables], axis=None)
        # whether steps add to entries of the result, since not every entry is written by exactly one of them
        self.adds = bool(wrt) and not np.array_equal(entries, np.arange(rows))

    def _crossing(self, inside: list[Node], after: list[Node]) -> dict[int, Node]:
        """Return the values that depend on the lane but not on the step, and are read by ``inside`` or ``after``."""
        late = self.timed | dependent(self.nodes, {"final", "before", "total"})
        early = {n.number: n for n in self.nodes if n.number in self.wide - late}
        users = [n for n in reached([*inside, *after]) if n.number not in early]
        read = {arg.number for n in users for arg in n.args} | {n.number for n in [*inside, *after]}
        return {i: n for i, n in early.items() if i in read}

    def _slot_names(self) -> list[str]:
        """Return the names of all slots in order."""
        back = self.back
        groups = {"c": self.forward, "k": self.crossing, "a": back.step, "t": back.totals, "o": back.tables}
        return [*(f"{letter}{i}" for letter, numbers in groups.items() for i in numbers), *self.marks]

    def _needed(self, roots: Iterable[Node], carries: Iterable[int] = ()) -> list[int]:
        """Return the numbers of the carries on which ``roots`` (after the loop) and ``carries`` depend."""
        after = {node.data for node in reached(roots) if node.op == "final"}
        return sorted(
            closure(
                after | set(carries),
                lambda found: {n.data for n in reached([self.loop.step[i] for i in found]) if n.op == "carry"},
            )
        )

    # --------------------------------------------------------------------------------------------- the loops

    def lines(self) -> list[str]:
        """Return the lines of the kernel's body."""
        uniforms, value = self._uniforms(), [("out[at(b + l)] = {}", self.loop.result)]
        block = [
            "theta_at = b * theta_column",
            "scored_at = b * scored_column",
            "noise_at = b",
            *self._cleared(),
            *self._pass(self._stores("c", self.starts) + self._stores("k", self.crossing), {}),
            *self._forward_loop(),
            *self._pass(self._stores("a", self.back.seeds) if self.wrt else value, self.finals),
            *self._backward_loop(),
            *self._ends(),
            *self._flag("big", "LIMIT", "small"),
            *self._flag("wild", "0.0", "tame"),
        ]
        return [
            *uniforms,
            f"lane = np.empty({max(len(self.slots), 1) * LANES}, F)",
            *[f"kept = np.empty(horizon * {self.width}, F)"] * bool(self.width),
            "small = tame = True",
            *_block(f"for b in range(start, stop, {LANES}):", block),
            "return small, tame",
        ]

    def _cleared(self) -> list[str]:
        """Return the lines that set to 0 what is added to: the result, totals and marks."""
        result = _block("for i in range(rows):", _block(LANE, ["out[at(i * out_row + b + l)] = F(0.0)"]))
        names = [*(f"t{i}" for i in self.back.totals), *self.marks]
        return result * self.adds + _block(LANE, [f"{self.slots[name]} = F(0.0)" for name in names])

    def _forward_loop(self) -> list[str]:
        # a loop of its own: with more arrays in one loop the compiler cannot prove that none overlap. The last step is
        # first in the history, since loops over decreasing addresses, as the backward pass would be, are not vectorised
        history = [
            f"past = (horizon - 1 - t) * {self.width}",
            *_block(f"for l in range({self.width}):", ["kept[at(past + l)] = lane[l]"]),
        ]
        lines, names = self._at_step(self.forward.values())
        loads = self._leaves("carry", "c", self.forward) | self.known
        lines += self._pass(self._stores("c", self.forward), loads, names)
        return _block("for t in range(horizon):", history * bool(self.width) + lines)

    def _backward_loop(self) -> list[str]:
        back = self.back
        stores = self._stores("a", back.step) + self._stores("t", back.totals, "+=") + self._stores("o", back.tables)
        if not stores:
            return []
        loads = self.known | self._leaves("adjoint", "a", back.step)
        for j, i in enumerate(back.history):
            loads[self.graph.leaf("carry", i).number] = f"kept[at(back * {self.width} + {j * LANES} + l)]"
        lines, names = self._at_step(back.inside())
        lines += [f"o{table} = index[{table} * horizon + t] * out_row + b" for table in back.tables]
        lines += self._pass(stores, loads, names)
        for table in back.tables:
            written = self._written(f"o{table} + l", "+=" if self.adds else "=")
            lines += _block(LANE, written.format(self.slots[f"o{table}"]).splitlines())
        return _block("for back in range(horizon):", ["t = horizon - 1 - back", *lines])

    def _ends(self) -> list[str]:
        """Return the lines that add to the result what is known after the backward loop only."""
        back = self.back
        loads = self.finals | self._leaves("before", "a", back.step) | self._leaves("total", "t", back.totals)
        stores = [(self._written(f"{i} * out_row + b + l", "+="), node) for i, node in back.ends.items()]
        return self._pass(stores, loads)

    def _flag(self, mark: str, most: str, flag: str) -> list[str]:
        """Return the lines that clear a flag, which the kernel returns, if a lane's mark is above ``most``."""
        lines = [f"if {self.slots[mark]} > F({most}):", f"    {flag} = False"] if mark in self.marks else []
        return _block(LANE, lines)

    def _leaves(self, op: str, letter: str, numbers: Iterable[int]) -> dict[int, str]:
        """Return the slots from which leaves of a kind are read, by the numbers of their nodes."""
        return {self.graph.leaf(op, i).number: self.slots[f"{letter}{i}"] for i in numbers}

    def _stores(self, letter: str, nodes: dict[int, Node], write: str = "=") -> list[tuple[str, Node]]:
        """Return nodes with the statements that write or add ``{}`` to their slots."""
        return [(f"{self.slots[f'{letter}{i}']} {write} {{}}", node) for i, node in nodes.items()]

    def _written(self, place: str, write: str) -> str:
        """Return statements that write or add ``{}`` to the result and, for derivatives by theta, flag large ones."""
        if "wild" not in self.slots:
            return f"out[at({place})] {write} {{}}"
        wild, before = self.slots["wild"], "" if write == "=" else f"out[at({place})] + "
        return f"slope = {before}{{}}\nout[at({place})] = slope\n{wild} = {wild} if abs(slope) < BEYOND else F(1.0)"

    def _uniforms(self) -> list[str]:
        """Return the lines of the values that are the same in all lanes and steps, and of reciprocals of divisors among them."""
        self.uniform_names: dict[int, str] = {}
        self.reciprocals: dict[int, str] = {}
        lines = []
        for node in self.nodes:
            if node.number not in self.wide | self.timed:
                lines.append(f"u{node.number} = {self._formula(node, self.uniform_names)}")
                self.uniform_names[node.number] = f"u{node.number}"
        below = [n.args[1].number for n in self.nodes if n.op == "div" and n.number not in self.uniform_names]
        self.reciprocals = {i: f"r{i}" for i in below if i in self.uniform_names}
        return lines + [f"{name} = F(1.0) / u{i}" for i, name in self.reciprocals.items()]

    def _at_step(self, roots: Iterable[Node]) -> tuple[list[str], dict[int, str]]:
        """Return the lines of a step before its loop over lanes, offsets of arrays included, and the names known then."""
        names, lines = dict(self.uniform_names), []
        for node in reached(roots):
            if node.op in LOOKUPS:
                name = node.op[:-1]
                lines.append(f"{name}{node.data} = index[{node.data} * horizon + t] * {name}_row + {name}_at")
            elif node.number in self.timed - self.wide:
                lines.append(f"s{node.number} = {self._formula(node, names)}")
                names[node.number] = f"s{node.number}"
        return lines, names

    def _pass(
        self, stores: list[tuple[str, Node]], loads: dict[int, str], known: dict[int, str] | None = None
    ) -> list[str]:
        """Return one loop over the lanes: read ``loads``, compute, and store each node by the statements with ``{}`` for it.

        ``known`` are the variables that already have values, by default those of uniform values.
        """
        names, lines = dict(known or self.uniform_names), []
        for node in reached([node for _, node in stores], lambda n: n.number in loads or n.number in names):
            if node.number not in names:
                lines.append(f"v{node.number} = {loads.get(node.number) or self._formula(node, names)}")
                names[node.number] = f"v{node.number}"
                if node.op in ("sin", "cos") and node.number not in loads:
                    big = self.slots["big"]
                    lines.append(f"{big} = max_({big}, abs({names[node.args[0].number]}))")
        for text, node in stores:
            lines += text.format(names[node.number]).splitlines()
        return _block(LANE, lines)

    def _formula(self, node: Node, names: dict[int, str]) -> str:
        """Return the expression of one node."""
        args = [names[arg.number] for arg in node.args]
        if node.op == "literal":
            return repr(node.data) if isinstance(node.data, bool) else f"F({_number(node.data)})"
        if node.op == "div" and node.args[1].number in self.reciprocals:
            return f"{args[0]} * {self.reciprocals[node.args[1].number]}"
        if node.op in FORMULAS:
            return FORMULAS[node.op].format(*args, data=node.data)
        return f"{CALLS.get(node.op, f'math.{node.op}')}({', '.join(args)})"


def _renumbered(code: str) -> str:
    """Return code with names renumbered in order of use, so that it does not depend on the number of inputs.

    A longer horizon has more inputs, which shift the numbers of all later nodes.
    """
    known: dict[str, str] = {}
    return re.sub(r"\b([rsuv])(\d+)\b", lambda m: m[1] + known.setdefault(m[2], str(len(known))), code)


def _number(value: float) -> str:
    text = repr(value)
    return {"nan": "math.nan", "inf": "math.inf", "-inf": "-math.inf"}.get(text, text)


INFIX = {
    "add": "+",
    "sub": "-",
    "mul": "*",
    "div": "/",
    "lt": "<",
    "le": "<=",
    "gt": ">",
    "ge": ">=",
    "eq": "==",
    "ne": "!=",
    "and": "&",
    "or": "|",
    "xor": "^",
    "pow": "**",
}
FORMULAS = {
    "parameter": "parameter[{data}]",
    "table": "constant[{data} * horizon + t]",
    **{name: f"{name}[at({{data}} * {name}_row + {name}_at + l)]" for name in ("theta", "scored", "noise")},
    **{op: f"{op[:-1]}[at({op[:-1]}{{data}} + l)]" for op in LOOKUPS},
    **{op: f"{{}} {sign} {{}}" for op, sign in INFIX.items()},
    "neg": "-{}",
    "not": "not {}",
    "select_n": "{2} if {0} else {1}",
    "is_finite": "abs({}) < math.inf",
    "stop_gradient": "{}",
}
"""The expressions of nodes by their operation, from those of their arguments."""
CALLS = {
    "abs": "abs",
    "max": "max_",
    "min": "min_",
    "sign": "sign_",
    "sin": "sin_",
    "cos": "cos_",
    "rsqrt": "rsqrt_",
    "logistic": "logistic_",
    "floor": "np.floor",
    "ceil": "np.ceil",
    "rem": "math.fmod",
}
