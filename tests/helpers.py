"""Result rows for tests of reports, without a run: of real cells, or made up from columns."""

import itertools
import json
import math
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bench.plugins.studies.bias_variance import BiasVariance
from bench.plugins.studies.bias_variance.columns import COLUMNS
from trees import ROOT

from bench.experiment import config
from bench.experiment.columns import IDENTITY
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.host.identity import parse_identity
from bench.host.parameters import parameters
from bench.model import registry
from bench.report import writer
from bench.report.finish import views_of
from bench.report.views import newest_rows
from bench.report.web import document
from bench.report.web.data import page_data
from bench.run.execute import store_of
from bench.run.plan import requested_rows
from bench.run.tasks import blank_row

CELLS = ["scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg,reinforce]", "samples=8", "repeats=4", "name=tiny"]
"""Words of a run of two cells."""
TINY = [*CELLS, "workers=0"]
"""Words of such a run in this process."""
NAMES = ("alpha_order", "finite_difference", "fobg", "inverse_variance", "randomized_smoothing", "reinforce")
STIFFNESS = (1e1, 1e2, 1e3, 3e3, 1e4, 1e5, 1e6)
BACKENDS = ("jax", "torch", "numpy", "implicit")
SPEED = {"jax": 2e-4, "torch": 8e-3, "numpy": 3e-3, "implicit": 6e-4}
VIEWS = {"scene": ("horizon", "dt", "sigma", "noise"), "contact": ("stiffness",), "backend": ("dtype",)}
"""The columns that show a parameter of the plugin on an axis."""
WHO = (*IDENTITY, "experiment", "dim", "key", "study", "parameters")
"""The columns that are also filled in rows of failed cells."""


# ------------------------------------------------------------------------------------------------ made-up results


def results(stiffness, sigma, samples, repeats, seed, estimator, backend, contact):
    """Return made-up results of a cell: stiff contact makes only first-order estimates biased and noisy."""
    k, n = stiffness, samples
    stiff = max(k, 1.0) / 3e3 if math.isfinite(k) else 0.1
    first = estimator in ("fobg", "alpha_order", "inverse_variance")
    share = {"alpha_order": 0.3, "inverse_variance": 0.1}.get(estimator, 1.0)
    bias = share * stiff / (1 + stiff) if first and contact == "penalty" else 0.0
    variance = (0.05 + share * stiff**2 * sigma if first else 6.0 / (1 + 10 * sigma)) * 10 / n
    generator = np.random.default_rng(zlib.crc32(repr((k, sigma, estimator, n, seed)).encode()))
    se = math.sqrt(variance / repeats)
    bias = max(0.0, bias + 0.3 * se * generator.standard_normal())
    low, high = max(0.0, bias - 2 * se), bias + 2 * se
    if low == 0:
        bias = 0.0
    norm = 4.0
    time = SPEED.get(backend, 1e-3) * (n / 100) ** 0.9 * (1.0 if first else 0.4)
    return {
        "status": "ok",
        "device": "cpu",
        "reference_norm": norm,
        "grad_norm": norm * (1 + bias),
        "reference_method": "quadrature",
        "reference_se": 0.0,
        "bias": norm * bias,
        "bias_low": norm * low,
        "bias_high": norm * high,
        "bias_rel": bias,
        "variance": norm**2 * variance,
        "variance_low": norm**2 * variance * 0.6,
        "variance_high": norm**2 * variance * 1.8,
        "variance_per_sample": norm**2 * variance * n,
        "rmse": norm * math.hypot(bias, math.sqrt(variance)),
        "rmse_rel": math.hypot(bias, math.sqrt(variance)),
        "cosine": 1 / math.sqrt(1 + bias**2 + variance),
        "sign_agreement": 0.9,
        "finite_fraction": 1.0,
        "time_s": time,
        "time_iqr_s": 0.15 * time,
        "compile_s": 0.3,
        "rollouts": n,
        "gradients": n if first else 0,
        "peak_memory_mb": 300.0,
        "versions": "numpy=2.4",
    }


