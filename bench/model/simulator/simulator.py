"""The user's cost and gradient as functions of columns, with every call counted and timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.errors import UserError, failure, unknown
from bench.model.simulator.clock import Clock
from bench.model.simulator.tree import ParameterTree, as_numpy

BATCHES = ("loop", "vmap", "columns", "rows")
"""How a cost takes several thetas: one by one, by the library's vmap, as ``(d, B)`` or as ``(B, d)``."""
LIBRARIES = ("jax", "torch")
"""Libraries that differentiate a cost."""
BLOCK = 16
"""Columns of a compiled batch: few enough for a heavy simulator, and one shape, so that one compilation does."""
CHUNK = 256
"""Columns of a batch that a cost takes at once without compiling."""


def _kept(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of the user's that cannot end the process: a test that did would pass with status 0."""

    def kept(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except SystemExit as error:
            given = "" if error.code is None else error.code
            raise RuntimeError(f"it ended the process by sys.exit({given})") from None

    return kept


class Simulator:
    """A cost f(theta) or f(theta, w) and perhaps its gradient, both in NumPy columns.

    ``noise`` is the length of w, 0 for a cost without randomness of its own. A call that raises counts as NaN, except
    the first: then :class:`UserError` says what it raised.
    """

    def __init__(
        self,
        cost: Callable[..., Any],
        layout: ParameterTree,
        grad: str | Callable[..., Any] | None = None,
        noise: int = 0,
        batch: str | None = None,
        clock: Clock | None = None,
    ) -> None:
        if not callable(cost):
            raise UserError(f"the cost is a function of theta, not {type(cost).__name__}")
        if batch is not None and batch not in BATCHES:
            raise unknown("batch", batch, BATCHES)
        if not (grad is None or callable(grad) or grad in LIBRARIES):
            raise unknown("grad", grad, (*LIBRARIES, "a function of theta"))
        if batch in ("columns", "rows") and not layout.flat:
            raise UserError(
                f"batch={batch} needs a theta that is one vector; this one is {', '.join(layout.names[:4])}"
            )
        self.layout, self.noise, self.clock = layout, noise, clock or Clock(float("inf"))
        self.notes: list[str] = []
        """What is worth knowing about how it was called."""
        self.raised: dict[str, int] = {}
        """What later calls of the cost raised, and how often."""
        self.gradient_error = ""
        """What the gradient raised, empty where it never did."""
        self.precision = "float64"
        """Floating-point type of what the cost returns."""
        self._cost, self._grad = _kept(cost), _kept(grad) if callable(grad) else grad
        self._shapes: set[Any] = set()
        self._single: Callable[..., Any] | None = None
        self._double = True
        self.library = self._library()
        self.batch = self._detected(batch)

    # ------------------------------------------------------------------------------------------- columns

    @property
    def unit(self) -> float:
        """Unit roundoff of the shortest floating-point type on the way from theta to the cost."""
        types = {self.precision, *(leaf.dtype for leaf in self.layout.leaves)}
        return max(float(np.finfo(name).eps) if name != "bfloat16" else 2.0**-7 for name in types)

    @property
    def width(self) -> int:
        """How many thetas are taken at once."""
        return 1 if self.batch == "loop" else BLOCK if self.library == "jax" else CHUNK

    @property
    def has_gradient(self) -> bool:
        """Whether there is a gradient to ask for."""
        return self._grad is not None

    def costs(self, thetas: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the costs of ``thetas (d, B)`` with the noise ``w (n, B)``, ``(B,)``."""
        return self._in_chunks(self._costs, "costs", thetas, w, ())

    def gradients(self, thetas: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the program's gradients, ``(d, B)``; NaN where it raised."""
        return self._in_chunks(self._gradients, "gradients", thetas, w, (self.layout.vector.size,))

    def _in_chunks(
        self,
        function: Callable[..., np.ndarray],
        kind: str,
        thetas: np.ndarray,
        w: np.ndarray | None,
        lead: tuple[int, ...],
    ) -> np.ndarray:
        count = thetas.shape[1]
        out = np.full((*lead, count), np.nan)
        size = self.width
        for start in range(0, count, size):
            self.clock.check()
            part = slice(start, min(start + size, count))
            columns = np.arange(part.start, part.stop)
            if self.library == "jax" and size > 1:
                columns = np.r_[columns, np.repeat(columns[-1:], size - columns.size)]
            began = time.perf_counter()
            with self.clock.watched():
                found = function(thetas[:, columns], None if w is None else w[:, columns])
            taken = time.perf_counter() - began
            warm = (kind, columns.size) in self._shapes
            self._shapes.add((kind, columns.size))
            self.clock.count(kind, part.stop - part.start, taken, warm)
            out[..., part] = found[..., : part.stop - part.start]
        return out

    def _costs(self, thetas: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        try:
            return np.asarray(self._values(thetas, w), dtype=np.float64)
        except Exception as error:
            self._note_raised(error)
            return np.full(thetas.shape[1], np.nan)

    def _gradients(self, thetas: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        try:
            found = self._slopes(thetas, w)
        except UserError:
            raise
        except Exception as error:
            self.gradient_error = self.gradient_error or failure(error)["reason"]
            return np.full(thetas.shape, np.nan)
        if np.iscomplexobj(found):
            raise UserError("the gradient is complex: a real cost of real numbers has a real one")
        return np.asarray(found, dtype=np.float64)

    def _note_raised(self, error: Exception) -> None:
        text = f"{type(error).__name__}: {error}"
        self.raised[text] = self.raised.get(text, 0) + 1

    # ---------------------------------------------------------------------------------------- how it is called

    def _library(self) -> str:
        if isinstance(self._grad, str):
            return self._grad
        given = {leaf.library for leaf in self.layout.leaves} & set(LIBRARIES)
        return given.pop() if given else "numpy"

    def _theta(self, vector: Any) -> Any:
        """Return the theta that the user's function gets for a vector ``(d,)``."""
        if self.library == "jax":
            return self.layout.build(vector, lambda part, leaf: part)
        if self.library == "torch":
            return self.layout.build(vector, self._tensor)
        return self.layout.build(vector)

    def _tensor(self, part: Any, leaf: Any) -> Any:
        import torch

        dtype = getattr(torch, leaf.dtype) if leaf.library == "torch" or self._double else torch.float32
        return torch.as_tensor(part).to(dtype)

    def _array(self, value: np.ndarray) -> Any:
        """Return an array as the library's own."""
        if self.library == "jax":
            import jax.numpy as jnp

            return jnp.asarray(value)
        if self.library == "torch":
            import torch

            return torch.as_tensor(np.array(value)).to(torch.float64 if self._double else torch.float32)
        return np.array(value)

    def _call(self, theta: Any, w: Any) -> Any:
        return self._cost(theta) if w is None else self._cost(theta, w)

    def _detected(self, batch: str | None) -> str:
        """Call the cost once, and return how it takes several thetas."""
        vector = self.layout.vector
        w = np.zeros(self.noise) if self.noise else None
        if batch in ("columns", "rows"):
            if not self._takes(batch):
                raise UserError(f"the cost does not take batch={batch}: {self._refusal}")
            return batch
        try:
            found = self._first(vector, w)
        except Exception as error:
            said = failure(error)["reason"]
        else:
            said = f"it returned an array of shape {found.shape}"
            if found.size == 1:
                self._see(found)
                return self._mapped(vector, float(found.ravel()[0]), batch)
        for layout in ("columns", "rows"):
            if self.layout.flat and self._takes(layout):
                self.notes.append(f"the cost takes batches as {layout}")
                return layout
        raise UserError(f"the cost cannot be called at theta: {said}; it takes theta and returns one number")

    def _first(self, vector: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        """Call the cost as it is, at theta; note whether it changes its argument."""
        began = time.perf_counter()
        theta = self._theta(self._array(vector))
        try:
            with self.clock.watched():
                value = self._call(theta, None if w is None else self._array(w))
        except RuntimeError as error:
            if self.library != "torch" or "dtype" not in str(error) or not self._double:
                raise
            self._double = False
            self.notes.append("theta is given in float32, as the torch module asks for")
            return self._first(vector, w)
        found = as_numpy(value)
        self.clock.count("costs", 1, time.perf_counter() - began, warm=False)
        if self._changed(theta, vector):
            self.notes.append("the cost changes its argument in place: it is given a copy at each call")
        return found

    def _changed(self, theta: Any, vector: np.ndarray) -> bool:
        """Return whether theta is no longer what the cost was given."""
        try:
            return not np.array_equal(self.layout.take(theta, "theta"), self._as_seen(vector))
        except UserError:
            return True

    def _as_seen(self, vector: np.ndarray) -> np.ndarray:
        """Return the numbers that theta has once they are in the library's own type."""
        return self.layout.take(self._theta(self._array(vector)), "theta")

    def _see(self, found: np.ndarray) -> None:
        """Note the precision of a cost; raise :class:`UserError` for one that is no real number."""
        if found.dtype.kind == "c":
            raise UserError(f"the cost is complex ({found.dtype}): it has to be one real number")
        if found.dtype.kind == "O" and found.size == 1 and found.ravel()[0] is None:
            raise UserError("the cost returned nothing: does it end in return?")
        if found.dtype.kind not in "fiub" and str(found.dtype) != "bfloat16":
            raise UserError(f"the cost is of type {found.dtype}: it has to be one real number")
        if found.dtype.kind == "f" or str(found.dtype) == "bfloat16":
            self.precision = str(found.dtype)

    def _mapped(self, vector: np.ndarray, value: float, batch: str | None) -> str:
        """Return ``vmap`` where the library maps the cost over thetas to the same number, else ``loop``."""
        if self.library == "jax" and batch in (None, "vmap"):
            try:
                columns = np.repeat(vector[:, None], BLOCK, axis=1)
                w = np.zeros((self.noise, BLOCK)) if self.noise else None
                self._single = None
                with self.clock.watched():
                    mapped = np.asarray(self._jax_values(columns, w, "vmap"), dtype=np.float64)
                tolerance = 1e3 * self.unit * max(abs(value), 1.0)
                if np.allclose(mapped, value, rtol=1e3 * self.unit, atol=tolerance, equal_nan=True):
                    self._shapes.add(("costs", BLOCK))
                    return "vmap"
            except Exception as error:
                if batch == "vmap":
                    raise UserError(f"jax.vmap cannot map the cost: {failure(error)['reason']}") from None
            self._single = None
            self.notes.append("jax.vmap does not map the cost, so thetas are taken one by one")
            return "loop"
        if batch == "vmap":
            if self.library != "torch":
                raise UserError("batch=vmap needs grad=jax or grad=torch: NumPy has no vmap")
            return "vmap"
        return "loop"

    def _takes(self, batch: str) -> bool:
        """Return whether the cost takes several thetas as columns or rows and returns one number for each."""
        dim = self.layout.vector.size
        count = 5 if dim != 5 else 7
        thetas = np.repeat(self.layout.vector[:, None], count, axis=1)
        w = np.zeros((self.noise, count)) if self.noise else None
        self._refusal = ""
        try:
            with self.clock.watched():
                found = as_numpy(self._batched(self._array(thetas), None if w is None else self._array(w), batch))
        except Exception as error:
            self._refusal = failure(error)["reason"]
            return False
        self.clock.count("costs", count, 0.0, warm=False)
        if found.shape != (count,):
            self._refusal = f"{count} thetas gave an array of shape {found.shape}, not {(count,)}"
            return False
        self._see(found)
        return True

    def _batched(self, thetas: Any, w: Any, batch: str) -> Any:
        if batch == "rows":
            return self._call(thetas.T, None if w is None else w.T)
        return self._call(thetas, w)

    # ------------------------------------------------------------------------------------------- values

    def _values(self, thetas: np.ndarray, w: np.ndarray | None) -> Any:
        if self.library == "jax":
            return self._jax_values(thetas, w, self.batch)
        if self.library == "torch":
            import torch

            with torch.no_grad():
                return as_numpy(self._torch_values(self._array(thetas), None if w is None else self._array(w)))
        if self.batch == "loop":
            return [
                float(as_numpy(self._call(self._theta(thetas[:, i]), None if w is None else w[:, i].copy())).ravel()[0])
                for i in range(thetas.shape[1])
            ]
        return as_numpy(self._batched(thetas.copy(), None if w is None else w.copy(), self.batch))

    def _torch_values(self, thetas: Any, w: Any) -> Any:
        """Return the costs as a tensor ``(B,)`` that still knows where it came from."""
        import torch

        if self.batch in ("columns", "rows"):
            return self._batched(thetas, w, self.batch)
        if self.batch == "vmap":
            mapped = torch.func.vmap(
                lambda vector, *rest: self._call(self._theta(vector), *rest or (None,)).reshape(()),
                in_dims=1,
                randomness="same",
            )
            return mapped(thetas) if w is None else mapped(thetas, w)
        columns = range(thetas.shape[1])
        costs = [self._call(self._theta(thetas[:, i]), None if w is None else w[:, i]) for i in columns]
        # a Python number has double precision, which torch would cut
        doubles = [cost if torch.is_tensor(cost) else torch.as_tensor(cost, dtype=torch.float64) for cost in costs]
        return torch.stack([cost.reshape(()) for cost in doubles])

    def _jax_values(self, thetas: np.ndarray, w: np.ndarray | None, batch: str) -> Any:
        import jax

        if self._single is None:

            def one(vector: Any, *rest: Any) -> Any:
                return jax.numpy.reshape(self._call(self._theta(vector), *rest or (None,)), ())

            def all_at_once(columns: Any, *rest: Any) -> Any:
                return self._batched(columns, rest[0] if rest else None, batch)

            whole = one if batch == "loop" else jax.vmap(one, in_axes=1) if batch == "vmap" else all_at_once
            summed = one if batch == "loop" else lambda columns, *rest: whole(columns, *rest).sum()
            self._single = jax.jit(whole)
            self._slope, self._eager = jax.jit(jax.grad(summed)), (whole, jax.grad(summed))
        return self._traced(self._single, self._eager[0], thetas, w, batch)

    def _traced(self, compiled: Any, eager: Any, thetas: np.ndarray, w: np.ndarray | None, batch: str) -> Any:
        """Call a compiled function, or the same one uncompiled where JAX cannot trace it."""
        import jax

        arguments = [self._array(part) for part in (thetas, w) if part is not None]
        if batch == "loop":
            arguments = [part[:, 0] for part in arguments]
        try:
            found = compiled(*arguments)
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
            if batch != "loop":
                raise
            found = eager(*arguments)
        return np.asarray(found)[..., None] if batch == "loop" else np.asarray(found)

    # ---------------------------------------------------------------------------------------- gradients

    def _slopes(self, thetas: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        if callable(self._grad):
            return self._given(thetas, w)
        if self._grad == "jax":
            if self._single is None:
                self._jax_values(thetas, w, self.batch)
            return self._traced(self._slope, self._eager[1], thetas, w, self.batch)
        return self._torch_slopes(thetas, w)

    def _given(self, thetas: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        assert callable(self._grad)
        if self.batch in ("columns", "rows"):
            turned = (lambda a: a.T) if self.batch == "rows" else (lambda a: a)
            arguments = [turned(self._array(part)) for part in (thetas, w) if part is not None]
            found = as_numpy(self._grad(*arguments))
            found = found.T if self.batch == "rows" else found
            if found.shape != thetas.shape:
                raise UserError(f"the gradient of {thetas.shape[1]} thetas has shape {found.shape}, not {thetas.shape}")
            return found
        columns = []
        for i in range(thetas.shape[1]):
            arguments = [self._theta(self._array(thetas[:, i]))] + ([] if w is None else [self._array(w[:, i])])
            columns.append(self.layout.take(self._grad(*arguments)))
        return np.stack(columns, axis=1)

    def _torch_slopes(self, thetas: np.ndarray, w: np.ndarray | None) -> np.ndarray:
        import torch

        leaf = self._array(thetas).requires_grad_()
        total = self._torch_values(leaf, None if w is None else self._array(w)).sum()
        if not total.requires_grad:
            return np.zeros(thetas.shape)
        (found,) = torch.autograd.grad(total, leaf, allow_unused=True)
        return np.zeros(thetas.shape) if found is None else found.detach().cpu().numpy()
