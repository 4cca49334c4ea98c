"""C24: the first steps of every optimizer on costs where its published rule gives a number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import centre, plugin
from bench.model import Answer, Optimizer

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EXACT = 1e-9
SPARSE = 10_000
"""Steps with gradient 0, after which the bias corrections of Adam are 1 to 5e-5."""
LARGE = 200_000
"""Population of the methods whose figure is for an infinite one."""
GENERATIONS = 20_000
"""First generations of six points that are averaged."""

Cost = Callable[[np.ndarray], np.ndarray]


def steps(
    optimizer: Optimizer | str, start: list[float], cost: Cost, slope: Cost, count: int, seed: int = 0
) -> np.ndarray:
    """Return the thetas ``(count + 1, d)`` of an optimizer or identity string, from costs ``(B,)`` and gradients ``(d, B)`` of ``(d, B)``.

    The residual of a least-squares method is the gradient, whose derivative is the identity.
    """
    optimizer = plugin("optimizers", optimizer) if isinstance(optimizer, str) else optimizer
    random, state = np.random.default_rng([23, seed]), optimizer.start(np.array(start))
    path = [state["theta"]]
    for _ in range(count):
        points = optimizer.ask(state, random.standard_normal((len(start), optimizer.draws(len(start)))))
        wanted = optimizer.required_fields(state)
        value = cost(points) if "value" in wanted else None
        gradient = slope(points) if wanted & {"gradient", "residual"} else None
        jacobian = np.repeat(np.eye(len(start))[:, :, None], points.shape[1], axis=2) if "jacobian" in wanted else None
        state = optimizer.tell(state, points, Answer(value, gradient, gradient, jacobian))
        path.append(state["theta"])
    return np.array(path)


def parabola(x: np.ndarray) -> np.ndarray:
    """Return |x|^2 / 2."""
    return np.asarray(0.5 * (x * x).sum(axis=0))


def first(x: np.ndarray) -> np.ndarray:
    """Return the first coordinate."""
    return np.asarray(x[0])


def along(x: np.ndarray) -> np.ndarray:
    """Return the gradient of the first coordinate."""
    return np.asarray(np.concatenate([1.0 + 0.0 * x[:1], 0.0 * x[1:]]))


class Steps(Claim):
    """First steps of the optimizers."""

    name = "C24"
    lesson = "Steps of the optimizers"
    statement = (
        "Heavy-ball steps contract by the square root of the momentum; Adam's step is the rate for any gradient, and .1 / "
        "sqrt(.001) = 3.16 rates after a long silence; the elites of a fifth lie 1.40 standard deviations away; six points "
        "weighted as in CMA-ES move the mean by 1.006 step sizes."
    )
    source = (
        "Polyak 1964; Kingma, Ba 2015, section 2.1; Armijo 1966; Nocedal, Wright 2006, chapter 6; Marquardt 1963; Falconer, "
        "Mackay 1996 (selection of a fifth); Hansen 2016, arXiv 1604.00772; Williams et al. 2017; Schulman et al. 2017"
    )
    learned = "The length of a step says as much about the method as about the cost."
    labels = ("optimizer", "length of the step")

    def measure(self) -> Outcome:
        """Take the first steps on a plane, a parabola or a cubic, and compare with the rules."""
        figures = [*self._descents(), *self._searches(), *self._populations()]
        return Outcome(figures, series={figure.what: figure.measured for figure in figures})

    @staticmethod
    def _descents() -> list[Figure]:
        plain = steps("gradient_descent[rate=0.3]", [1.0], parabola, lambda x: x, 2)[:, 0]
        x = steps("momentum[rate=0.5,momentum=0.9]", [1.0], parabola, lambda x: x, 6)[:, 0]
        product = (x[3] * x[5] - x[4] ** 2) / (x[2] * x[4] - x[3] ** 2)
        adam = steps("adam[rate=0.01]", [0.0], first, along, 100)[:, 0]
        calls = iter(range(SPARSE + 1))
        late = steps("adam[rate=1.0]", [0.0], first, lambda x: 0.0 * x + (next(calls) == SPARSE), SPARSE + 1)[:, 0]
        return [
            Figure("gradient_descent: 1 - rate, per step", "0.700", plain[2] / plain[1], spread=EXACT),
            Figure("momentum: product of the roots, .9", "0.900", product, spread=EXACT),
            Figure("momentum: sum of the roots, 1 + .9 - rate", "1.400", (x[4] + 0.9 * x[2]) / x[3], spread=EXACT),
            Figure("adam: 100 steps of .01", "1.000", adam[0] - adam[100], spread=1e-5),
            Figure("adam: after a silence, in rates", "3.16", late[-2] - late[-1]),
        ]

    @staticmethod
    def _searches() -> list[Figure]:
        steep = steps("line_search", [1.0], lambda x: 100.0 * parabola(x), lambda x: 100.0 * x, 2)[:, 0]
        cubic = steps("lbfgs", [1.0], lambda x: 0.5 * x[0] ** 2 + x[0] ** 3 / 3.0, lambda x: x + x * x, 4)[:, 0]
        damped = steps("gauss_newton[damping=0.001]", [1.0], parabola, lambda x: x, 2)[:, 0]
        return [
            Figure("line_search: Armijo accepts .004", "0.600", steep[2], spread=EXACT),
            # from 1 to .9, then along the secant of the gradient x + x^2
            Figure("lbfgs: secant step", "0.3103", cubic[4], spread=EXACT),
            Figure("gauss_newton: damping / (1 + damping)", "0.000999", damped[2], spread=EXACT),
        ]

    @staticmethod
    def _populations() -> list[Figure]:
        elites = steps(f"cem[population={LARGE},elites={LARGE // 5}]", [0.0], first, along, 1)
        adapting: Optimizer = plugin("optimizers", "cma_es[population=6,width=1.0]")
        moves = np.array([-steps(adapting, [0.0, 0.0], first, along, 1, i)[1, 0] for i in range(GENERATIONS)])
        drawn = f"population={LARGE},width=1.0"
        path = steps(f"mppi[{drawn},temperature=1.0,relative=false]", [0.0], lambda x: parabola(x - 1.0), along, 1)
        policy = steps("ppo[population=2000,epochs=1,rate=0.01]", [0.0], first, along, 1)
        # standard errors of a mean of the elites (variance .2186) and of weighted samples
        return [
            Figure("cem: selection of a fifth", "1.400", -elites[1, 0], 0.0035),
            Figure("cma_es: weighted three of six", "1.006", *centre(moves)),
            Figure("mppi: half-way to the optimum", "0.500", path[1, 0], 0.002),
            Figure("ppo: a step of Adam", "0.0100", -policy[1, 0], spread=1e-6),
        ]

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the figures."""
        axes.barh([name.partition(":")[0] for name in series], list(series.values()))
