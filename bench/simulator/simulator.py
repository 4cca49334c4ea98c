"""A user's cost and gradient as functions of batches of columns, with every call counted and timed."""

from __future__ import annotations

import inspect
import io
import sys
from collections import Counter, deque
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import UserError, failure, unknown
from bench.simulator.clock import KINDS, Clock, OutOfTime
from bench.simulator.tree import ParameterTree, as_numpy

BATCHES = ("loop", "vmap", "columns", "rows")
"""Batching modes of a cost: one theta per call, the library's vmap, arrays ``(d, B)``, arrays ``(B, d)``."""
LIBRARIES = ("jax", "torch")
"""Libraries that can differentiate a cost."""
BLOCK = 16
"""Columns per compiled batch: one size, so that it compiles once, and small, since a simulator may be expensive."""
CHUNK = 256
"""Columns per batch that is not compiled."""
HELD = 4_000_000
"""Most numbers in the thetas of one batch."""
DISTINCT = 3
"""Fewest costs that show that all costs have single precision: each is one in double precision once in 2^29."""
SIMPLE_BITS = 12
"""Costs with at most this many significant bits, such as 0.5, show nothing about the precision."""
KEPT = 4
"""Most failed calls that are kept, to be made again."""
PACKAGE = str(Path(__file__).parents[1])
"""Folder of this package."""


def reason_of(error: Exception) -> str:
    """Return the message of an exception and where it was raised, without the frames of this package that call the user's code."""
    at = error.__traceback__
    while at and at.tb_next and at.tb_frame.f_code.co_filename.startswith(PACKAGE):
        at = at.tb_next
    return str(error) if isinstance(error, UserError) else failure(error.with_traceback(at))["reason"]


def accepts(function: Callable[..., Any], *arguments: Any, **settings: Any) -> bool:
    """Return whether the signature of a function allows a call."""
    with suppress(TypeError, ValueError):  # a built-in function may have no signature
        return bool(inspect.signature(function).bind(*arguments, **settings))
    return False


def unit_of(dtype: str) -> float:
    """Return the unit roundoff of a floating-point type by its name."""
    return 2.0**-7 if dtype == "bfloat16" else float(np.finfo(dtype).eps)


