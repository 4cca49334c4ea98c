"""Source code of a kernel: loops over time steps around loops over lanes, with one rollout per lane.

Each value is computed in the outermost possible loop: once per call if it depends only on parameters, once per step if
it is the same in all lanes, once per lane before or after the time loop, otherwise in each step of each lane. The
forward pass stores the carries that the backward pass reads. The backward pass recomputes the other values of a step.
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

@njit(nogil=True, error_model="numpy", fastmath={{"contract"}}, cache={cache})
def kernel(parameter, constant, index, horizon, theta, theta_row, theta_column, scored, scored_row, scored_column,
           noise, noise_row, out, out_row, rows, start, stop):
    """Fill columns start to stop of ``out``; return whether all angles were small enough for fast sine and cosine, and
    whether all slopes are below ``BEYOND``."""
'''
LANE = f"for l in range({LANES}):"
WIDE = LOOKUPS | {"theta", "scored", "noise", "carry", "final", "adjoint", "total", "before"}
"""Leaves that differ between lanes."""


def source(loop: Loop, dtype: str, wrt: str | None, rows: int, title: str, cache: bool) -> str:
    """Return source of a module whose ``kernel`` computes the function, or its derivative ``(rows, B)`` by ``wrt``.

    ``wrt`` is None, ``theta`` or ``scored``.
    """
    kernel = _Kernel(loop, wrt, rows)
    used = helpers({CALLS[node.op] for node in kernel.nodes if node.op in CALLS})
    beyond = float(np.finfo(dtype).max) ** 0.25
    text = HEAD.format(title=title, dtype=dtype, beyond=beyond, helpers=used, cache=cache)
    return text + _renumbered("\n".join(f"    {line}" for line in kernel.lines())) + "\n"


def _block(head: str, lines: list[str]) -> list[str]:
    """Return the lines below a head; nothing without lines."""
    return [head, *(f"    {line}" for line in lines)] if lines else []


class _Kernel:
    """Generates the body of a kernel: blocks of lines, from the inner loops outwards."""

    def __init__(self, loop: Loop, wrt: str | None, rows: int) -> None:
        self.loop, self.graph, self.wrt = loop, loop.graph, wrt
        assert loop.result is not None
        self.result = loop.result
        kept = self._needed([loop.result]) if loop.length else []
        self.back = back = Backward()
        after = [loop.result]
        if wrt:
            self.back = back = backward(loop, kept, wrt)
            after = [*back.seeds.values(), *back.ends.values()]
            # the derivative may need fewer carries: for example, it does not read the accumulated cost
            kept = self._needed([*after, *(loop.step[i] for i in back.history)], back.history)
        self.forward, self.starts = ({i: part[i] for i in kept} for part in (loop.step, loop.first))
        inside = [*self.forward.values(), *back.inside()]
        self.nodes = reached([*self.starts.values(), *inside, *after])
        self.wide, self.timed = (dependent(self.nodes, leaves) for leaves in (WIDE, TIMED))
        late = self.timed | dependent(self.nodes, {"final", "before", "total"})
        early = {n.number: n for n in self.nodes if n.number in self.wide - late}
        users = [n for n in reached([*inside, *after]) if n.number not in early]
        read = {arg.number for n in users for arg in n.args} | {n.number for n in [*inside, *after]}
        self.crossing = {i: n for i, n in early.items() if i in read} if loop.length else {}
        """The values from before the time loop that are read in it or after it, leaves included."""
        # the carries that the backward pass reads must be first and contiguous
        names = [f"c{i}" for i in (*back.history, *(i for i in kept if i not in back.history))]
        groups = {"k": self.crossing, "a": back.step, "t": back.totals, "o": back.tables}
        names += [f"{prefix}{i}" for prefix, nodes in groups.items() for i in nodes]
        self.marks = ["big"] * any(n.op in ("sin", "cos") for n in self.nodes) + ["wild"] * (wrt == "theta")
        self.slots = {name: f"lane[{i * LANES} + l]" for i, name in enumerate([*names, *self.marks])}
        """Each per-lane value that is stored between loops over lanes, by name."""
        tables = [loop.indices[table] for table in back.tables]
        self.covers = len(tables) == 1 and np.array_equal(np.sort(tables[0]), np.arange(rows))
        """Whether every entry of the result is written by exactly one step."""
        self.adds = bool(wrt) and not self.covers

    def _needed(self, roots: Iterable[Node], carries: Iterable[int] = ()) -> list[int]:
        """Return the numbers of the carries on which ``roots`` (after the loop) and ``carries`` depend."""

        def more(found: set[int]) -> set[int]:
            return {node.data for node in reached([self.loop.step[i] for i in found]) if node.op == "carry"}

        return sorted(closure({node.data for node in reached(roots) if node.op == "final"} | set(carries), more))

    # --------------------------------------------------------------------------------------------- the loops

    def lines(self) -> list[str]:
        """Return the lines of the kernel's body."""
        back, slots, width = self.back, self.slots, len(self.back.history) * LANES
        uniforms = self._uniforms()
        body = ["theta_at = b * theta_column", "scored_at = b * scored_column"]
        if self.adds:  # the backward pass adds to the result
            body += _block("for i in range(rows):", _block(LANE, ["out[at(i * out_row + b + l)] = F(0.0)"]))
        # before the loop over time
        body += _block(LANE, [f"{slots[name]} = F(0.0)" for name in (*(f"t{i}" for i in back.totals), *self.marks)])
        body += self._pass(self.uniform_names, self._stores("c", self.starts) + self._stores("k", self.crossing), {})
        known = {i: slots[f"k{i}"] for i in self.crossing}
        # separate loops: with more arrays in one loop the compiler cannot prove that none overlap
        past = [
            f"past = (horizon - 1 - t) * {width}",
            *_block(f"for l in range({width}):", ["kept[at(past + l)] = lane[l]"]),
        ]
        inside, names = self._at_step(self.forward.values())
        inside += self._pass(names, self._stores("c", self.forward), self._leaves("carry", "c", self.forward) | known)
        if self.forward:
            body += _block("for t in range(horizon):", past * bool(width) + inside)
        finals = self._leaves("final", "c", self.forward) | known
        if not self.wrt:
            body += self._pass(self.uniform_names, [("out[at(b + l)] = {}", self.result)], finals)
        body += self._pass(self.uniform_names, self._stores("a", back.seeds), finals)
        # the history is stored in reading order, since loops over decreasing addresses are not vectorised
        loads = known | self._leaves("adjoint", "a", back.step)
        for j, i in enumerate(back.history):
            loads[self.graph.leaf("carry", i).number] = f"kept[at(back * {width} + {j * LANES} + l)]"
        stores = self._stores("a", back.step) + self._stores("t", back.totals, "+=") + self._stores("o", back.tables)
        inside, names = self._at_step(back.inside())
        inside += [f"o{table} = index[{table} * horizon + t] * out_row + b" for table in back.tables]
        inside += self._pass(names, stores, loads)
        for table in back.tables:
            written = self._written(f"o{table} + l", "+=" if self.adds else "=")
            inside += _block(LANE, written.format(slots[f"o{table}"]).splitlines())
        if stores:
            body += _block("for back in range(horizon):", ["t = horizon - 1 - back", *inside])
        loads = finals | self._leaves("before", "a", back.step) | self._leaves("total", "t", back.totals)
        stores = [(self._written(f"{i} * out_row + b + l", "+="), node) for i, node in back.ends.items()]
        body += self._pass(self.uniform_names, stores, loads)
        for mark, most, name in (("big", "LIMIT", "small"), ("wild", "0.0", "tame")):
            if mark in slots:
                body += _block(LANE, _block(f"if {slots[mark]} > F({most}):", [f"{name} = False"]))
        return [
            *uniforms,
            f"lane = np.empty({max(len(slots), 1) * LANES}, F)",
            *[f"kept = np.empty(horizon * {width}, F)"] * bool(width),
            "small = tame = True",
            *_block(f"for b in range(start, stop, {LANES}):", body),
            "return small, tame",
        ]

    def _leaves(self, op: str, prefix: str, known: Iterable[int]) -> dict[int, str]:
        """Return the slots from which leaves of a kind are read, by the numbers of their nodes."""
        return {self.graph.leaf(op, i).number: self.slots[f"{prefix}{i}"] for i in known}

    def _stores(self, prefix: str, nodes: dict[int, Node], write: str = "=") -> list[tuple[str, Node]]:
        """Return nodes with the statements that write or add ``{}`` to their slots."""
        return [(f"{self.slots[f'{prefix}{i}']} {write} {{}}", node) for i, node in nodes.items()]

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
                at = "b" if name == "noise" else f"{name}_at"
                lines.append(f"{name}{node.data} = index[{node.data} * horizon + t] * {name}_row + {at}")
            elif node.number in self.timed - self.wide:
                lines.append(f"s{node.number} = {self._formula(node, names)}")
                names[node.number] = f"s{node.number}"
        return lines, names

    def _pass(self, names: dict[int, str], stores: list[tuple[str, Node]], loads: dict[int, str]) -> list[str]:
        """Return one loop over the lanes: read ``loads``, compute, and store each node by the statements with ``{}`` for it."""
        names, lines = dict(names), []
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
    "noise": "noise[at({data} * noise_row + b + l)]",
    **{name: f"{name}[at({{data}} * {name}_row + {name}_at + l)]" for name in ("theta", "scored")},
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
