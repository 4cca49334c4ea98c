"""Runs another gradient checker on the cases of `simulators.py`, and reports its complaints, calls and seconds.

    python tests/programs/checkers.py gradcheck|check_grads|tesseract|gradcheck_tape

prints a line per case and a summary. `warp.autograd.gradcheck_tape` only checks Warp kernels, so it runs on the Warp programs of
`engine_cases.py`, in an environment with Warp. Each checker has its default steps and tolerances. A cost in the checker's own
library is passed unchanged; others are wrapped as a function with a custom gradient: `torch.autograd.Function`,
`jax.custom_vjp`, or the endpoints `apply` and `jacobian` of a tesseract. A simulator's own noise is one fixed draw. Nothing
of `bench` is imported, so that tesseract-core can have its own environment.
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
import types
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import simulators


class Counted:
    """A case as two functions of an array, with the calls counted."""

    def __init__(self, case: simulators.Case) -> None:
        self.case, self.calls = case, 0
        length = case.settings.get("noise", 0)
        self.noise = (np.random.default_rng(0).standard_normal(length),) if length else ()

    def cost(self, x: Any) -> Any:
        """Return the cost in the case's own library."""
        self.calls += 1
        return self.case.cost(x, *self.noise)

    def value(self, x: np.ndarray) -> float:
        """Return the cost of an array as a float."""
        if self.case.library == "torch":
            import torch

            return float(self.cost(torch.tensor(x, dtype=torch.float64)))
        return float(self.cost(np.array(x)))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return the case's gradient at an array, shape (d,)."""
        if self.case.grad == "torch":
            import torch

            at = torch.tensor(x, dtype=torch.float64, requires_grad=True)
            cost = self.cost(at)
            if cost.requires_grad:
                cost.backward()
            return np.zeros(len(x)) if at.grad is None else at.grad.numpy()
        if self.case.grad == "jax":
            import jax

            return np.asarray(jax.grad(self.cost)(np.array(x)))
        self.calls += 1
        return np.array(self.case.grad(np.array(x), *self.noise), dtype=float)


def gradcheck(counted: Counted) -> bool:
    """Return whether `torch.autograd.gradcheck` complains."""
    import torch

    function = counted.cost
    if counted.case.library != "torch":

        class Wrapped(torch.autograd.Function):
            @staticmethod
            def forward(context, x):
                context.save_for_backward(x)
                return x.new_tensor(counted.value(x.detach().numpy()))

            @staticmethod
            def backward(context, slope):
                return slope * torch.as_tensor(counted.gradient(context.saved_tensors[0].detach().numpy()))

        function = Wrapped.apply
    at = torch.tensor(counted.case.theta, dtype=torch.float64, requires_grad=True)
    return not torch.autograd.gradcheck(function, (at,), raise_exception=False)


def check_grads(counted: Counted) -> bool:
    """Return whether `jax.test_util.check_grads` complains."""
    import jax
    import jax.numpy as jnp
    from jax.test_util import check_grads as check

    jax.config.update("jax_enable_x64", True)
    function = counted.cost
    if counted.case.library != "jax":

        @jax.custom_vjp
        def function(x):
            return jax.pure_callback(lambda y: np.float64(counted.value(np.asarray(y))), jnp.zeros(()), x)

        def backward(x, slope):
            return (slope * jax.pure_callback(lambda y: counted.gradient(np.asarray(y)), x, x),)

        function.defvjp(lambda x: (function(x), x), backward)
    check(function, (jnp.array(counted.case.theta, dtype=float),), order=1, modes=["rev"])
    return False


def tesseract(counted: Counted) -> bool:
    """Return whether tesseract-core's `check-gradients` complains about endpoints `apply` and `jacobian`."""
    from pydantic import BaseModel
    from tesseract_core.runtime import Array, Differentiable, Float64
    from tesseract_core.runtime.testing.finite_differences import check_gradients

    class InputSchema(BaseModel):
        theta: Differentiable[Array[(None,), Float64]]

    class OutputSchema(BaseModel):
        cost: Differentiable[Float64]

    def apply(inputs: InputSchema) -> OutputSchema:
        return OutputSchema(cost=counted.value(np.asarray(inputs.theta)))

    def jacobian(inputs: InputSchema, jac_inputs: set[str], jac_outputs: set[str]):
        return {"cost": {"theta": counted.gradient(np.asarray(inputs.theta))}}

    for function in (apply, jacobian):  # types local to this call, not names in a module
        function.__annotations__ |= {"inputs": InputSchema}
    apply.__annotations__["return"] = OutputSchema
    jacobian.__annotations__ |= {"jac_inputs": set[str], "jac_outputs": set[str]}
    module = types.ModuleType("tesseract_api")
    for part in (InputSchema, OutputSchema, apply, jacobian):
        setattr(module, part.__name__, part)
    inputs = {"theta": np.array(counted.case.theta, dtype=float)}
    return any(failures for _, failures, _ in check_gradients(module, {"inputs": inputs}, show_progress=False, seed=0))


CHECKERS: dict[str, Callable[[Counted], bool]] = {
    "gradcheck": gradcheck,
    "check_grads": check_grads,
    "tesseract": tesseract,
}


def complains(checker: str, case: simulators.Case) -> tuple[bool, int, float, str]:
    """Return whether a checker complains about a case, its calls and seconds, and the error it raised, if any."""
    counted, began, raised = Counted(case), time.perf_counter(), ""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        try:
            found = CHECKERS[checker](counted)
        except Exception as error:  # an error counts as a complaint
            found, raised = True, f"{type(error).__name__}: {error}".splitlines()[0]
    return found, counted.calls, time.perf_counter() - began, raised


def check_tapes() -> None:
    """Print whether `warp.autograd.gradcheck_tape` complains about the Warp programs of `engine_cases.py`."""
    import engine_cases
    from warp.autograd import gradcheck_tape

    for fault in ("parameter", "state", "adjoint", ""):
        tape = engine_cases.warp_rollout(fault)(engine_cases.SPRING)[2]
        began = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            passes = gradcheck_tape(tape, raise_exception=False, show_summary=False)
        took = time.perf_counter() - began
        print(f"| warp | {fault or 'right'} | {'passes' if passes else 'complains'} | {took:.2f} |")


def main(checker: str) -> None:
    """Print the table of one checker."""
    if checker == "gradcheck_tape":
        check_tapes()
        return
    sums = {True: [0, 0], False: [0, 0]}
    calls, seconds = [], 0.0
    for library, cases in simulators.CASES.items():
        for case in cases():
            found, asked, took, raised = complains(checker, case)
            is_fault = bool(case.causes or case.warned)
            sums[is_fault][0] += found
            sums[is_fault][1] += 1
            calls.append(asked)
            seconds += took
            print(
                f"| {library} | {case.name} | {'complains' if found else 'passes'} | {asked} | {took:.2f} | {raised[:90]} |"
            )
    (caught, faults), (alarms, right) = sums[True], sums[False]
    print(
        f"\n{checker}: {caught} of {faults} caught, {alarms} false alarms of {right}, "
        f"{min(calls)} to {max(calls)} calls, median {int(np.median(calls))}, {seconds:.1f} s in all"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