class Simulator:
    """A cost f(theta) or f(theta, w) and optionally its gradient, on NumPy batches with one sample per column.

    ``noise`` is the length of w, 0 for a cost without its own noise. ``library`` is the library of the arrays that the
    functions receive; by default that of ``grad`` or of theta. An exception in a call yields NaN, except in the
    first call, where it becomes a :class:`UserError`. Without ``compiles`` JAX does not compile the functions, which
    may then depend on what changes between calls; those that are compiled themselves stay so.
    """

    def __init__(
        self,
        cost: Callable[..., Any],
        layout: ParameterTree,
        grad: str | Callable[..., Any] | None = None,
        noise: int = 0,
        batch: str | int | None = None,
        clock: Clock | None = None,
        library: str = "",
        compiles: bool = True,
        name: str = "the cost",
    ) -> None:
        if not callable(cost):
            raise UserError(f"{name} is a function of theta, not {type(cost).__name__}")
        batch, self.fixed = _parse_batch(batch)
        if not (grad is None or callable(grad) or str(grad) in LIBRARIES):
            raise unknown("grad", grad, (*LIBRARIES, "a function of theta"))
        if isinstance(grad, str) and find_spec(grad) is None:
            raise UserError(f"grad={grad} needs a library that is not installed: pip install {grad}")
        if batch in ("columns", "rows") and not layout.flat:
            raise UserError(
                f"batch={batch} needs a theta that is one vector; this one is {', '.join(leaf.name for leaf in layout.leaves[:4])}"
            )
        self.layout, self.noise, self.clock = layout, noise, clock or Clock(float("inf"))
        self._compiles = compiles
        self.notes: list[str] = []
        """Notes for the user on how the cost is called."""
        self.raised: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
        """Number of failed calls of cost and gradient, after the cost's first call, by exception."""
        self.failed: deque[tuple[Any, ...]] = deque(maxlen=KEPT)
        """The last failed calls: ``costs`` or ``gradients``, their thetas, and the noise w where there is some."""
        self.precision = "float64"
        """Floating-point type of the cost: its own, or float32 where all its values have single precision."""
        self.printed = io.StringIO()
        """What cost and gradient print."""
        self.first_value = float("nan")
        """The cost at theta, from the first call, with w = 0."""
        self._name = name
        self._cost = self._guarded(cost, name)
        self._grad = self._guarded(grad, "the gradient") if callable(grad) else grad
        self._shapes: set[Any] = set()
        self._compiled: dict[str, tuple[Any, ...]] = {}
        self._distinct: set[float] = set()
        self._double = True
        known = sorted({leaf.library for leaf in layout.leaves} & set(LIBRARIES))
        self.library = library or (grad if isinstance(grad, str) else (known or ["numpy"])[0])
        self.batch = ""
        self.batch = self._detect_batch(batch)

    def _guarded(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """Wrap a user's function: printing is collected, ``sys.exit`` raises RuntimeError.

        A test must not pass because a simulator exits with status 0.
        """

        def call(theta: Any, *arguments: Any, **settings: Any) -> Any:
            try:
                with redirect_stdout(self.printed), redirect_stderr(self.printed):
                    value = function(theta, *arguments, **settings)
                if isinstance(value, tuple) and name == self._name:
                    if len(value) != 1:
                        raise UserError(f"{name} returned a tuple of {len(value)} values, not one number")
                    (value,) = value
                if value is None:
                    raise UserError(f"{name} returned None, as without a return statement")
                return value
            except TypeError as error:
                if accepts(function, theta, *arguments, **settings):
                    raise
                given = f"theta{', w' * len(arguments)}{', steps' * len(settings)}"
                raise UserError(f"{name} must accept ({given}): {error}") from None
            except SystemExit as error:
                raise RuntimeError(f"it ended the process by sys.exit({''.join(map(str, error.args))})") from None

        return call

    # ------------------------------------------------------------------------------------------- other calls

    def variant(self, cost: Callable[..., Any], grad: Any = None, name: str = "the cost") -> Simulator:
        """Return the simulator of another cost and gradient that are called as these, on the same clock."""
        return Simulator(cost, self.layout, grad, self.noise, self.mode, self.clock, self.library, name=name)

    def with_steps(self, steps: int) -> Simulator:
        """Return the simulator of the same cost and gradient after another number of steps."""
        grad = partial(self._grad, steps=steps) if callable(self._grad) else self._grad
        return self.variant(partial(self._cost, steps=steps), grad)

    def call(self, vector: Any, *w: Any) -> Any:
        """Return the user's cost of one theta, a vector ``(d,)``, as it is: not counted, timed or interrupted."""
        return self._cost(self._build_theta(vector), *w)

    def trace(self, enter: Callable[..., Any], *parts: np.ndarray) -> np.ndarray:
        """Return the costs of theta and w, ``(d, B)`` and ``(n, B)``, under a trace function; they count, and their time does not."""
        self.clock.check(1)
        before = sys.gettrace()
        with self.clock.interrupt_when_over():
            sys.settrace(enter)
            try:
                costs = self._computed("costs", *parts)
            finally:
                sys.settrace(before)
        self.clock.count("costs", 1, 0.0, warm=False)
        return costs

    # ------------------------------------------------------------------------------------------- columns

    @property
    def mode(self) -> str:
        """The batching mode with its fixed width, ``columns:64``."""
        return self.batch + (f":{self.fixed}" if self.fixed else "")

    @property
    def unit(self) -> float:
        """Unit roundoff of the least precise floating-point type between theta and the cost."""
        return max(map(unit_of, [self.precision, *(leaf.dtype for leaf in self.layout.leaves)]))

    @property
    def width(self) -> int:
        """Number of thetas per call."""
        if self.batch == "loop":
            return 1
        most = BLOCK if self.library == "jax" else CHUNK
        return self.fixed or max(1, min(most, HELD // self.layout.vector.size))

    @property
    def has_single_precision(self) -> bool:
        """Whether the cost returns float64 numbers that all have single precision, as from ``float(loss)``."""
        return len(self._distinct) >= DISTINCT and all(float(np.float32(one)) == one for one in self._distinct)

    @property
    def has_gradient(self) -> bool:
        """Whether the user has given a gradient or a library that differentiates the cost."""
        return self._grad is not None

    def costs(self, thetas: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the costs of ``thetas (d, B)`` with the noise ``w (n, B)``, ``(B,)``."""
        return self._in_chunks("costs", thetas, w)

    def gradients(self, thetas: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the simulator's gradients, ``(d, B)``; NaN where it raised an exception."""
        return self._in_chunks("gradients", thetas, w)

    def _in_chunks(self, kind: str, thetas: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        count = thetas.shape[1]
        out = np.full(count if kind == "costs" else thetas.shape, np.nan)
        # one gradient needs no batch, which would compute and compile more
        is_single = kind == "gradients" and count == 1 and self._is_mapped
        size = 1 if is_single else self.width
        for start in range(0, count, size):
            n = min(size, count - start)
            self.clock.check(n)
            columns: Any = slice(start, start + n)
            is_padded = (self.library == "jax" or self.fixed) and size > 1
            if is_padded:
                columns = np.minimum(np.arange(start, start + size), start + n - 1)
            shape = kind, size if is_padded else n
            is_first = shape not in self._shapes
            self._shapes.add(shape)
            began = self.clock.spent
            with self.clock.interrupt_when_over(first=is_first):
                results = self._computed(kind, *(part[:, columns] for part in (thetas, w) if part is not None))
            taken = max(self.clock.spent - began, 0.0)
            self.clock.count(kind, n, taken, warm=not is_first)
            out[..., start : start + n] = results[..., :n]
            if kind == "costs" and len(self._distinct) < 16 * DISTINCT:
                self._distinct.update(filter(_is_telling, results[:n].tolist()))
        return out

    @property
    def _is_mapped(self) -> bool:
        return self.library == "jax" and self.batch == "vmap"

    # below, ``parts`` are the columns of theta and, if the cost has noise of its own, those of the noise

    def _computed(self, kind: str, *parts: np.ndarray) -> np.ndarray:
        """Return costs ``(B,)`` or gradients ``(d, B)``; NaN where the user's code raised an exception."""
        is_cost = kind == "costs"
        try:
            values = self._values(*parts) if is_cost else self._slopes(*parts)
        except Exception as error:
            if isinstance(error, UserError) and not is_cost:
                raise
            if self.clock.is_interrupted:
                raise OutOfTime from None
            reason = reason_of(error)
            if isinstance(self._grad, str) and not (is_cost or self.clock.counts[kind]):
                advice = f"write it with {self._grad} alone, or give grad=FUNCTION"
                raise UserError(f"{self._grad} cannot differentiate the cost: {advice} ({reason})") from None
            self.failed.append((kind, *(part.copy() for part in parts)))  # whose memory is used again
            self.raised[kind][reason] += 1
            return np.full(parts[0].shape[is_cost:], np.nan)
        if np.iscomplexobj(values) and not is_cost:
            raise UserError("the gradient is complex: the gradient of a real cost of real numbers is real")
        return np.asarray(values, dtype=np.float64)

    # ------------------------------------------------------------------------------------------ calling convention

    def _build_theta(self, vector: Any) -> Any:
        """Return a vector ``(d,)`` in the form in which the user's function receives theta."""
        if self.library == "jax":
            return self.layout.unflatten(vector, lambda part, leaf: part)
        if self.library == "torch":
            return self.layout.unflatten(vector, self._tensor)
        return self.layout.unflatten(vector)

    def _tensor(self, part: Any, leaf: Any) -> Any:
        import torch

        dtype = getattr(torch, leaf.dtype) if leaf.library == "torch" or self._double else torch.float32
        return torch.as_tensor(part).to(leaf.device, dtype)

    def _array(self, value: np.ndarray) -> Any:
        """Convert an array to the library's array type."""
        if self.library == "jax":
            import jax.numpy as jnp

            return jnp.array(value)
        if self.library == "torch":
            import torch

            return torch.as_tensor(np.array(value)).to(torch.float64 if self._double else torch.float32)
        return np.array(value)

    def _detect_batch(self, batch: str | None) -> str:
        """Return the cost's batching mode, detected by trial calls."""
        if batch in ("columns", "rows"):
            if not self._accepts(batch):
                raise UserError(f"{self._name} does not accept batch={batch}: {self._batch_error}")
            return batch
        advice = "It must accept theta and return one number"
        try:
            value = self._call_once()
        except UserError:
            raise
        except Exception as error:
            problem = reason_of(error)
            if not isinstance(error, TypeError | AttributeError | LookupError):
                advice = "Give a theta at which it has a value"
        else:
            problem = f"it returned an array of shape {value.shape}"
            if value.size == 1:
                self._check_cost(value)
                self._distinct.update(filter(_is_telling, [self.first_value]))
                return self._detect_vmap(batch)
        for layout in ("columns", "rows"):
            if self.layout.flat and self._accepts(layout):
                self.notes.append(f"the cost takes batches as {layout}")
                return layout
        raise UserError(f"{self._name} cannot be called at theta: {problem}. {advice}")

    def _repeated(self, count: int) -> list[np.ndarray]:
        """Return ``count`` columns of theta and, if the cost has noise of its own, of noise 0."""
        thetas = np.repeat(self.layout.vector[:, None], count, axis=1)
        return [thetas, np.zeros((self.noise, count))] if self.noise else [thetas]

    def _call_once(self) -> np.ndarray:
        """Return the cost of theta without noise as an array."""
        parts, is_jax = self._repeated(1), self.library == "jax"
        try:
            with self.clock.interrupt_when_over(first=True):
                value = self._by_jax("cost", "loop", *parts) if is_jax else self._each(self._cost, *parts)[0]
        except RuntimeError as error:
            if self.library != "torch" or "dtype" not in str(error) or not self._double:
                raise
            self._double = False
            self.notes.append("theta is passed in float32, as the torch module requires")
            return self._call_once()
        array = as_numpy(value)
        self.clock.count("costs", 1, 0.0, warm=False)
        if not is_jax:
            self._shapes.add(("costs", 1))
        return array

    def _check_cost(self, cost: np.ndarray) -> None:
        """Record the cost's value and its precision; raises :class:`UserError` unless it is a real number."""
        if cost.dtype.kind == "f" or str(cost.dtype) == "bfloat16":
            self.precision = str(cost.dtype)
        elif cost.dtype.kind not in "iub":
            raise UserError(f"{self._name} is of type {cost.dtype}: it must be one real number")
        self.first_value = float(cost.ravel()[0])

    def _detect_vmap(self, batch: str | None) -> str:
        """Return ``vmap`` if the library's vmap of the cost yields the same values, else ``loop``."""
        if self.library == "jax" and batch in (None, "vmap"):
            try:
                with self.clock.interrupt_when_over(first=True):
                    mapped = np.asarray(self._by_jax("cost", "vmap", *self._repeated(BLOCK)), dtype=np.float64)
                value = self.first_value
                tolerance = 1e3 * self.unit * max(abs(value), 1.0)
                if np.allclose(mapped, value, rtol=1e3 * self.unit, atol=tolerance, equal_nan=True):
                    self._shapes.add(("costs", BLOCK))
                    return "vmap"
            except OutOfTime:
                self.notes.append("compiling jax.vmap of the cost took longer than compile_budget")
            except Exception as error:
                if batch == "vmap":
                    raise UserError(f"jax.vmap cannot map the cost: {failure(error)['reason']}") from None
            self.notes.append("jax.vmap cannot map the cost, so thetas are evaluated one by one")
            return "loop"
        if batch == "vmap" and self.library != "torch":
            raise UserError("batch=vmap needs grad=jax or grad=torch: NumPy has no vmap")
        return batch or "loop"

    def _accepts(self, batch: str) -> bool:
        """Return whether the cost accepts several thetas as columns or rows and returns one number per theta."""
        count = self.fixed or (5 if self.layout.vector.size != 5 else 7)
        self._batch_error = ""
        try:
            with self.clock.interrupt_when_over(first=True):
                costs = as_numpy(self._whole(self._cost, batch, *map(self._array, self._repeated(count))))
        except Exception as error:
            self._batch_error = reason_of(error)
            return False
        self.clock.count("costs", count, 0.0, warm=False)
        if costs.shape != (count,):
            self._batch_error = f"{count} thetas gave an array of shape {costs.shape}, not {(count,)}"
            return False
        self._check_cost(costs)
        return True

    def _whole(self, function: Callable[..., Any], batch: str, *parts: Any) -> Any:
        """Return a user's function of a batch of arrays with one sample per column."""
        return function(*(part.T if batch == "rows" else part for part in parts))

    def _each(self, function: Callable[..., Any], *parts: np.ndarray) -> list[Any]:
        """Return a user's function of each column of arrays."""
        columns = zip(*(map(self._array, part.T) for part in parts), strict=True)
        return [function(self._build_theta(vector), *own_noise) for vector, *own_noise in columns]

    # ------------------------------------------------------------------------------------------- values

    def _values(self, thetas: np.ndarray, *w: np.ndarray) -> Any:
        if self.library == "jax":
            return self._by_jax("cost", self.batch, thetas, *w)
        if self.library == "torch":
            import torch

            with torch.no_grad():
                return as_numpy(self._torch_values(*map(self._array, (thetas, *w))))
        if self.batch == "loop":
            return [float(as_numpy(cost).ravel()[0]) for cost in self._each(self._cost, thetas, *w)]
        return as_numpy(self._whole(self._cost, self.batch, *map(self._array, (thetas, *w))))

    def _torch_values(self, thetas: Any, *w: Any) -> Any:
        """Return the costs as a tensor ``(B,)`` that is attached to the autograd graph."""
        import torch

        if self.batch in ("columns", "rows"):
            return self._whole(self._cost, self.batch, thetas, *w)
        if self.batch == "vmap":
            return torch.func.vmap(
                lambda *parts: self.call(*parts).reshape(()),
                in_dims=1,
                randomness="same",
            )(thetas, *w)
        columns = range(thetas.shape[1])
        costs = [self.call(thetas[:, i], *(part[:, i] for part in w)) for i in columns]
        # torch would convert a Python number to single precision
        doubles = [cost if torch.is_tensor(cost) else torch.as_tensor(cost, dtype=torch.float64) for cost in costs]
        return torch.stack([cost.reshape(()) for cost in doubles])

    def _jax_functions(self, batch: str) -> dict[str, Any]:
        """Return cost and gradient for a batching mode as Python functions."""
        import jax

        def one(*parts: Any) -> Any:
            return jax.numpy.reshape(self.call(*parts), ())

        if batch == "loop":
            return {"cost": self.call, "gradient": jax.grad(one)}
        whole = jax.vmap(one, in_axes=1) if batch == "vmap" else partial(self._whole, self._cost, batch)
        return {"cost": whole, "gradient": jax.grad(lambda *parts: whole(*parts).sum())}

    def _by_jax(self, what: str, batch: str, *parts: np.ndarray) -> np.ndarray:
        """Return costs or gradients; one theta per call runs uncompiled if JAX cannot trace the function."""
        import jax

        if batch not in self._compiled:
            eager = self._jax_functions(batch)
            jitted = {name: jax.jit(function) for name, function in eager.items()} if self._compiles else eager
            self._compiled[batch] = eager, jitted
        eager, compiled = self._compiled[batch]
        arguments = [self._array(part) for part in parts]
        if batch != "loop":
            return np.asarray(compiled[what](*arguments))
        arguments = [part[:, 0] for part in arguments]
        try:
            array = as_numpy(compiled[what](*arguments))
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
            array = as_numpy(eager[what](*arguments))
        # a cost is one number, of shape () or (1,); gradients are vectors
        return array.reshape(1) if what == "cost" and array.size == 1 else array[..., None]

    # ---------------------------------------------------------------------------------------- gradients

    def _slopes(self, thetas: np.ndarray, *w: np.ndarray) -> np.ndarray:
        if callable(self._grad):
            return self._user_slopes(thetas, *w)
        if self._grad == "jax":
            mode = "loop" if self._is_mapped and thetas.shape[1] == 1 else self.batch
            return self._by_jax("gradient", mode, thetas, *w)
        import torch

        leaf = self._array(thetas).requires_grad_()
        total = self._torch_values(leaf, *map(self._array, w)).sum()
        if not total.requires_grad:
            return np.zeros(thetas.shape)
        (gradient,) = torch.autograd.grad(total, leaf, allow_unused=True, materialize_grads=True)
        return np.asarray(gradient.cpu().numpy())

    def _user_slopes(self, thetas: np.ndarray, *w: np.ndarray) -> np.ndarray:
        assert callable(self._grad)
        if self.batch in ("columns", "rows"):
            gradients = as_numpy(self._whole(self._grad, self.batch, *map(self._array, (thetas, *w))))
            gradients = gradients.T if self.batch == "rows" else gradients
            if gradients.shape != thetas.shape:
                raise UserError(
                    f"the gradient of {thetas.shape[1]} thetas has shape {gradients.shape}, not {thetas.shape}"
                )
            return gradients
        return np.stack([self.layout.flatten(each) for each in self._each(self._grad, thetas, *w)], axis=1)


def _parse_batch(batch: str | int | None) -> tuple[str | None, int]:
    """Return the batching mode and its fixed width, 0 without one: ``columns``, ``columns:64``, ``64``."""
    if batch is None:
        return None, 0
    mode, _, width = str(batch).partition(":")
    if mode.isdigit() and not width:
        mode, width = "", mode
    if mode not in ("", *BATCHES) or (
        width and not (width.isdigit() and int(width) > 1 and mode in ("", "columns", "rows"))
    ):
        raise unknown("batch", batch, (*BATCHES, "columns:WIDTH", "rows:WIDTH", "WIDTH"))
    return mode or None, int(width or 0)


def _is_telling(cost: float) -> bool:
    """Return whether a cost has enough significant bits to show its precision."""
    mantissa = np.frexp(cost)[0] * 2.0**SIMPLE_BITS
    return bool(np.isfinite(cost) and mantissa != np.round(mantissa))
