"""Graph of scalar expressions: equal expressions share a node, and simplifications change no computed value."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np

from ..jaxprs import FOLD

MOST = 20_000
"""Maximum number of operations in code: longer straight-line code would take too long to compile."""
TRACED = 25 * MOST
"""Maximum number of nodes of a trace, in which inputs of each step, such as controls, become one in the code of the loop."""

NEUTRAL = {"add": 0.0, "sub": 0.0, "mul": 1.0, "div": 1.0}
"""Second arguments that change nothing, and first ones of sums and products."""
TOO_LONG = f"code of more than {MOST} operations without a loop"


class Refused(Exception):
    """Raised if a program cannot be expressed as a loop of scalar code. The message names the primitive or limit."""


@dataclass(frozen=True, eq=False)
class Node:
    """A scalar: a leaf, or an operation on other nodes. A node's ``number`` is larger than its arguments' numbers."""

    number: int
    op: str
    args: tuple[Node, ...] = ()
    data: Any = None
    """A leaf's index or value, or an operation's parameters."""

    @property
    def value(self) -> Any:
        """The value of a literal, else None."""
        return self.data if self.op == "literal" else None


@dataclass
class Graph:
    """The nodes of an expression graph. Equal nodes are the same object."""

    nodes: list[Node] = field(default_factory=list)
    most: int = TRACED
    """Maximum number of nodes."""
    _known: dict[Any, Node] = field(default_factory=dict)

    def leaf(self, op: str, data: Any = None) -> Node:
        """Return the leaf of a kind ``op`` with its index or value."""
        return self._node(op, (), data)

    def literal(self, value: Any) -> Node:
        """Return a constant. -0.0 and 0.0 are different constants, as are True and 1.0."""
        value = bool(value) if isinstance(value, bool | np.bool_) else float(value)
        return self._node("literal", (), value)

    def apply(self, op: str, *args: Node, data: Any = None) -> Node:
        """Return an operation on nodes, simplified without changing its value (except for the sign of a zero)."""
        if op == "integer_pow":
            return self._power(args[0], data)
        if op not in FOLD:
            raise Refused(op)
        values = [arg.value for arg in args]
        if all(value is not None for value in values):
            with np.errstate(all="ignore"):
                return self.literal(FOLD[op](*values))
        return self._simpler(op, args, values) or self._node(op, args, data)

    def _simpler(self, op: str, args: tuple[Node, ...], values: list[Any]) -> Node | None:
        # ``stop_gradient`` remains a separate operation, since its derivative is 0
        neutral = NEUTRAL.get(op)
        if neutral is not None and values[1] == neutral:
            return args[0]
        if op in ("add", "mul"):
            if values[0] == neutral:
                return args[1]
            # constants last, so that formulas of different steps have the same form; else in the order first used
            if args[0].op == "literal" or (op, (args[1].number, args[0].number), None) in self._known:
                return self._node(op, (args[1], args[0]), None)
        if op == "sub" and values[0] == 0.0:
            return self.apply("neg", args[1])
        if op == "mul" and -1.0 in values:
            return self.apply("neg", args[values.index(-1.0) - 1])
        if op == "neg" and args[0].op == "neg":
            return args[0].args[0]
        if op == "square":
            return self.apply("mul", args[0], args[0])
        if op == "select_n":
            if values[0] is not None:
                return args[2] if values[0] else args[1]
            if args[1] is args[2]:
                return args[1]
        return None

    def _power(self, base: Node, exponent: int) -> Node:
        """Return an integer power by repeated squaring, as XLA computes it."""
        if exponent < 0:
            return self.apply("div", self.literal(1.0), self._power(base, -exponent))
        result, square = self.literal(1.0), base
        while exponent:
            if exponent & 1:
                result = self.apply("mul", result, square)
            exponent >>= 1
            if exponent:
                square = self.apply("mul", square, square)
        return result

    def sum(self, terms: Iterable[Node]) -> Node:
        """Return the sum of nodes, from left to right."""
        return reduce(lambda total, term: self.apply("add", total, term), terms, self.literal(0.0))

    def _node(self, op: str, args: tuple[Node, ...], data: Any) -> Node:
        key = (op, tuple(arg.number for arg in args), repr(data) if op == "literal" else data)
        found = self._known.get(key)
        if found is None:
            if len(self.nodes) >= self.most:
                raise Refused(TOO_LONG)
            found = self._known[key] = Node(len(self.nodes), op, args, data)
            self.nodes.append(found)
        return found


def reached(roots: Iterable[Node], stop: Callable[[Node], bool] = lambda node: False) -> list[Node]:
    """Return the roots and all nodes that they depend on, arguments first; arguments of ``stop`` nodes are omitted."""
    seen: dict[int, Node] = {}
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node.number not in seen:
            seen[node.number] = node
            if not stop(node):
                waiting.extend(node.args)
    return [seen[number] for number in sorted(seen)]
