"""The contract of a trainer, which improves a neural policy on the environment of a policy problem."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from bench.errors import Unsupported
from bench.host.parameters import Plugin, param

TrainerState = Any
"""The complete state of a trainer between two updates: a tree of arrays that can be pickled."""
UpdateLog = Mapping[str, Any]
"""Numbers that describe one update, by name; :data:`LOGGED` has those that are stored."""
LOGGED: Mapping[str, str] = {
    "loss": "objective that the actor's step decreases, before the step",
    "reward": "mean reward of a control step in the update's rollouts",
    "value_loss": "mean squared error of the critic after its steps",
    "gradient_norm": "norm of the actor's gradient before clipping",
    "gradient_largest": "largest absolute entry of the actor's gradient before clipping",
    "cut": "share of rollouts in which an episode ended, or the gradient was cut, before the window's end",
    "used": "share of the rollouts' control steps that the update uses, for trainers that ignore those after an episode's end",
    "contacts": "mean number of closed contacts after a control step",
    "penetration": "largest penetration after a control step [m]",
    "contact_force": "largest contact force after a control step [N]; NaN for a law without forces",
    "step_length": "norm of the change of the actor's parameters",
    "parameter_largest": "largest absolute parameter of the actor",
    "deviation": "mean standard deviation of the actions",
}
"""The quantities of the training log, with their meanings. A trainer leaves out those that it does not have."""


@dataclass(frozen=True)
class Trainer(Plugin):
    """Trains a policy by pure functions of its state, so that a run can stop between two updates and go on elsewhere.

    ``env`` is a ``bench.training.Environment``. :meth:`start`, :meth:`update` and :meth:`action` are traced by JAX.
    Random numbers come from keys in the state, so the same seed gives the same run on one machine.
    """

    kind: ClassVar[str] = "trainers"
    requires: ClassVar[tuple[str, ...]] = ("jax", "equinox", "optax")
    first_order: ClassVar[bool] = False
    """Whether updates use the derivative of the simulation. Its state then has the field ``actor``, see :meth:`parts`."""

    steps: int = param(1_024_000, "control steps of a whole run, over all rollouts", "steps", positive=True)

    def updates(self, env: Any) -> int:
        """Return the number of updates of a whole run, at least 1."""
        return max(1, round(self.steps / self.steps_per_update(env)))

    @abstractmethod
    def steps_per_update(self, env: Any) -> int:
        """Return the control steps of one update, over all rollouts."""

    @abstractmethod
    def start(self, env: Any, seed: Any) -> TrainerState:
        """Return the state before the first update; ``seed`` is an integer."""

    @abstractmethod
    def update(self, env: Any, state: TrainerState) -> tuple[TrainerState, UpdateLog]:
        """Return the state after one update, and its log."""

    @abstractmethod
    def action(self, env: Any, state: TrainerState, observation: Any) -> Any:
        """Return the deterministic policy's actions ``(n_u, B)`` for observations ``(n_observations, B)``."""

    def fresh(self, env: Any, state: TrainerState, key: Any) -> TrainerState:
        """Return the state with all episodes at new starts; by default ``state``."""
        return state

    def parts(self, env: Any, state: TrainerState, actor: Any, key: Any) -> tuple[Any, Any, Any]:
        """Return, for another actor, each step's share of the objective, and what a comparison of gradients needs.

        Three arrays ``(h, B)``: the gain of each step, whose sum over a rollout is its return; whether the gradient is
        cut after the step; and the log probability of its action under ``actor``, as a function of ``actor`` only.
        Needed only if the trainer is :attr:`first_order`. That of a trainer with a field ``window`` also takes ``every=0``:
        a number of steps after each of which the gradient is cut and the critic's value is added, as at a window's end.
        """
        raise Unsupported(f"trainer {self.name} takes no first-order steps")
