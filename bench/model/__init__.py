"""The contracts that plugins implement and use: everything that plugin authors import.

A plugin is a frozen dataclass. Its fields are its parameters, declared with :func:`param` (default, meaning, unit,
bounds). Its class variables declare its properties, which the conformance kit verifies.

Arrays are component-first and batch-last: generalised positions ``q (n_q, B)``, velocities ``v (n_v, B)``, controls
``(n_u, B)``, ``theta (d, B)``, noise ``w (n_w, B)``, costs ``(B,)``. Scenes, contact laws and integrators are written
once and use the array namespace ``ops.xp`` of the backend that runs them. A parameter annotated ``float`` may be a
traced value, so Python code must not branch on it. All other types are static.
"""

from bench.errors import Unsupported, UserError, unknown
from bench.host import registry
from bench.host.parameters import Plugin, param
from bench.model import adjoint
from bench.model.adjoint import Slopes, by_actions, by_theta, slopes, slopes_along
from bench.model.adjoint import gradient as adjoint_gradient
from bench.model.backend import Backend
from bench.model.blocks import central_differences, cores
from bench.model.callables import CallableScene
from bench.model.contact import Contact, ContactLaw, ForceLaw, ImpulseLaw
from bench.model.design import IID, Design, per_unit, sums_of_units
from bench.model.dynamics import Dynamics
from bench.model.estimator import (
    Auxiliaries,
    DiagnosticEstimator,
    Estimator,
    SampleMean,
    Smoothing,
    against_others,
    best_gradient,
    columns,
    first_order,
    halves,
    less_others,
    mean_difference,
    per_repeat,
    zeroth_order,
)
from bench.model.events import events_of, undeclared_jumps
from bench.model.integrator import Integrator
from bench.model.known_solutions import Identified, KnownOptimum, KnownValue
from bench.model.manifold import JointScene, difference, n_changes, retract, slope_by_changes
from bench.model.ops import Array, LoopOps, Ops, State, stopped
from bench.model.optimizer import Answer, Descent, Optimizer, OptimizerState, Population
from bench.model.policy import Policy, PolicyScene, affine, uniform
from bench.model.problem import Compilations, Executable, Jacobians, Problem, Trajectory
from bench.model.program import (
    SURROGATE,
    CallableProgram,
    Decision,
    Program,
    Rollout,
    compose,
    rollout,
)
from bench.model.scene import (
    ContactScene,
    DampedScene,
    EngineScene,
    EngineTwin,
    Events,
    EventScene,
    FrictionScene,
    FunctionScene,
    MechanicalScene,
    OpenLoopScene,
    Oscillator,
    Scene,
    ZeroOrderHoldScene,
    half_spaces,
)
from bench.model.stepped import Replayed, SteppedProblem
from bench.model.trainer import Trainer
from bench.simulator import load_module, load_simulator, simulator_files

__all__ = [
    "IID",
    "SURROGATE",
    "Answer",
    "Array",
    "Auxiliaries",
    "Backend",
    "CallableProgram",
    "CallableScene",
    "Compilations",
    "Contact",
    "ContactLaw",
    "ContactScene",
    "DampedScene",
    "Decision",
    "Descent",
    "Design",
    "DiagnosticEstimator",
    "Dynamics",
    "EngineScene",
    "EngineTwin",
    "Estimator",
    "EventScene",
    "Events",
    "Executable",
    "ForceLaw",
    "FrictionScene",
    "FunctionScene",
    "Identified",
    "ImpulseLaw",
    "Integrator",
    "Jacobians",
    "JointScene",
    "KnownOptimum",
    "KnownValue",
    "LoopOps",
    "MechanicalScene",
    "OpenLoopScene",
    "Ops",
    "Optimizer",
    "OptimizerState",
    "Oscillator",
    "Plugin",
    "Policy",
    "PolicyScene",
    "Population",
    "Problem",
    "Program",
    "Replayed",
    "Rollout",
    "SampleMean",
    "Scene",
    "Slopes",
    "Smoothing",
    "State",
    "SteppedProblem",
    "Trainer",
    "Trajectory",
    "Unsupported",
    "UserError",
    "ZeroOrderHoldScene",
    "adjoint",
    "adjoint_gradient",
    "affine",
    "against_others",
    "best_gradient",
    "by_actions",
    "by_theta",
    "central_differences",
    "columns",
    "compose",
    "cores",
    "difference",
    "events_of",
    "first_order",
    "half_spaces",
    "halves",
    "less_others",
    "load_module",
    "load_simulator",
    "mean_difference",
    "n_changes",
    "param",
    "per_repeat",
    "per_unit",
    "registry",
    "retract",
    "rollout",
    "simulator_files",
    "slope_by_changes",
    "slopes",
    "slopes_along",
    "stopped",
    "sums_of_units",
    "undeclared_jumps",
    "uniform",
    "unknown",
    "zeroth_order",
]
