"""The stability map: where a gradient is right, wrong or lost, over step size and stiffness.

Each cell simulates one rollout without noise and compares its gradient with the truth for the same duration. The truth
is the scene's physical gradient or, where it has none, the gradient of the same program at a much finer step. No
estimator is used: the gradient is the backend's at w = 0. Where the motion is linear, the growth of the state is
measured too, which detects instabilities that are too slow to show within the rollout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.columns import COMMON, Column, Columns, ComparisonRule, exact, numbers, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Chart, Style, Table, Views
from bench.model import (
    ContactScene,
    DampedScene,
    Dynamics,
    ForceLaw,
    Integrator,
    LoopOps,
    Oscillator,
    Rollout,
    Trajectory,
    Unsupported,
    param,
    rollout,
)

from . import StudyPackage, norm, spectral_radius

if TYPE_CHECKING:
    import pandas as pd

NEUTRAL = 1 + 1e-9
"""Spectral radius, theoretical or measured, up to which a step counts as stable: 1 plus rounding."""
STIFFNESSES = np.logspace(-3, 4, 141)
"""Values of dt^2 stiffness that the search for the stability limit tries."""
GRADES = {1e-3: "#08519c", 1e-2: "#6baed6", 1e-1: "#d6e6f4", 1.0: "#fdae61", math.inf: "#c51b1b"}
"""Upper ends of the grades of a relative error, and their colours."""
OTHER = {
    "near 0": Style("#ffe873", meaning="the gradient is near 0: not judged"),
    "blows up": Style("#333333", meaning="blows up: the state or the gradient is not finite, or leaves its scale"),
    "grew": Style("#a6a6a6", meaning="grew: a state that cannot grow does, slowly"),
    "open": Style("#f2f2f2", meaning="open: the truth is not resolved"),
}
"""Looks of the cells that are neither right nor wrong."""
CAUSES = ("step", "law", "both", "unknown")
GROWN = "has grown by"
RESULTS = (
    "verdict",
    "cause",
    "relative_error",
    "cosine",
    "spectral_radius",
    "stiffness_limit",
    "first_bad_step",
    "truth",
)
SHARES = (
    text("scene"),
    text("step", label="law and integrator"),
    setting("cells"),
    *(Column(name, format="percent") for name in ("right", "wrong", *OTHER)),
    *(Column(f"by {cause}", label=f"wrong by {cause}", format="percent") for cause in CAUSES),
)
SHARE_NOTES = (
    "Right: an error below the study's limit, as a share of the cell's own gradient. Near 0: not right, but "
    "gradient and error are below that share of the scene's largest gradient: it passes through 0, where a share of it says little. Blows up: "
    "the state or the gradient is not finite, or leaves its scale. Grew: a state that cannot grow does, slowly. Wrong by step: the step or "
    "its derivative is wrong and the law is right. By law: wrong at any step. By both, by unknown: the cause is not resolved. Shares are of "
    "the cells.",
)


@dataclass(frozen=True)
class Stability(StudyPackage):
    """Measures where a program's gradient is right, inaccurate, of wrong sign, zero or lost, one rollout per cell."""

    name = "stability"
    columns = Columns.of(
        Column("first_bad_step", "first step at which the state diverged or was not finite"),
        Column("growth_factor", "measured growth of the state per step, where the motion is linear"),
        Column("spectral_radius", "of one step on the cell's oscillator, in theory"),
        Column("stiffness_limit", "stiffness at which that radius leaves 1", "N/m"),
        exact("relative_error", "norm of (gradient - truth) / norm of the truth", "error"),
        Column("cosine", "cosine between gradient and truth"),
        Column("grad_norm", "norm of the gradient"),
        Column("truth_norm", "norm of the truth"),
        Column("truth_error", "relative change of the truth on its last refinement"),
        text(
            "verdict",
            "ok, or what is wrong",
            comparison=ComparisonRule(
                "verdict",
                "verdict",
                order=("nonfinite", "diverged", "wrong_sign", "zero", "inaccurate", "unresolved", "ok"),
            ),
        ),
        text("truth", "how the truth was computed: physical or refined"),
        text("cause", "of a finite but wrong gradient: step (or how it is differentiated), law, both or unknown"),
        Column(
            "step_error",
            "distance from the law's own gradient, which is differences of its cost at a far finer step, / norm of the truth",
        ),
        Column("law_error", "distance of the law's own gradient from the truth / norm of the truth"),
        numbers("state_at_first_bad_step", "the state at the first bad step"),
    )

    diverged: float = param(
        10.0, "multiple of the initial scale beyond which a state component has diverged", positive=True
    )
    grown: float = param(
        1.1, "growth over the rollout of a state that cannot grow, from which it has diverged", low=1.0
    )
    inaccurate: float = param(0.1, "relative error of the gradient above which it is wrong", positive=True)
    fine_steps: int = param(
        1 << 14, "fewest steps of the refined truth; half as many say how far it has converged", low=2
    )
    finer: int = param(4, "fewest steps of the refined truth to one of the cell's", positive=True)

    @np.errstate(over="ignore", invalid="ignore")  # what overflows becomes a status
    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column, verdict included.

        Raises :class:`Unsupported` if the program has no time steps, step states or truth.
        """
        program = rollout(cell.program())
        problem, scene = session.problem(cell), program.scene
        theta, still = program.theta0, np.zeros((problem.program.n_noise, 1))
        gradient = problem.grad()
        trajectory = problem.trajectory(theta, still)
        states, largest = trajectory.states[:, :, 0], bounds(program, trajectory, self.diverged)
        growth = growth_factor(states) if isinstance(scene, Oscillator) else math.nan
        result = {"status": "ok", "grad_norm": norm(gradient), "growth_factor": growth, **theory(cell)}
        failure = first_bad_step(states, largest, growth, self)
        if failure is not None:
            step, verdict, description = failure
            reason = f"state at step {step} of {scene.horizon} {description}"
            bad = {"first_bad_step": step, "state_at_first_bad_step": states[step].tolist()}
            return result | bad | {"status": verdict, "verdict": verdict, "reason": reason}
        if not np.isfinite(gradient).all():
            reason = "the gradient of a finite rollout"
            return result | {"status": "nonfinite", "verdict": "nonfinite", "reason": reason}
        kind, truth, error = compute_truth(cell, self)
        result |= {"truth": kind, "truth_norm": norm(truth), "truth_error": error}
        resolved = self.inaccurate / 2
        if not error <= resolved:
            reason = f"halving the finest step moves the truth by {error:.1%}, more than {resolved:.0%}"
            return result | {"verdict": "unresolved", "reason": reason}
        result |= compare(gradient, truth, self.inaccurate)
        return result if result["verdict"] == "ok" else result | cause_of(cell, kind, gradient, truth, self)

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views | None:
        """Return the tables of shares and of cells, and the map; None without any."""
        from bench.experiment.axes import table
        from bench.report.views import arrange

        cells = cells_of(experiment, rows)
        if cells.empty:
            return None
        found = cells[["error_share", "level"]].reindex(rows.index)
        whole = Table("stability_map", table(experiment, rows).assign(**found))
        shares = Table(
            "stability_shares",
            shares_of(cells),
            SHARES,
            "How often each contact law and step gives the right gradient",
            SHARE_NOTES,
            terminal=True,
            page=True,
        )
        columns = [experiment.columns.by_name[name] for name in RESULTS]
        return Views([shares, whole], charts(cells, self.inaccurate), arrange(experiment, rows).rows, columns)


# ---------------------------------------------------------------------------------------------- trajectories


def first_bad_step(
    states: np.ndarray, largest: np.ndarray, growth: float, limits: Stability
) -> tuple[int, str, str] | None:
    """Return the first bad step of ``states (T + 1, n)`` with its verdict and a description, or None without a bad step.

    A step is bad if a component exceeds its ``largest`` value ``(n,)``, or if growth by the factor ``growth`` per step
    has reached ``limits.grown``. The verdict is ``diverged`` or ``nonfinite``.
    """
    steps = len(states)
    outside = ~(np.abs(states) <= largest).all(axis=1)
    left = int(np.argmax([*outside, True]))
    slow = math.ceil(math.log(limits.grown) / math.log(growth)) if growth > NEUTRAL else steps
    step = min(left, slow)
    if step >= steps:
        return None
    if not np.isfinite(states[step]).all():
        return step, "nonfinite", "is not finite"
    if slow < left:
        return step, "diverged", f"{GROWN} {limits.grown - 1:.0%}, {growth - 1:.2g} a step"
    beyond = limits.diverged * float((np.abs(states[step]) / largest).max())
    return step, "diverged", f"is {beyond:.3g} times the initial scale"


def growth_factor(states: np.ndarray) -> float:
    """Return the growth factor per step of ``states (T + 1, n)`` with linear dynamics; NaN for fewer than three states.

    It is the spectral radius of the linear map fitted by least squares to all pairs of consecutive states, each pair
    scaled to the size of its first state (dynamic mode decomposition; Schmid 2010).
    """
    count = int(np.argmin([*np.isfinite(states).all(axis=1), False]))
    if count < 3:
        return math.nan
    scaled = states[:count] / np.maximum(np.abs(states[:count]).max(axis=0), np.finfo(float).tiny)
    size = np.linalg.norm(scaled[:-1], axis=1, keepdims=True)
    moving = size[:, 0] > 0
    before, after = (part[moving] / size[moving] for part in (scaled[:-1], scaled[1:]))
    linear_map = np.linalg.lstsq(before, after, rcond=None)[0]
    return float(np.abs(np.linalg.eigvals(linear_map)).max())


def bounds(program: Rollout, trajectory: Trajectory, factor: float) -> np.ndarray:
    """Return the largest allowed value of each state component, ``(n,)``: ``factor`` times its initial scale.

    The scale of positions is the distance |q_0| + T |v_0|, where T is the duration. The scale of velocities is |v_0| +
    sqrt(|a_0| distance), the speed after accelerating over that distance. Norms are maximum norms, and a scale of 0
    counts as 1.
    """
    scene = program.scene
    q, v = np.split(trajectory.states[0], [scene.n_q])
    u = trajectory.controls[0]
    a = Dynamics(LoopOps(), scene, program.contact).acceleration(q, v, u)
    speed = float(np.abs(v).max(initial=0.0))
    length = float(np.abs(q).max(initial=0.0)) + scene.horizon * scene.dt * speed
    scales = [length or 1.0, speed + math.sqrt(float(np.abs(a).max(initial=0.0)) * length) or 1.0]
    return factor * np.repeat(scales, [len(q), len(v)])


# ---------------------------------------------------------------------------------------------------- truth


def compute_truth(cell: Cell, limits: Stability) -> tuple[str, np.ndarray, float]:
    """Return the kind of truth (``physical`` or ``refined``), the true gradient ``(d,)``, and its relative error."""
    program = rollout(cell.program())
    physical = program.physical_gradient()
    if physical is not None:
        return "physical", np.asarray(physical), 0.0
    fine, coarse = finest(cell, limits)
    change = norm(fine - coarse)
    return "refined", fine, change / norm(fine) if change else 0.0


def finest(cell: Cell, limits: Stability, span: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient ``(d,)`` at a far smaller step, and that with half as many steps; with a span, of the cell's law.

    The law's own gradients are central differences of the cost over the span (twice that for the second). A derivative
    through a contact would not converge: it jumps with the time of the impact within its step, however small the step is.
    """
    steps = max(limits.fine_steps, limits.finer * rollout(cell.program()).scene.horizon)
    return _gradient_at(cell, steps, span), _gradient_at(cell, steps // 2, 2 * span)


def _refined(cell: Cell, steps: int) -> Cell:
    """Return the cell with its duration divided into ``steps`` steps and the same numerical damping per second.

    Raises :class:`Unsupported` if the dimension of theta depends on the horizon.
    """
    program = rollout(cell.program())
    scene = program.scene
    dt = scene.horizon * scene.dt / steps
    values: dict[str, Any] = {"horizon": steps, "dt": dt}
    if isinstance(scene, DampedScene):
        values["velocity_factor"] = scene.velocity_factor ** (dt / scene.dt)
    fine = cell.with_part("scene", replace(scene, **values))
    if not cell.decision.names and fine.scene.theta0().size != program.dim:
        raise Unsupported(
            f"theta of scene {scene.name} depends on the horizon, so a finer step has no comparable gradient"
        )
    return fine


def _gradient_at(cell: Cell, steps: int, span: float) -> np.ndarray:
    """Return the cell's gradient ``(d,)`` with its duration divided into ``steps`` steps; with a span, central differences.

    Gradients are shared by all cells with the same fine program.
    """
    fine = _refined(cell, steps)
    key = fine.program_key, span
    if key not in _fine_gradients:
        problem = fine.reference_backends[0].compile(fine.program())
        theta, still = problem.program.theta0, np.zeros((problem.program.n_noise, 1))
        if span:
            h = span * (float(np.abs(theta).max(initial=0.0)) or 1.0)
            costs = [[problem.value(theta + s * e, still)[0] for s in (1, -1)] for e in h * np.eye(len(theta))]
            _fine_gradients[key] = np.array([(after - before) / (2 * h) for after, before in costs])
        else:
            _fine_gradients[key] = problem.grad()
    return _fine_gradients[key]


_fine_gradients: dict[tuple[str, float], np.ndarray] = {}


def compare(gradient: np.ndarray, truth: np.ndarray, inaccurate: float) -> dict[str, Any]:
    """Return verdict, relative error and cosine of a finite gradient.

    The verdict is the first that applies. ``zero``: a component is exactly 0 where the truth's is not. ``wrong_sign``:
    the directional derivative along the truth is negative. ``inaccurate``: the relative error exceeds that limit.
    ``ok``: otherwise.
    """
    length, size, distance = norm(truth), norm(gradient), norm(gradient - truth)
    error = distance / length if length else math.inf if distance else 0.0
    cosine = float(gradient / size @ (truth / length)) if length and size else math.nan
    # a component of the truth below this share of its norm counts as 0
    is_zero = ((gradient == 0) & (np.abs(truth) > 1e-9 * length)).any()
    verdict = "zero" if is_zero else "wrong_sign" if cosine < 0 else "ok" if error <= inaccurate else "inaccurate"
    return {"verdict": verdict, "relative_error": error, "cosine": cosine}


# ---------------------------------------------------------------------------------------------------- cause


def cause_of(cell: Cell, truth_kind: str, gradient: np.ndarray, truth: np.ndarray, limits: Stability) -> dict[str, Any]:
    """Return why a gradient is wrong: ``cause``, and ``step_error`` and ``law_error`` in units of the truth's norm.

    The law's own gradient is the gradient of the same law and integrator at a far smaller step. The step error is the
    distance of the cell's gradient from the law's own, and the law error is the distance of the law's own gradient from
    the truth. Their sum is at least the cell's error, so one of them is a cause. Without a contact law, or with a
    refined truth, the cause is the step.
    """
    size = norm(truth)
    if truth_kind != "physical" or cell.contact is None:
        error = norm(gradient - truth) / size if size else math.inf
        return {"cause": "step", "step_error": error, "law_error": 0.0}
    if not size:
        return {"cause": "unknown"}
    # step in theta for central differences of the law's own cost, in units of theta's largest component (1 if that is
    # 0). It is large enough to shift an impact by many fine steps, which averages out the effect of the impact's time
    # within a step
    fine, coarse = finest(cell, limits, 0.01)
    step, law, change = (norm(part) / size for part in (gradient - fine, fine - truth, fine - coarse))
    errors = {"step_error": step, "law_error": law}
    if not change <= limits.inaccurate / 2:
        return {"cause": "unknown"} | errors
    causes = [name for name, error in (("step", step), ("law", law)) if error > limits.inaccurate]
    return {"cause": "both" if len(causes) == 2 else causes[0] if causes else "step" if step >= law else "law"} | errors


# --------------------------------------------------------------------------------------------------- theory


def theory(cell: Cell) -> dict[str, float]:
    """Return ``spectral_radius`` of one step on the cell's oscillator, and ``stiffness_limit``, where it exceeds 1.

    The limit has the unit of the column ``stiffness``. It is 0 for a step that is never stable, and infinite for one
    that always is. The result is empty without an oscillator.
    """
    parameters = oscillator(cell)
    if parameters is None:
        return {}
    assert cell.integrator is not None
    stiffness, damping, factor = parameters
    dt = rollout(cell.program()).scene.dt
    limit = stiffness_limit(cell.integrator, dt, damping, factor)
    radius = spectral_radius(cell.integrator, dt, stiffness, damping, factor)
    return {"spectral_radius": radius, "stiffness_limit": limit * cell.columns()["stiffness"] / stiffness}


def oscillator(cell: Cell) -> tuple[float, float, float] | None:
    """Return the cell's oscillator: stiffness [1/s^2] and damping [1/s] per unit of mass, and velocity factor; or None.

    It is the scene's own ``oscillator()``, or else the scene in contact, if it has one contact with a spring law.
    """
    scene, law = cell.scene, cell.contact
    if isinstance(scene, Oscillator):
        return scene.oscillator()
    if not isinstance(scene, ContactScene) or not isinstance(law, ForceLaw) or scene.n_contacts != 1:
        return None
    start = scene.initial_state(np, scene.theta0()[:, None])
    response = float(scene.gap_rate(np, start.q, scene.contact_acceleration(np, start.q, np.ones((1, 1))))[0, 0])
    spring = law.spring()
    factor = scene.velocity_factor if isinstance(scene, DampedScene) else 1.0
    return None if spring is None else (spring[0] * response, spring[1] * response, factor)


def stiffness_limit(integrator: Integrator, dt: float, damping: float, factor: float) -> float:
    """Return the stiffness [1/s^2] where the step becomes unstable; 0 if always, inf if nowhere in :data:`STIFFNESSES`."""

    from scipy.optimize import brentq

    def excess(reach: float) -> float:
        return spectral_radius(integrator, dt, reach / dt**2, damping, factor) - NEUTRAL

    first = next((i for i, scaled in enumerate(STIFFNESSES) if excess(scaled) > 0), None)
    if first is None:
        return math.inf
    return float(brentq(excess, *STIFFNESSES[first - 1 : first + 1])) / dt**2 if first else 0.0


# ------------------------------------------------------------------------------------------------- what is shown


def cells_of(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the cells with a verdict, with their stored step size and stiffness, names, colour and mark."""
    from bench.experiment.parameters import PROBLEM
    from bench.report.problems import axes_of, problem_names, titled
    from bench.report.views import arrange, attempted

    shown = arrange(experiment, rows)
    # labels keep apart what differs in another stiffness, such as the scene's own
    shown = replace(shown, rows=shown.rows.assign(dt=rows["dt"], stiffness=rows["stiffness"]))
    cells = attempted(shown.rows)
    cells = cells[cells["verdict"] != ""]
    scene, limits = rows.loc[cells.index, "scene"], cast(Stability, experiment.study)
    size = cells["truth_norm"].groupby(scene).transform("max")
    error = cells["relative_error"] * cells["truth_norm"] / size
    is_lost = cells["verdict"].isin(("diverged", "nonfinite"))
    grew = cells["reason"].str.contains(GROWN) & (cells["grad_norm"] <= limits.diverged * size)
    kinds = {
        "grew": is_lost & grew,
        "blows up": is_lost,
        "open": error.isna(),
        "right": cells["relative_error"] <= limits.inaccurate,
        "near 0": np.maximum(error, cells["truth_norm"] / size) <= limits.inaccurate,
    }
    level = np.select([*kinds.values()], [*kinds], "wrong")
    over = axes_of(shown, "dt", "stiffness")
    return cells.assign(
        problem=problem_names(shown, PROBLEM, over, rows=cells),
        variant=titled(cells, [axis.column for axis in shown.axes if axis not in over]),
        row=cells.index,
        error_share=error,
        level=level,
        step=titled(cells, ["contact", "integrator"]),
        scene_name=scene.str.split("[").str[0],
        dt_ms=1e3 * cells["dt"],
    )


def shares_of(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the share of each colour and cause by scene, contact law and integrator, the best of each scene first."""
    import pandas as pd

    cause = cells["cause"].where(cells["cause"].isin(CAUSES), "unknown").where(cells["level"] == "wrong", "")
    groups = [cells["scene_name"].rename("scene"), cells["step"]]
    level, why = (pd.crosstab(groups, values, normalize="index") for values in (cells["level"], "by " + cause))
    counts = cells.groupby(groups, sort=False).size().rename("cells")
    shares = pd.concat([counts, level, why], axis=1).loc[counts.index]
    shares = shares.reindex(columns=[column.name for column in SHARES[2:]], fill_value=0.0).reset_index()
    order = np.lexsort((-shares["right"], pd.factorize(shares["scene"])[0]))
    return shares.iloc[order].reset_index(drop=True)


def charts(cells: pd.DataFrame, limit: float) -> list[Chart]:
    """Return a map per scene, of the first variant of each law and integrator; of several laws, each with its best integrator."""
    from bench.report.colours import graded
    from bench.report.names import short_names
    from bench.report.text import number, rounded

    every = sorted(cells["stiffness"].dropna().unique()) or [math.nan]
    # a law without stiffness is the same at each one
    frame = cells.assign(stiffness=[[k] if k == k else every for k in cells["stiffness"]])
    frame = frame.explode("stiffness", ignore_index=True).astype({"stiffness": float})
    worst = frame["relative_error"].fillna(math.inf).where(frame["level"] != "open", -1.0)
    frame = frame.iloc[worst.argsort(kind="stable")[::-1]].drop_duplicates(["problem", "dt", "stiffness"]).sort_index()
    frame = frame[frame["problem"] == frame.groupby("step", sort=False)["problem"].transform("first")]
    grades, looks = graded(
        frame["relative_error"].map(rounded), GRADES, "error {}".format, lambda end: f"{100 * end:g}%"
    )
    frame["grade"] = frame["level"].where(frame["level"].isin(OTHER), grades)
    frame["cell"] = [
        "" if e != e else (f"<{100 * min(GRADES):g}" if e < min(GRADES) else number(100 * e) if e < 10 else ">999")
        for e in frame["relative_error"]
    ]
    near = f"Near 0: gradient and error are below {100 * limit:g}% of the scene's largest gradient. "
    found: list[Chart] = []
    for scene, part in frame.groupby("scene_name", sort=False):
        panel, note = "integrator", "Beside the limit a small error may be a coincidence of the phase"
        if part["contact"].nunique() > 1:
            panel, note = "step", "Each contact law is drawn with the integrator that is most often right"
            right = (part["level"] == "right").groupby(part["step"]).transform("mean")
            best = part.loc[right.sort_values(ascending=False, kind="stable").index].drop_duplicates("contact")
            part = part[part["step"].isin(best["step"])]
        (name,) = short_names([f"{scene}, {part['variant'].max()}"], is_whole=True).values()
        found.append(
            Chart(
                f"stability_map_{scene}" if found else "stability_map",
                part,
                [Column("dt_ms", "", "ms", label="time step")],
                [COMMON["stiffness"]],
                "grid",
                level="grade",
                styles=looks | OTHER,
                panel=panel,
                cell="cell",
                limit="stiffness_limit",
                limit_name="stability limit of the step in theory",
                panel_notes=dict.fromkeys(cells["step"][cells["stiffness"].isna()], "the same at any stiffness"),
                subtitle=f"{name}. Number: error of the gradient, in % of the true one. {near * ('near 0' in {*part['level']})}"
                f"The worst of all backends. {note}",
            )
        )
    return found
