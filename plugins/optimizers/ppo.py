"""Proximal policy optimisation of an open-loop plan."""

from dataclasses import dataclass

import numpy as np

from bench.model import Answer, OptimizerState, Population, param


@dataclass(frozen=True)
class Ppo(Population):
    """PPO (Schulman et al. 2017, arXiv 1707.06347, equation 7) with a normal distribution per coordinate as policy.

    Each coordinate of a sample is an action x_i ~ N(mean_i, deviation_i^2) with its own probability ratio r_i to the
    policy that drew it. All coordinates share the rollout's advantage A: the population's mean cost minus the rollout's
    cost, in standard deviations. ``epochs`` steps of Adam ascend the mean of
    min(r_i A, clip(r_i, 1 - clip, 1 + clip) A) over means and log deviations. Since only costs are used, there is neither a value function nor credit assignment to
    single steps: this is a baseline for other methods, not a benchmark of full PPO implementations.
    """

    name = "ppo"

    width: float = param(0.3, "initial standard deviation, in units of theta", positive=True)
    rate: float = param(0.01, "step of Adam, in units of theta for means", positive=True)
    clip: float = param(0.2, "distance of a ratio from 1 at which the objective is clipped", positive=True, high=1.0)
    epochs: int = param(10, "steps of Adam per population", positive=True)
    least: float = param(1e-6, "smallest standard deviation", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state: mean theta, standard deviation ``width``, Adam's means at 0."""
        policy = np.stack([np.array(theta, dtype=np.float64), np.full(len(theta), np.log(self.width))])
        return {
            "theta": policy[0],
            "policy": policy,
            "mean": 0.0 * policy,
            "square": 0.0 * policy,
            "step": 0,
        }

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        mean, log_deviation = state["policy"]
        return mean[:, None] + np.exp(log_deviation)[:, None] * noise

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the state after ``epochs`` steps on the clipped objective; unchanged if all costs are equal.

        Points without a finite cost are ignored.
        """
        is_finite = np.isfinite(answer.value)
        cost = answer.value[is_finite]
        if not cost.size or not cost.std() > 0:
            return state
        advantage = (cost.mean() - cost) / cost.std()
        policy, mean, square, step = state["policy"], state["mean"], state["square"], state["step"]
        for _ in range(self.epochs):
            slope, step = self.slope(policy, state["policy"], theta[:, is_finite], advantage), step + 1
            mean, square = 0.9 * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
            move = mean / (1 - 0.9**step) / (np.sqrt(square / (1 - 0.999**step)) + 1e-8)
            policy = policy + self.rate * move
            policy[1] = np.maximum(policy[1], np.log(self.least))
        return {"theta": policy[0], "policy": policy, "mean": mean, "square": square, "step": step}

    def slope(self, policy: np.ndarray, old: np.ndarray, points: np.ndarray, advantage: np.ndarray) -> np.ndarray:
        """Return the derivative of the clipped objective by means and by log deviations, ``(2, d)``.

        The objective is a sum over coordinates. The policy ``old (2, d)`` drew the points ``(d, B)``, whose advantages
        are ``(B,)``.
        """
        away, before = (
            (points - mean[:, None]) / np.exp(log_deviation)[:, None] for mean, log_deviation in (policy, old)
        )
        # a ratio beyond e^20 is clipped anyway or has a negligible weight
        ratio = np.exp(np.clip((before**2 - away**2) / 2 + (old[1] - policy[1])[:, None], -20.0, 20.0))
        moving = np.where(advantage > 0, ratio < 1 + self.clip, ratio > 1 - self.clip)
        weight = moving * ratio * advantage / advantage.size
        return np.stack([(weight * away).sum(axis=1) / np.exp(policy[1]), (weight * (away**2 - 1)).sum(axis=1)])
