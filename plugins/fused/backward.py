"""The backward pass of a loop as expressions: after the loop, in each of its steps, and before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from .adjoint import active, pullback
from .graph import Node, reached
from .trace import Loop

LOOKUPS = {"theta@", "scored@", "noise@"}
TIMED = LOOKUPS | {"table", "carry", "adjoint"}
"""Leaves that differ between steps."""


def dependent(nodes: list[Node], leaves: set[str]) -> set[int]:
    """Return the numbers of the nodes that depend on leaves of these kinds. ``nodes`` is ordered, arguments first."""
    found: set[int] = set()
    for node in nodes:
        if node.op in leaves or any(arg.number in found for arg in node.args):
            found.add(node.number)
    return found


def closure(found: set[Any], more: Callable[[set[Any]], set[Any]]) -> set[Any]:
    """Return a set after all that ``more`` finds from it has been added."""
    while not (new := more(found)) <= found:
        found = found | new
    return found


@dataclass
class Backward:
    """The expressions of a backward pass; without any for the function itself."""

    seeds: dict[int, Node] = field(default_factory=dict)
    """Cotangents of the carries after the last step."""
    step: dict[int, Node] = field(default_factory=dict)
    """Cotangents of the carries before a step."""
    totals: dict[int, Node] = field(default_factory=dict)
    """Contribution of each step to the cotangent of a value from before the loop, by the number of its node."""
    tables: dict[int, Node] = field(default_factory=dict)
    """Contribution of each step to the result, at the step's index in the table."""
    ends: dict[int, Node] = field(default_factory=dict)
    """Contribution to each entry of the result after the loop."""
    history: list[int] = field(default_factory=list)
    """Numbers of the carries that the backward pass reads."""

    def inside(self) -> list[Node]:
        """Return the expressions that are computed in each step."""
        return [*self.step.values(), *self.totals.values(), *self.tables.values()]


Wanted = Callable[[Node], bool]


def backward(loop: Loop, kept: list[int], wrt: str) -> Backward:
    """Return the expressions of the backward pass by ``wrt`` through the carries ``kept``."""
    graph, (live, outer) = loop.graph, _moving(loop, kept, wrt)
    # after the loop
    seeded = [(loop.result, graph.literal(1.0))]
    found = pullback(graph, seeded, lambda node: node.op == wrt or (node.op == "final" and node.data in live))
    seeds, direct = _of_kind("final", found), _of_kind(wrt, found)
    # in a step
    moving, found = _through_step(
        loop,
        seeds,
        lambda node: node.number in outer or node.op == f"{wrt}@" or (node.op == "carry" and node.data in live),
    )
    zero, before = graph.literal(0.0), _of_kind("carry", found)
    step = {i: before.get(i, zero) for i in sorted(moving)}
    totals, tables = {node.number: ct for node, ct in found.items() if node.number in outer}, _of_kind(f"{wrt}@", found)
    # before the loop
    first = [(loop.first[i], ct) for i, ct in seeds.items() if i not in moving]
    first += [(loop.first[i], graph.leaf("before", i)) for i in step]
    first += [(graph.nodes[i], graph.leaf("total", i)) for i in totals]
    ends = _of_kind(wrt, pullback(graph, first, lambda node: node.op == wrt))
    for i, ct in direct.items():
        ends[i] = graph.apply("add", ends[i], ct) if i in ends else ct
    used = reached([*step.values(), *totals.values(), *tables.values()])
    history = sorted({node.data for node in used if node.op == "carry"})
    return Backward({i: seeds.get(i, zero) for i in step}, step, totals, tables, ends, history)


def _of_kind(op: str, cotangents: dict[Node, Node]) -> dict[int, Node]:
    """Return the cotangents of leaves of a kind, by their index."""
    return {node.data: ct for node, ct in cotangents.items() if node.op == op}


def _moving(loop: Loop, kept: list[int], wrt: str) -> tuple[set[int], set[int]]:
    """Return the carries that depend on ``wrt``, and the nodes from before the loop that do and are read in a step."""
    ends = [loop.step[i] for i in kept]

    def depends(live: set[int]) -> Wanted:
        return lambda node: node.op in (wrt, f"{wrt}@") or (node.op == "carry" and node.data in live)

    def more(live: set[int]) -> set[int]:
        return {i for i, end in zip(kept, ends, strict=True) if end.number in active(reached([end]), depends(live))}

    live = closure({i for i in kept if active(reached([loop.first[i]]), lambda node: node.op == wrt)}, more)
    whole = reached(ends)
    outer = active(whole, depends(live)) - dependent(whole, TIMED)
    read = {arg.number for node in whole if node.number not in outer for arg in node.args}
    return live, outer & (read | {end.number for end in ends})


def _through_step(loop: Loop, seeds: dict[int, Node], wanted: Wanted) -> tuple[set[int], dict[Node, Node]]:
    """Return the carries whose cotangents change in a step, and the cotangents before a step of all ``wanted`` nodes.

    A cotangent that a step does not change, such as the accumulated cost's, is constant over the loop.
    """
    graph, moving = loop.graph, {i for i, ct in seeds.items() if ct.value is None}
    while True:
        adjoints = {i: graph.leaf("adjoint", i) if i in moving else seeds[i] for i in sorted({*seeds, *moving})}
        found = pullback(graph, [(loop.step[i], ct) for i, ct in adjoints.items()], wanted)
        step = _of_kind("carry", found)
        changed = {i for i in {*seeds, *step} - moving if step.get(i) is not seeds.get(i)}
        if not changed:
            return moving, found
        moving |= changed
