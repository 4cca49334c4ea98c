"""JAX code as scalar expressions: a program is traced for one column, and each array entry becomes its own node."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np

from ..jaxprs import FOLD, interpret
from .graph import MOST, TOO_LONG, Graph, Node, Refused, reached


@dataclass
class Loop:
    """The expression graph of a function of one rollout: the carries before the loop, one step, and the result.

    A function without steps has ``length`` 0 and no carries. Each leaf has a kind and a number:

    - ``parameter``, ``theta``, ``scored``, ``noise``: an input and its index.
    - ``carry``, ``final``: a carry within a step or after the last step, and its number.
    - ``table``: one constant per step, and the number of the table in ``constants``.
    - ``theta@``, ``scored@``, ``noise@``: an input whose index differs per step, and the number of the table in
      ``indices``.
    """

    graph: Graph
    length: int = 0
    first: list[Node] = field(default_factory=list)
    """The carries before the first step."""
    step: list[Node] = field(default_factory=list)
    """The carries after a step, as functions of the ``carry`` leaves."""
    result: Node = field(init=False)
    constants: list[np.ndarray] = field(default_factory=list)
    """Tables ``(length,)`` of constants."""
    indices: list[np.ndarray] = field(default_factory=list)
    """Tables ``(length,)`` of indices."""


def traced(function: Callable[..., Any], shapes: dict[str, int]) -> Loop:
    """Return the scalar form of ``function(*columns)``, which must return one number per column.

    ``shapes`` maps each argument, in order, to its length n. Arguments have shape ``(n, 1)``, except ``parameter (n,)``. The
    function may contain one scan. Raises :class:`Refused` with the name of a primitive without a scalar form.
    """
    import jax

    arguments = [
        jax.ShapeDtypeStruct((n,) if name == "parameter" else (n, 1), np.float64) for name, n in shapes.items()
    ]
    closed = jax.make_jaxpr(function)(*arguments)
    tracer = Tracer(Graph())
    loop, graph = tracer.loop, tracer.loop.graph
    leaves = ([graph.leaf(name, i) for i in range(n)] for name, n in shapes.items())
    inputs = [_objects(items, argument.shape) for items, argument in zip(leaves, arguments, strict=True)]
    (cost,) = tracer.run(closed.jaxpr, closed.consts, inputs)
    loop.result = tracer.nodes(cost)[0]
    if len(reached([*loop.first, *loop.step, loop.result])) > MOST:
        raise Refused(TOO_LONG)
    graph.most = len(graph.nodes) + MOST
    return loop


def _objects(items: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array.reshape(shape)


def _shaped(items: Sequence[Any], parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the items, one after another, in the shapes of ``parts``."""
    at = iter(items)
    return [_objects([next(at) for _ in range(part.size)], part.shape) for part in parts]