# ------------------------------------------------------------------------------------------------ from real cells


def loaded(*words):
    """Return the experiment of a command line, and its cells."""
    made = config.load(list(words))
    return made, cells(made)


def rows_of(made, of):
    """Return rows of real cells with made-up results. Cells that a run would refuse have the refusal's status and reason."""
    rows = []
    for cell in of:
        row = blank_row(made, cell)
        refused = cell.refusal()
        if refused is not None:
            rows.append(row | dict(zip(("status", "reason"), refused, strict=True)))
            continue
        given = {name: row[name] for name in ("stiffness", "sigma", "samples", "repeats", "seed", "estimator")}
        rows.append(
            row | results(**given, backend=cell.backend.name, contact=cell.contact.name if cell.contact else "")
        )
    return made.columns.typed(pd.DataFrame(rows))


def unmeasured(*words, **values):
    """Return the experiment of a command line, and a row of each of its cells whose only results are ``values``."""
    made, of = loaded(*words)
    rows = pd.DataFrame([blank_row(made, cell) | {"status": "ok"} for cell in of])
    return made, made.columns.typed(rows.assign(**values))


def stored(name, *words):
    """Return a standard experiment and its stored rows."""
    made = config.load([f"experiment={name}", *words, f"results_dir={ROOT / 'results' / 'standard'}"])
    return made, requested_rows(made, newest_rows(store_of(made).load()))[0]


# ------------------------------------------------------------------------------------------- made up of columns


def row(**values):
    """Return a made-up row with these columns and the ``parameters`` they imply. Its plugins need not exist."""
    given = {
        "scene": "pushing",
        "contact": "penalty",
        "integrator": "semi_implicit_euler",
        "backend": "jax",
        "estimator": "fobg",
        "noise": "action",
        "horizon": 20,
        "dt": 0.01,
        "stiffness": 1e3,
        "sigma": 0.1,
        "samples": 100,
        "repeats": 32,
        "dim": 20,
        "seed": 0,
        "dtype": "float64",
    } | values
    numbers = {name: given[name] for name in ("stiffness", "sigma", "samples", "repeats", "seed")}
    made = results(**numbers, estimator=given["estimator"], backend=given["backend"], contact=given["contact"])
    named = {"experiment": "made_up", "study": "bias_variance"}
    result = COLUMNS.blank() | made | named | given
    result["parameters"] = json.dumps(described_by(result), allow_nan=False)
    result["key"] = f"{zlib.crc32(repr(sorted(given.items())).encode()):08x}"
    return result


def failed(status, reason, **values):
    """Return a row of a failed cell, without results."""
    made, empty = row(**values), COLUMNS.blank()
    return {name: made[name] if name in WHO else empty[name] for name in made} | {"status": status, "reason": reason}


def described_by(given):
    """Return the parameters of a cell with these identity columns."""
    parts = {"study": {"name": "bias_variance", "timed_calls": 5}}
    for axis in BiasVariance.axes:
        name, own = _parsed(axis, given)
        entry = registry.entries()[registry.kind_of(axis)].get(name)
        known = parameters(entry.plugin) if entry is not None and entry.plugin is not None else {}
        part = {n: parameter.default for n, parameter in known.items()}
        part |= {view: given[view] for view in VIEWS.get(axis, ()) if not known or view in known}
        if axis == "contact" and (smoothing := getattr(entry and entry.plugin, "smoothing", "")):
            part[smoothing] = given["smoothing"]
        parts[axis] = (
            None if name == "none" else {"name": name} | {n: _plain(value) for n, value in (part | own).items()}
        )
    return parts | {"theta": None, "reference": {"samples": 262144, "tolerance": 0.005}}


