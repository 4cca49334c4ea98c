"""Source code of a kernel: loops over time steps around loops over lanes, with one rollout per lane.

Each value is computed in the outermost possible loop: once per call if it depends only on parameters, once per step if
it is the same in all lanes, once per lane before or after the time loop, otherwise in each step of each lane. The
forward pass stores the carries that the backward pass reads. The backward pass recomputes the other values of a step.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from .adjoint import active, pullback
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
LOOKUPS = {"theta@", "scored@", "noise@"}
TIMED = LOOKUPS | {"table", "carry", "adjoint"}
"""Leaves that differ between steps."""
WIDE = LOOKUPS | {"theta", "scored", "noise", "carry", "final", "adjoint", "total", "before"}
"""Leaves that differ between lanes."""


def source(loop: Loop, dtype: str, wrt: str | None, rows: int, title: str, cache: bool) -> str:
    """Return source of a module whose ``kernel`` computes the function, or its derivative ``(rows, B)`` by ``wrt``.

    ``wrt`` is None, ``theta`` or ``scored``.
    """
    return _Kernel(loop, wrt, rows).text(dtype, title, cache)


@dataclass
class _Code:
    lines: list[str] = field(default_factory=list)

    def add(self, depth: int, text: str) -> None:
        self.lines.append("    " * depth + text)


def _depends(known: dict[int, bool], leaves: set[str], node: Node) -> bool:
    """Return whether a node depends on leaves of these kinds; ``known`` holds the answers so far by number."""
    if node.number not in known:
        known[node.number] = node.op in leaves or any(_depends(known, leaves, arg) for arg in node.args)
    return known[node.number]


class _Kernel:
    """Generates the body of a kernel, statement by statement."""

    def __init__(self, loop: Loop, wrt: str | None, rows: int) -> None:
        self.loop, self.graph, self.wrt, self.rows = loop, loop.graph, wrt, rows
        self.code = _Code()
        self.slots: dict[str, int] = {}
        """Offset in the array ``lane`` of each per-lane value that is stored between loops over lanes, by name."""
        self.uniform_names: dict[int, str] = {}
        self.wide: dict[int, bool] = {}
        self.timed: dict[int, bool] = {}

    # ----------------------------------------------------------------------------------- dependence

    def is_wide(self, node: Node) -> bool:
        """Return whether a node's value differs between lanes."""
        return _depends(self.wide, WIDE, node)

    def is_timed(self, node: Node) -> bool:
        """Return whether a node's value differs between steps."""
        return _depends(self.timed, TIMED, node)

    def text(self, dtype: str, title: str, cache: bool) -> str:
        """Return the source of the module."""
        loop = self.loop
        assert loop.result is not None
        self.kept = self._needed([loop.result]) if loop.length else []
        backward = self._backward() if self.wrt else None
        if backward:
            # the derivative may need fewer carries: for example, it does not read the accumulated cost
            self.kept = self._needed(
                [*backward.seeds.values(), *backward.ends.values(), *(loop.step[i] for i in backward.history)],
                backward.history,
            )
        forward = {i: loop.step[i] for i in self.kept}
        starts = {i: loop.first[i] for i in self.kept}
        groups: list[Iterable[Node]] = [forward.values(), starts.values()]
        if backward is None:
            groups.append([loop.result])
        else:
            groups += [backward.seeds.values(), backward.step.values(), backward.totals.values(), backward.tables.values(),
                       backward.ends.values()]  # fmt: skip
        everything = reached([node for group in groups for node in group])
        self._uniforms(everything)
        self._lanes(everything, forward, starts, backward)
        body = self.code.lines
        used = helpers({CALLS[node.op] for node in everything if node.op in CALLS})
        beyond = float(np.finfo(dtype).max) ** 0.25
        text = HEAD.format(title=title, dtype=dtype, beyond=beyond, helpers=used, cache=cache)
        return text + _renumbered("\n".join("    " + line for line in body)) + "\n"

    def _needed(self, roots: Iterable[Node], carries: Iterable[int] = ()) -> list[int]:
        """Return the numbers of the carries on which ``roots`` (after the loop) and ``carries`` depend."""
        loop = self.loop
        found = {node.data for node in reached(roots) if node.op == "final"} | set(carries)
        while True:
            more = {n.data for n in reached([loop.step[i] for i in found]) if n.op == "carry"} | found
            if more == found:
                return sorted(found)
            found = more

    # ------------------------------------------------------------------------------------------- the adjoint

    def _backward(self) -> _Backward:
        """Return the expressions of the backward pass."""
        loop, graph, wrt = self.loop, self.graph, self.wrt
        assert loop.result is not None
        assert wrt is not None
        fixed, varying = wrt, f"{wrt}@"
        live = self._live_carries(fixed, varying)

        found = pullback(
            graph, [(loop.result, graph.literal(1.0))], lambda n: n.op == fixed or (n.op == "final" and n.data in live)
        )
        seeds = {node.data: ct for node, ct in found.items() if node.op == "final"}
        direct = {node: ct for node, ct in found.items() if node.op == fixed}
        if not loop.length:
            return _Backward({}, {}, {}, {}, {node.data: ct for node, ct in direct.items()}, [])

        # values from before the loop whose cotangents are summed over the steps
        whole = reached([loop.step[i] for i in self.kept])
        depends = active(whole, lambda n: n.op in (fixed, varying) or (n.op == "carry" and n.data in live))
        outer = {n.number for n in whole if n.number in depends and not self.is_timed(n)}
        inner = [n for n in whole if n.number not in outer]
        boundary = {a.number for n in inner for a in n.args if a.number in outer}
        boundary |= {loop.step[i].number for i in self.kept if loop.step[i].number in outer}

        def wanted(node: Node) -> bool:
            return node.number in boundary or node.op == varying or (node.op == "carry" and node.data in live)

        constant = {i: ct for i, ct in seeds.items() if ct.value is not None}
        moving = set(seeds) - set(constant)
        while True:
            adjoints = {i: constant[i] if i in constant else graph.leaf("adjoint", i) for i in {*constant, *moving}}
            found = pullback(graph, [(loop.step[i], ct) for i, ct in adjoints.items()], wanted)
            step = {node.data: ct for node, ct in found.items() if node.op == "carry"}
            # a cotangent that a step does not change, such as the accumulated cost's, is constant over the loop
            broken = {i for i in constant if step.get(i) is not constant[i]}
            if broken or set(step) - {*constant, *moving}:
                moving |= broken | (set(step) - set(constant))
                constant = {i: ct for i, ct in constant.items() if i not in broken}
                continue
            break
        zero = graph.literal(0.0)
        step = {i: step.get(i, zero) for i in sorted(moving)}
        totals = {node: ct for node, ct in found.items() if node.number in boundary}
        tables = {node.data: ct for node, ct in found.items() if node.op == varying}
        seeds_end: list[tuple[Node, Node]] = [(loop.first[i], constant[i]) for i in constant]
        seeds_end += [(loop.first[i], graph.leaf("before", i)) for i in step]
        seeds_end += [(node, graph.leaf("total", node.number)) for node in totals]
        ends = {n.data: ct for n, ct in pullback(graph, seeds_end, lambda n: n.op == fixed).items()}
        for node, ct in direct.items():
            ends[node.data] = graph.apply("add", ends[node.data], ct) if node.data in ends else ct
        used = reached([*step.values(), *totals.values(), *tables.values()])
        history = sorted({n.data for n in used if n.op == "carry"})
        return _Backward({i: seeds.get(i, zero) for i in step}, step, totals, tables, ends, history)

    def _live_carries(self, fixed: str, varying: str) -> set[int]:
        """Return the numbers of the carries that depend on the argument ``wrt``."""
        loop = self.loop
        found = {i for i in self.kept if active(reached([loop.first[i]]), lambda n: n.op == fixed)}
        while True:

            def wanted(node: Node, found: set[int] = found) -> bool:
                return node.op in (fixed, varying) or (node.op == "carry" and node.data in found)

            more = found | {i for i in self.kept if loop.step[i].number in active(reached([loop.step[i]]), wanted)}
            if more == found:
                return found
            found = more

    # --------------------------------------------------------------------------------------------- the loops

    def _uniforms(self, everything: list[Node]) -> None:
        """Write the values that are the same in all lanes and steps."""
        for node in everything:
            if not self.is_wide(node) and not self.is_timed(node):
                name = f"u{node.number}"
                self.code.add(0, f"{name} = {self._formula(node, self.uniform_names)}")
                self.uniform_names[node.number] = name
        # divisions by these values become products with their reciprocals
        self.reciprocals: dict[int, str] = {}
        for node in everything:
            if node.op == "div" and (self.is_wide(node) or self.is_timed(node)):
                below = node.args[1]
                if below.number in self.uniform_names and below.number not in self.reciprocals:
                    self.reciprocals[below.number] = f"r{below.number}"
                    self.code.add(0, f"r{below.number} = F(1.0) / u{below.number}")

    def _layout(self, everything: list[Node], forward: dict[int, Node], backward: _Backward | None) -> list[Node]:
        """Lay out the array ``lane``, and return the values from before the time loop that are read in it or after it."""
        loop = self.loop
        self.fast = any(node.op in ("sin", "cos") for node in everything)
        steady = [n for n in everything if self.is_wide(n) and not self.is_timed(n)]
        early = [n for n in steady if not any(m.op in ("final", "before", "total") for m in reached([n]))]
        inside = [*forward.values(), *(backward.inside() if backward else [])]
        after = [
            *(backward.seeds.values() if backward else [loop.result]),
            *(backward.ends.values() if backward else []),
        ]
        crossing = self._crossing(early, inside, [n for n in after if n is not None])
        history = backward.history if backward else []
        # the carries that the backward pass reads must be first and contiguous
        rows = [f"c{i}" for i in (*history, *(i for i in forward if i not in history))]
        rows += [f"k{n.number}" for n in crossing]
        if backward:
            rows += [f"a{i}" for i in backward.step] + [f"t{n.number}" for n in backward.totals]
            rows += [f"o{table}" for table in backward.tables]
        rows += ["big"] * self.fast + ["wild"] * (self.wrt == "theta")
        self.slots = {name: i * LANES for i, name in enumerate(rows)}
        return crossing

    def _lanes(self, everything: list[Node], forward: dict[int, Node], starts: dict[int, Node],
               backward: _Backward | None) -> None:  # fmt: skip
        loop, code = self.loop, self.code
        crossing = self._layout(everything, forward, backward)
        history = {i: j for j, i in enumerate(backward.history)} if backward else {}
        marks = [mark for mark in ("big", "wild") if mark in self.slots]
        code.add(0, f"lane = np.empty({max(len(self.slots), 1) * LANES}, F)")
        if history:
            code.add(0, f"kept = np.empty(horizon * {len(history) * LANES}, F)")
        code.add(0, "small = tame = True")
        code.add(0, f"for b in range(start, stop, {LANES}):")
        code.add(1, "theta_at = b * theta_column")
        code.add(1, "scored_at = b * scored_column")
        if backward and not self.covers(backward):
            # the backward pass adds to the result
            code.add(1, "for i in range(rows):")
            code.add(2, f"for l in range({LANES}):")
            code.add(3, "out[at(i * out_row + b + l)] = F(0.0)")
        # before the loop over time
        stores = [(f"c{i}", node) for i, node in starts.items()]
        stores += [(f"k{n.number}", n) for n in crossing]
        zeros = [*(f"t{n.number}" for n in backward.totals), *marks] if backward else marks
        if zeros:
            code.add(1, f"for l in range({LANES}):")
        for slot in zeros:
            code.add(2, f"lane[{self.slots[slot]} + l] = F(0.0)")
        self._pass(1, [node for _, node in stores], {}, lambda names: [
            f"lane[{self.slots[slot]} + l] = {names[node.number]}" for slot, node in stores
        ])  # fmt: skip
        kept_values = {n.number: f"lane[{self.slots[f'k{n.number}']} + l]" for n in crossing}

        if forward:
            code.add(1, "for t in range(horizon):")
            if history:
                # a separate loop: with more arrays in one loop the compiler cannot prove that none overlap
                code.add(2, f"past = (horizon - 1 - t) * {len(history) * LANES}")
                code.add(2, f"for l in range({len(history) * LANES}):")
                code.add(3, "kept[at(past + l)] = lane[l]")
            self._at_step(2, forward.values())
            loads = {self.graph.leaf("carry", i).number: f"lane[{self.slots[f'c{i}']} + l]" for i in forward}

            def store(names: dict[int, str]) -> list[str]:
                return [f"lane[{self.slots[f'c{i}']} + l] = {names[n.number]}" for i, n in forward.items()]

            self._pass(2, list(forward.values()), loads | kept_values, store)

        finals = {self.graph.leaf("final", i).number: f"lane[{self.slots[f'c{i}']} + l]" for i in forward}
        if backward is None:
            assert loop.result is not None
            result = loop.result
            self._pass(1, [result], finals | kept_values, lambda names: [f"out[at(b + l)] = {names[result.number]}"])
        else:
            self._reverse(backward, history, finals | kept_values, kept_values)
        if self.fast:
            code.add(1, f"for l in range({LANES}):")
            code.add(2, f"if lane[{self.slots['big']} + l] > F(LIMIT):")
            code.add(3, "small = False")
        if "wild" in self.slots:
            code.add(1, f"for l in range({LANES}):")
            code.add(2, f"if lane[{self.slots['wild']} + l] > F(0.0):")
            code.add(3, "tame = False")
        code.add(0, "return small, tame")

    def _crossing(self, early: list[Node], inside: list[Node], after: list[Node]) -> list[Node]:
        """Return the values computed before the time loop that are read within it or after it."""
        known = {n.number for n in early}
        users = [n for n in reached([*inside, *after]) if n.number not in known]
        read = {a.number for n in users for a in n.args} | {n.number for n in [*inside, *after]}
        if not self.loop.length:
            return []
        # includes leaves: they are stored like computed values
        return [n for n in early if n.number in read]

    def covers(self, backward: _Backward) -> bool:
        """Return whether every entry of the result is written by exactly one step."""
        if len(backward.tables) != 1:
            return False
        table = self.loop.indices[next(iter(backward.tables))]
        return np.array_equal(np.sort(table), np.arange(self.rows))

    def _reverse(self, backward: _Backward, history: dict[int, int], finals: dict[int, str],
                 kept_values: dict[int, str]) -> None:  # fmt: skip
        code, graph = self.code, self.graph
        seeds = backward.seeds
        if seeds:
            self._pass(1, list(seeds.values()), finals, lambda names: [
                f"lane[{self.slots[f'a{i}']} + l] = {names[n.number]}" for i, n in seeds.items()
            ])  # fmt: skip
        if backward.inside():
            # the history is stored in reading order, since loops over decreasing addresses are not vectorised
            code.add(1, "for back in range(horizon):")
            code.add(2, "t = horizon - 1 - back")
            self._at_step(2, backward.inside())
            for table in backward.tables:
                code.add(2, f"o{table} = index[{table} * horizon + t] * out_row + b")
            width = len(history) * LANES
            loads = {
                graph.leaf("carry", i).number: f"kept[at(back * {width} + {j * LANES} + l)]" for i, j in history.items()
            }
            loads |= {graph.leaf("adjoint", i).number: f"lane[{self.slots[f'a{i}']} + l]" for i in backward.step}

            write = "=" if self.covers(backward) else "+="

            def store(names: dict[int, str]) -> list[str]:
                lines = [f"lane[{self.slots[f'a{i}']} + l] = {names[n.number]}" for i, n in backward.step.items()]
                lines += [
                    f"lane[{self.slots[f't{b.number}']} + l] += {names[n.number]}" for b, n in backward.totals.items()
                ]
                slots = [(self.slots[f"o{k}"], n) for k, n in backward.tables.items()]
                return lines + [f"lane[{slot} + l] = {names[n.number]}" for slot, n in slots]

            self._pass(2, backward.inside(), loads | kept_values, store)
            # a separate loop: with more arrays in one loop the compiler cannot prove that none overlap
            for table in backward.tables:
                code.add(2, f"for l in range({LANES}):")
                for line in self._written(f"o{table} + l", write, f"lane[{self.slots[f'o{table}']} + l]"):
                    code.add(3, line)
        ends = backward.ends
        loads = finals | {graph.leaf("before", i).number: f"lane[{self.slots[f'a{i}']} + l]" for i in backward.step}
        loads |= {
            graph.leaf("total", n.number).number: f"lane[{self.slots[f't{n.number}']} + l]" for n in backward.totals
        }
        if ends:
            self._pass(1, list(ends.values()), loads, lambda names: [
                line for i, n in ends.items()
                for line in self._written(f"{i} * out_row + b + l", "+=", names[n.number])
            ])  # fmt: skip

    def _written(self, place: str, write: str, value: str) -> list[str]:
        """Return statements that write or add ``value`` to the result and, for derivatives by theta, flag large ones."""
        if "wild" not in self.slots:
            return [f"out[at({place})] {write} {value}"]
        wild = f"lane[{self.slots['wild']} + l]"
        total = value if write == "=" else f"out[at({place})] + {value}"
        return [
            f"slope = {total}", f"out[at({place})] = slope",
            f"{wild} = {wild} if abs(slope) < BEYOND else F(1.0)",
        ]  # fmt: skip

    def _at_step(self, depth: int, roots: Iterable[Node]) -> None:
        """Write the values that are the same in all lanes of a step, and the offsets of the step's arrays."""
        self.step_names = dict(self.uniform_names)
        for node in reached(roots):
            if node.op.endswith("@"):
                name = node.op[:-1]
                at = "b" if name == "noise" else f"{name}_at"
                self.code.add(depth, f"{name}{node.data} = index[{node.data} * horizon + t] * {name}_row + {at}")
            elif self.is_timed(node) and not self.is_wide(node):
                self.code.add(depth, f"s{node.number} = {self._formula(node, self.step_names)}")
                self.step_names[node.number] = f"s{node.number}"

    def _pass(self, depth: int, roots: list[Node], loads: dict[int, str],
              store: Callable[[dict[int, str]], list[str]]) -> None:  # fmt: skip
        """Write one loop over the lanes: read, compute, store."""
        if not roots:
            return
        self.code.add(depth, f"for l in range({LANES}):")
        names = dict(self.uniform_names if depth == 1 else self.step_names)
        for node in reached(roots, lambda n: n.number in loads or n.number in names):
            if node.number in names:
                continue
            text = loads.get(node.number) or self._formula(node, names)
            self.code.add(depth + 1, f"v{node.number} = {text}")
            names[node.number] = f"v{node.number}"
            if node.op in ("sin", "cos") and self.fast and node.number not in loads:
                big = f"lane[{self.slots['big']} + l]"
                angle = names[node.args[0].number]
                self.code.add(depth + 1, f"{big} = max_({big}, abs({angle}))")
        for line in store(names):
            self.code.add(depth + 1, line)

    def _formula(self, node: Node, names: dict[int, str]) -> str:
        """Return the expression of one node."""
        args = [names[arg.number] for arg in node.args]
        match node.op:
            case "literal":
                return repr(node.data) if isinstance(node.data, bool) else f"F({_number(node.data)})"
            case "parameter":
                return f"parameter[{node.data}]"
            case "table":
                return f"constant[{node.data} * horizon + t]"
            case "theta" | "scored":
                return f"{node.op}[at({node.data} * {node.op}_row + {node.op}_at + l)]"
            case "noise":
                return f"noise[at({node.data} * noise_row + b + l)]"
            case op if op in LOOKUPS:
                return f"{node.op[:-1]}[at({node.op[:-1]}{node.data} + l)]"
            case "div" if node.args[1].number in getattr(self, "reciprocals", {}):
                return f"{args[0]} * {self.reciprocals[node.args[1].number]}"
            case op if op in INFIX:
                return f" {INFIX[op]} ".join(args)
            case "neg":
                return f"-{args[0]}"
            case "not":
                return f"not {args[0]}"
            case "select_n":
                return f"{args[2]} if {args[0]} else {args[1]}"
            case "is_finite":
                return f"abs({args[0]}) < math.inf"
            case "stop_gradient":
                return args[0]
        return f"{CALLS.get(node.op, f'math.{node.op}')}({', '.join(args)})"


@dataclass(frozen=True)
class _Backward:
    """The expressions of a backward pass."""

    seeds: dict[int, Node]
    """Cotangents of the carries after the last step."""
    step: dict[int, Node]
    """Cotangents of the carries before a step."""
    totals: dict[Node, Node]
    """Contribution of each step to the cotangent of a value from before the loop."""
    tables: dict[int, Node]
    """Contribution of each step to the result, at the step's index in the table."""
    ends: dict[int, Node]
    """Contribution to each entry of the result after the loop."""
    history: list[int]
    """Numbers of the carries that the backward pass reads."""

    def inside(self) -> list[Node]:
        """Return the expressions that are computed in each step."""
        return [*self.step.values(), *self.totals.values(), *self.tables.values()]


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
    "add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!=",
    "and": "&", "or": "|", "xor": "^", "pow": "**",
}  # fmt: skip
CALLS = {
    "abs": "abs", "max": "max_", "min": "min_", "sign": "sign_", "sin": "sin_", "cos": "cos_", "rsqrt": "rsqrt_",
    "logistic": "logistic_", "floor": "np.floor", "ceil": "np.ceil", "rem": "math.fmod",
}  # fmt: skip