class Tracer:
    """Evaluates jaxprs on arrays of nodes. Arrays of constants remain plain NumPy arrays.

    ``condition`` is Boolean already where a jaxpr compares it with a number.
    """

    def __init__(self, graph: Graph, condition: Node | None = None) -> None:
        self.loop, self._condition = Loop(graph), condition

    def nodes(self, array: np.ndarray) -> list[Node]:
        """Return the entries of an array as nodes."""
        graph = self.loop.graph
        return [x if isinstance(x, Node) else graph.literal(x) for x in np.asarray(array).ravel()]

    def _each(self, op: str, values: Sequence[np.ndarray], shape: tuple[int, ...], data: Any = None) -> np.ndarray:
        """Return an operation on each entry of arrays, in the shape ``shape``."""
        rows = [self.nodes(np.broadcast_to(value, shape)) for value in values]
        return _objects([self.loop.graph.apply(op, *row, data=data) for row in zip(*rows, strict=True)], shape)

    def run(self, jaxpr: Any, consts: Sequence[Any], arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the outputs of a jaxpr as arrays of nodes or constants."""
        return [*map(np.asarray, interpret(jaxpr, consts, arguments, self._apply))]

    def _apply(self, equation: Any, given: list[Any]) -> list[np.ndarray]:
        name, parameters, values = equation.primitive.name, equation.params, [*map(np.asarray, given)]
        if name == "jit":
            return self.run(parameters["jaxpr"].jaxpr, parameters["jaxpr"].consts, values)
        if name == "scan":
            return self._scan(parameters, values)
        if name in MOVES:
            return [MOVES[name](parameters, equation.outvars[0].aval, *values)]
        if name == "unstack":  # since JAX 0.11
            return [np.asarray(row) for row in np.moveaxis(values[0], parameters["axis"], 0)]
        if name in REDUCTIONS:
            return [self._reduce(REDUCTIONS[name], values[0], parameters["axes"])]
        if name == "dot_general":
            return [self._dot(parameters["dimension_numbers"], *values)]
        return [self._elementwise(name, parameters, values, equation.outvars[0].aval)]

    def _elementwise(self, name: str, parameters: Any, values: list[np.ndarray], out: Any) -> np.ndarray:
        if name == "convert_element_type":
            return self._convert(values[0], out.dtype)
        is_condition = name == "gt" and self._condition is not None and values[0].item() is self._condition
        if name == "copy" or is_condition:
            return values[0]
        name = "add" if name == "add_any" else name
        if name == "clamp":
            low, x, high = values
            return self._elementwise("min", {}, [self._elementwise("max", {}, [x, low], out), high], out)
        if name not in FOLD and name != "integer_pow":
            raise Refused(name)
        if all(value.dtype != object for value in values):
            fold: Any = (lambda x: x ** float(parameters["y"])) if name == "integer_pow" else FOLD[name]
            with np.errstate(all="ignore"):
                return np.asarray(fold(*values), dtype=out.dtype)
        if len(values) > 3:
            raise Refused(f"{name} of more than two cases")
        return self._each(name, values, out.shape, parameters.get("y") if name == "integer_pow" else None)

    def _convert(self, value: np.ndarray, dtype: Any) -> np.ndarray:
        if value.dtype != object:
            return value.astype(dtype)
        if np.issubdtype(dtype, np.floating):
            graph = self.loop.graph
            cases = graph.literal(0.0), graph.literal(1.0)
            items = [graph.apply("select_n", x, *cases) if x.op in LOGICAL else x for x in self.nodes(value)]
            return _objects(items, value.shape)
        raise Refused(f"convert_element_type to {dtype}")

    def _reduce(self, op: str, value: np.ndarray, axes: Sequence[int]) -> np.ndarray:
        moved = np.moveaxis(value, axes, range(len(axes)))
        rows = moved.reshape(-1, *moved.shape[len(axes) :])
        return reduce(lambda total, row: self._each(op, (total, row), row.shape), rows)

    def _dot(self, dimensions: Any, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        (over_left, over_right), (batch, _) = dimensions
        if batch:
            raise Refused("dot_general with batch dimensions")
        a = np.moveaxis(left, over_left, range(left.ndim - len(over_left), left.ndim))
        b = np.moveaxis(right, over_right, range(len(over_right)))
        kept = a.shape[: a.ndim - len(over_left)] + b.shape[len(over_right) :]
        count = int(np.prod(b.shape[: len(over_right)]))
        a, b = a.reshape(-1, count), b.reshape(count, -1)
        graph = self.loop.graph
        rows, columns = map(self.nodes, a), [self.nodes(column) for column in b.T]
        pairs = [zip(row, column, strict=True) for row in rows for column in columns]
        return _objects([graph.sum(graph.apply("mul", x, y) for x, y in each) for each in pairs], kept)

    def _scan(self, parameters: Any, values: list[np.ndarray]) -> list[np.ndarray]:
        loop, closed = self.loop, parameters["jaxpr"]
        if loop.step:
            raise Refused("scan in a program that has one already")
        if parameters["reverse"]:
            raise Refused("scan backwards")
        loop.length = parameters["length"]
        if "ft_in" in parameters:  # since JAX 0.11
            consts, first, xs = map(list, parameters["ft_in"].update(values).unpack())
        else:
            n_consts, end = parameters["num_consts"], parameters["num_consts"] + parameters["num_carry"]
            consts, first, xs = values[:n_consts], values[n_consts:end], values[end:]
        if len(closed.jaxpr.outvars) != len(first):
            raise Refused("scan that returns a value of each step")
        loop.first = [node for part in first for node in self.nodes(part)]
        symbols = [loop.graph.leaf("carry", i) for i in range(len(loop.first))]
        slices = [self._slice(x) for x in xs]
        after = self.run(closed.jaxpr, closed.consts, [*consts, *_shaped(symbols, first), *slices])
        loop.step = [node for part in after for node in self.nodes(part)]
        return _shaped([loop.graph.leaf("final", i) for i in range(len(symbols))], first)

    def _slice(self, x: np.ndarray) -> np.ndarray:
        """Return one step's slice of an array ``(length, ...)``, as formulas that are valid at every step."""
        steps = [self.nodes(row) for row in x]
        return _objects([self._along([row[i] for row in steps]) for i in range(len(steps[0]))], x.shape[1:])

    def _along(self, nodes: list[Node]) -> Node:
        """Return one node that equals the given nodes, one per step, at their steps."""
        first, graph = nodes[0], self.loop.graph
        if all(node is first for node in nodes):
            return first
        kinds = {(node.op, node.data if node.args else None, len(node.args)) for node in nodes}
        if len(kinds) > 1:
            return self._branches(nodes)
        if first.op == "literal":
            return graph.leaf("table", self._table(self.loop.constants, np.array([n.data for n in nodes], float)))
        if first.op in ("theta", "scored", "noise"):
            return graph.leaf(f"{first.op}@", self._table(self.loop.indices, np.array([n.data for n in nodes])))
        if not first.args:
            raise Refused(f"{first.op} that differs between steps")
        return graph.apply(
            first.op, *(self._along([n.args[i] for n in nodes]) for i in range(len(first.args))), data=first.data
        )

    def _branches(self, nodes: list[Node]) -> Node:
        """Return a node that selects, at each step, between formulas of different form."""
        kinds = [(node.op, node.data if node.args else None) for node in nodes]
        distinct = list(dict.fromkeys(kinds))
        # maximum number of different formulas for one input of a step along the horizon
        if len(distinct) > 4:
            raise Refused("scan over inputs of too many different forms")
        graph, result = self.loop.graph, nodes[0]
        for i, kind in enumerate(distinct):
            mask = np.array([other == kind for other in kinds])
            sample = nodes[int(np.argmax(mask))]
            formula = self._along([node if here else sample for node, here in zip(nodes, mask, strict=True)])
            if i:
                table = graph.leaf("table", self._table(self.loop.constants, mask.astype(float)))
                formula = graph.apply("select_n", graph.apply("gt", table, graph.literal(0.5)), result, formula)
            result = formula
        return result

    def _table(self, tables: list[np.ndarray], values: np.ndarray) -> int:
        for i, table in enumerate(tables):
            if np.array_equal(table, values):
                return i
        tables.append(values)
        return len(tables) - 1


LOGICAL = frozenset({"and", "eq", "ge", "gt", "is_finite", "le", "lt", "ne", "not", "or", "xor"})
"""Operations with a Boolean result."""
REDUCTIONS = {
    "reduce_sum": "add",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_prod": "mul",
    "reduce_or": "or",
    "reduce_and": "and",
}


def _broadcast(parameters: Any, out: Any, value: np.ndarray, *_: Any) -> np.ndarray:
    shape = [1] * out.ndim
    for axis, target in enumerate(parameters["broadcast_dimensions"]):
        shape[target] = value.shape[axis]
    return np.broadcast_to(value.reshape(shape), out.shape)


def _sliced(parameters: Any, out: Any, value: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or (1,) * value.ndim
    bounds = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return value[tuple(slice(*each) for each in bounds)]


MOVES: dict[str, Callable[..., np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda p, out, *values: np.concatenate(values, axis=p["dimension"]),
    "expand_dims": lambda p, out, value: value.reshape(out.shape),
    "iota": lambda p, out: np.broadcast_to(
        np.arange(out.shape[p["dimension"]]).reshape([-1 if a == p["dimension"] else 1 for a in range(out.ndim)]),
        out.shape,
    ).astype(out.dtype),
    "reshape": lambda p, out, value: value.reshape(out.shape),
    "rev": lambda p, out, value: np.flip(value, p["dimensions"]),
    "slice": _sliced,
    "squeeze": lambda p, out, value: value.reshape(out.shape),
    "stack": lambda p, out, *values: np.stack(values, axis=p["axis"]),
    "transpose": lambda p, out, value: np.transpose(value, p["permutation"]),
}
"""Operations that only rearrange array entries."""