def _parsed(axis, given):
    """Return name and parameters of an identity string. Without such a plugin, the whole string is the name."""
    params = given["estimator_params"] if axis == "estimator" else ""
    try:
        name, own = parse_identity(f"{given[axis]}[{params}]" if params else given[axis])
    except Exception:
        return given[axis], {}
    return (name, own) if name in registry.entries()[registry.kind_of(axis)] else (given[axis], {})


def _plain(value):
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def table(rows):
    """Return rows as a typed table, as loading a store does."""
    return COLUMNS.typed(pd.DataFrame(rows))


def stiffness_rows(
    stiffness=STIFFNESS,
    sigmas=(0.1, 0.3),
    estimators=NAMES,
    backends=BACKENDS,
):
    """Return made-up rows: by default 4 backends, 6 estimators, 7 stiffnesses and 2 sigmas, under 2 contact laws."""
    rows = []
    for sigma, k, contact, backend, estimator in itertools.product(
        sigmas, stiffness, ("penalty", "complementarity"), backends, estimators
    ):
        cell = {"sigma": sigma, "stiffness": k, "contact": contact, "backend": backend, "estimator": estimator}
        cell["smoothing"] = 1e-6 if contact == "complementarity" else math.nan
        if contact == "complementarity" and backend != "implicit":
            rows.append(
                failed("unsupported", f"{contact} solves an equation each step, backend {backend} has none", **cell)
            )
        elif k == 1e6 and estimator in ("fobg", "inverse_variance") and contact == "penalty":
            rows.append(failed("nonfinite", "3 of 32 estimates are not finite, first repeat 4 of seed 0", **cell))
        else:
            rows.append(row(**cell))
            if backend == "numpy":
                rows[-1]["rmse"] *= 1 + 1e-5
    return table(rows)


def small_rows(**given):
    """Return made-up rows of three estimators at two stiffnesses and one sigma."""
    few = {"stiffness": (1e2, 1e4), "sigmas": (0.1,), "estimators": ("fobg", "inverse_variance", "reinforce")}
    return stiffness_rows(**{**few, **given})


def experiment(
    directory=Path("unused"),
    sweep=None,
    marks=None,
    name="made_up",
    formats=("png",),
    compares=None,
):
    """Return an experiment for reports of made-up rows; it cannot be run."""
    return Experiment(
        name=name,
        study=BiasVariance(),
        choices={},
        sweep={"sigma": [0.1, 0.3], "stiffness": list(STIFFNESS)} if sweep is None else sweep,
        results_dir=directory,
        question="As contact stiffens, which gradient stays right?",
        marks={"stiffness": {"step size limit": 6400}} if marks is None else marks,
        formats=formats,
        compares=compares or {},
    )


def swept(rows, **given):
    """Return an experiment for reports of made-up rows, by default along their stiffnesses, as :func:`experiment` does."""
    return experiment(**{"sweep": {"stiffness": sorted(map(float, rows["stiffness"].unique()))}} | given)


def charts_of(rows, **given):
    """Return the charts of made-up rows by name, of the experiment of :func:`swept`."""
    shown = swept(rows, **given)
    return {chart.name: chart for chart in shown.study.views(shown, rows).charts}


def need_backends(*names):
    """Skip the tests of a module unless these backends are available."""
    for name in names:
        if reason := registry.find("backends", name).reason:
            pytest.skip(f"backend {name} is {reason}", allow_module_level=True)


def central_differences(problem, theta, w, step=1e-6):
    """Return central differences of the costs at a theta ``(d,)``, ``(d, B)``."""
    moves = step * np.eye(theta.size)
    return np.stack([problem.value(theta + move, w) - problem.value(theta - move, w) for move in moves]) / (2 * step)


def page(made, rows, views=None):
    """Return the page of an experiment's rows, with the drawings of its views."""
    views = views_of(made, rows) if views is None else views
    data = page_data(made, rows, views, [["a=1"]] * len(rows))
    return document.page(made.name, made.question, views, data, writer.drawings(made, views))
