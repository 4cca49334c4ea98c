"""C20: switching between orders, or weighting them by their variances: where does each have the smaller error?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import STANDARD_ERRORS, Claim, Figure, Outcome
from bench.claims.colours import GREY
from bench.claims.published.ball_with_wall import BallWithWall
from bench.claims.published.pivot import Pivot
from bench.claims.toolkit import estimator, problem
from bench.measure.reference import certify

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REPEATS, SAMPLES = 200, 128
RATIOS = (1.05, 1.5, 3.0, 30.0)
"""Settings of the switch, from hardly ever first order to nearly always."""
SWITCH = "alpha_order[sharing=shared,ratio={!r}]"


class Switching(Claim):
    """A test that switches estimators against inverse-variance weights."""

    name = "C20"
    lesson = "Which variance is smaller"
    statement = (
        "While estimator switching improves robustness in controlled studies, careful variance control often dominates in "
        "practical deployments."
    )
    source = "Onoda et al. 2026, arXiv 2604.18161, abstract"
    learned = (
        "A test for bias pays at a jump in one variable; on rollouts the orders' variances decide, and are best weighted "
        "action by action."
    )
    labels = ("relative RMSE of switching, best setting", "relative RMSE of the weights")
    quick = False

    def measure(self) -> Outcome:
        """Compare mean squared errors on the same noise, on three jumps and on four rollouts."""
        jumps = {
            "unit step": problem("heaviside[theta=0.05]"),
            "pivot": problem(Pivot(sigma=0.02, start=0.76)),
            "ball and wall": problem(BallWithWall(sigma=0.1, start=0.7)),
        }
        rollouts = {
            "stiff push": problem("pushing[sigma=0.1]", "penalty[stiffness=1e5]"),
            "soft push": problem("pushing[sigma=0.1]", "penalty[stiffness=1e3]"),
            "cart-pole": problem("cartpole[sigma=1.0]"),
            "pendulum": problem("pendulum"),
        }
        safer = [_errors(at, "total_propagation") for at in jumps.values()]
        better = [_errors(at, "total_propagation[per=action]") for at in rollouts.values()]
        figures = [
            # the source's words are "improves" and "often": more than half
            Figure("share of 3 jumps at which switching is better", "1.0", _share(safer, _default_wins), spread=0.45),
            Figure(
                "share of 4 rollouts on which weighting is better", "1.0", _share(better, _weighting_wins), spread=0.45
            ),
            Figure(
                "share on which it is at least as good as the best switch",
                "1.0",
                _share(better, _is_not_worse),
                spread=0.45,
            ),
        ]
        stiff = better[0]
        return Outcome(
            figures,
            reservation=(
                "the abstract gives no numbers and names tasks of locomotion with a learned critic; here gradients of smaller "
                "rollouts are compared, and alpha-order stands for the switch, since their own test is not in the abstract. "
                f"The margin is large on the stiff contact alone, {stiff.best:.2g} against {stiff.weighted:.2g}; on the "
                "others the best switch is the variances' weights, within a few percent"
            ),
            series={
                "name": [*jumps, *rollouts],
                "best": [errors.best for errors in (*safer, *better)],
                "weighted": [errors.weighted for errors in (*safer, *better)],
                "errors": [errors.errors for errors in (*safer, *better)],
            },
        )

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw one error against the other: below the line weighting is better."""
        jumps = 3
        axes.set(xscale="log", yscale="log")
        across, up = 1.96 * np.array(series["errors"]).T
        for part, mark, label in ((slice(0, jumps), "o", "jumps"), (slice(jumps, None), "s", "rollouts")):
            x, y = series["best"][part], series["weighted"][part]
            axes.errorbar(x, y, xerr=across[part], yerr=up[part], fmt=mark, capsize=2, elinewidth=0.8, label=label)
        ends = [0.5 * min(series["best"] + series["weighted"]), 2.0 * max(series["best"] + series["weighted"])]
        axes.plot(ends, ends, color=GREY, linewidth=0.6, label="the same error")


class _Errors:
    """Relative errors of the weighted estimator and of each switch on one problem, and the difference to the best switch."""

    def __init__(self, truth: np.ndarray, weighted: np.ndarray, switches: list[np.ndarray]) -> None:
        squares = [((values - truth) ** 2).sum(axis=1) for values in (weighted, *switches)]
        size = float(np.linalg.norm(truth))
        roots = [float(np.sqrt(square.mean())) / size for square in squares]
        self.weighted, self.switches = roots[0], roots[1:]
        self.best = min(self.switches)
        place = 1 + self.switches.index(self.best)
        # delta method: the error of a root is the error of its square divided by twice the root
        self.errors = [
            float(squares[i].std(ddof=1) / np.sqrt(len(squares[i])) / (2 * size**2 * roots[i])) for i in (place, 0)
        ]
        difference = squares[0] - squares[place]
        self.difference = float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference)))


def _errors(at: Any, weighting: str) -> _Errors:
    truth = certify(at, frozenset({"value", "grad", "score"}), 1 << 15, 0.01).gradient
    noise = np.random.default_rng(20).standard_normal((REPEATS, SAMPLES, at.program.n_noise))
    weighted, *switches = (
        estimator(name).estimate(at, at.program.theta0, noise) for name in (weighting, *map(SWITCH.format, RATIOS))
    )
    return _Errors(truth, weighted, switches)


def _share(problems: list[_Errors], question: Any) -> float:
    return float(np.mean([question(errors) for errors in problems]))


def _default_wins(errors: _Errors) -> bool:
    return errors.switches[RATIOS.index(1.5)] < errors.weighted


def _weighting_wins(errors: _Errors) -> bool:
    return errors.weighted < errors.switches[RATIOS.index(1.5)]


def _is_not_worse(errors: _Errors) -> bool:
    """Return whether weighting is not worse than the best switch beyond the errors of the paired difference."""
    mean, error = errors.difference
    return mean <= STANDARD_ERRORS * error
