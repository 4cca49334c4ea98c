"""Reverse-mode differentiation of scalar expressions by JAX's own rules, so that derivatives at ties and kinks agree."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from .graph import Graph, Node, reached
from .trace import LOGICAL, Tracer


@cache
def _rule(op: str, count: int, which: int) -> Any:
    """Return JAX's pullback of an operation to argument number ``which``, as a jaxpr of (arguments, cotangent)."""
    import jax
    from jax import lax

    def function(*args: Any) -> Any:
        if op == "select_n":
            return lax.select_n(args[0] > 0.5, *args[1:])
        return getattr(lax, op)(*args)

    def pulled(*args: Any) -> Any:
        rest = list(args[:-1])

        def of_one(x: Any) -> Any:
            return function(*rest[:which], x, *rest[which + 1 :])

        return jax.vjp(of_one, rest[which])[1](args[-1])[0]

    shape = jax.ShapeDtypeStruct((), "float64")
    return jax.make_jaxpr(pulled)(*[shape] * (count + 1))


FLAT = LOGICAL | {"ceil", "floor", "sign", "stop_gradient"}
"""Operations whose derivative is 0 wherever it exists."""


def active(nodes: list[Node], wanted: Callable[[Node], bool]) -> set[int]:
    """Return the numbers of the nodes with a derivative by a wanted node. ``nodes`` is ordered, arguments first."""
    found: set[int] = set()
    for node in nodes:
        args = node.args[node.op == "select_n" :]  # without the condition
        if wanted(node) or (node.op not in FLAT and any(arg.number in found for arg in args)):
            found.add(node.number)
    return found


def pullback(graph: Graph, seeds: list[tuple[Node, Node]], wanted: Callable[[Node], bool]) -> dict[Node, Node]:
    """Return the derivatives of the sum over seeds of node * cotangent with respect to the wanted nodes.

    Nodes whose derivative is 0 are omitted. The arguments of a wanted node are not traversed.
    """
    nodes = reached([node for node, _ in seeds], wanted)
    live = active(nodes, wanted)
    cotangents: dict[int, Node] = {}

    def add(node: Node, cotangent: Node) -> None:
        if node.number in live:
            known = cotangents.get(node.number)
            cotangents[node.number] = cotangent if known is None else graph.apply("add", known, cotangent)

    for node, cotangent in seeds:
        add(node, cotangent)
    found: dict[Node, Node] = {}
    for node in reversed(nodes):
        if node.number not in cotangents:
            continue
        cotangent = cotangents[node.number]
        if wanted(node):
            found[node] = cotangent
            continue
        for which, arg in enumerate(node.args):
            if arg.number in live and not (node.op == "select_n" and which == 0):
                add(arg, _pulled(graph, node, which, cotangent))
    return found


def _pulled(graph: Graph, node: Node, which: int, cotangent: Node) -> Node:
    """Return the cotangent of argument number ``which`` of a node."""
    closed = _rule(node.op, len(node.args), which)
    tracer = Tracer(graph, condition=node.args[0] if node.op == "select_n" else None)
    (found,) = tracer.run(closed.jaxpr, closed.consts, [np.array(arg, dtype=object) for arg in (*node.args, cotangent)])
    return tracer.nodes(found)[0]
