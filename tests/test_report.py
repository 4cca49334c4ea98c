"""Tables and charts from rows, held to what they promise and to what goes wrong in them."""

from __future__ import annotations

import io
import itertools
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.grid import Experiment
from bench.store import COLUMNS, EXTRA_COLUMNS, TEXT, typed

NAMES = ("alpha_order", "finite_difference", "fobg", "inverse_variance", "randomized_smoothing", "reinforce")
STIFFNESS = (1e1, 1e2, 1e3, 3e3, 1e4, 1e5, 1e6)
BACKENDS = ("jax", "torch", "numpy", "implicit")
SPEED = {"jax": 2e-4, "torch": 8e-3, "numpy": 3e-3, "implicit": 6e-4}


def row(**values):
    """A row like those of a run: first-order estimates turn biased and wild where contact is stiff, others do not."""
    given = {
        "scene": "pushing", "contact": "penalty", "integrator": "semi_implicit_euler", "backend": "jax",
        "estimator": "fobg", "noise": "action", "horizon": 20, "dt": 0.01, "stiffness": 1e3, "sigma": 0.1,
        "samples": 100, "repeats": 32, "dim": 20, "seed": 0, "status": "ok", "dtype": "float64", "device": "cpu",
    } | values  # fmt: skip
    k, sigma, n = given["stiffness"], given["sigma"], given["samples"]
    stiff = max(k, 1.0) / 3e3 if math.isfinite(k) else 0.1
    first = given["estimator"] in ("fobg", "alpha_order", "inverse_variance")
    share = {"alpha_order": 0.3, "inverse_variance": 0.1}.get(given["estimator"], 1.0)
    bias = share * stiff / (1 + stiff) if first and given["contact"] == "penalty" else 0.0
    variance = (0.05 + share * stiff**2 * sigma if first else 6.0 / (1 + 10 * sigma)) * 10 / n
    generator = np.random.default_rng(abs(hash((k, sigma, given["estimator"], n, given["seed"]))) % 2**32)
    se = math.sqrt(variance / given["repeats"])
    bias = max(0.0, bias + 0.3 * se * generator.standard_normal())
    low, high = max(0.0, bias - 2 * se), bias + 2 * se
    if low == 0:
        bias = 0.0
    norm = 4.0
    time = SPEED.get(given["backend"], 1e-3) * (n / 100) ** 0.9 * (1.0 if first else 0.4)
    result = {name: "" if name in TEXT else math.nan for name in (*COLUMNS, *EXTRA_COLUMNS)}
    result |= {
        "experiment": "made_up", "reference_norm": norm, "grad_norm": norm * (1 + bias), "reference_method": "quadrature",
        "reference_se": 0.0, "bias": norm * bias, "bias_low": norm * low, "bias_high": norm * high, "bias_rel": bias,
        "variance": norm**2 * variance, "variance_low": norm**2 * variance * 0.6, "variance_high": norm**2 * variance * 1.8,
        "variance_per_sample": norm**2 * variance * n, "rmse": norm * math.hypot(bias, math.sqrt(variance)),
        "rmse_rel": math.hypot(bias, math.sqrt(variance)), "cosine": 1 / math.sqrt(1 + bias**2 + variance),
        "sign_agreement": 0.9, "finite_fraction": 1.0, "time_s": time, "time_iqr_s": 0.15 * time, "compile_s": 0.3,
        "rollouts": n, "gradients": n if first else 0, "peak_memory_mb": 300.0, "versions": "numpy=2.4",
    }  # fmt: skip
    result |= given
    result["key"] = f"{abs(hash(tuple(sorted((k, str(v)) for k, v in given.items())))):x}"
    return result


def failed(status, reason, **values):
    """A row without results."""
    made = row(**values)
    identity = "experiment scene contact integrator backend estimator estimator_params noise horizon dt stiffness sigma \
        smoothing samples repeats dim seed dtype key".split()
    return {name: made[name] if name in identity else "" if name in TEXT else math.nan for name in made} | {
        "status": status,
        "reason": reason,
    }


def table(rows):
    return typed(pd.DataFrame(rows)[[*COLUMNS, *EXTRA_COLUMNS]])


def stiffness_rows(stiffness=STIFFNESS, sigmas=(0.1, 0.3), estimators=NAMES, backends=BACKENDS):
    """4 backends x 6 estimators x 2 contact laws x 7 stiffnesses x 2 sigmas."""
    rows = []
    for sigma, k, contact, backend, estimator in itertools.product(
        sigmas, stiffness, ("penalty", "complementarity"), backends, estimators
    ):
        cell = {"sigma": sigma, "stiffness": k, "contact": contact, "backend": backend, "estimator": estimator}
        cell["smoothing"] = 1e-6 if contact == "complementarity" else math.nan
        if contact == "complementarity" and backend != "implicit":
            rows.append(failed("unsupported", f"{contact} solves an equation each step, backend {backend} has none", **cell))
        elif k == 1e6 and estimator in ("fobg", "inverse_variance") and contact == "penalty":
            rows.append(failed("nonfinite", "3 of 32 estimates are not finite, first repeat 4 of seed 0", **cell))
        else:
            rows.append(row(**cell))
            if backend == "numpy":
                rows[-1]["rmse"] *= 1 + 1e-5
    return table(rows)


def experiment(directory=Path("unused"), sweep=None, marks=None, name="made_up"):
    return Experiment(
        name=name,
        choices={},
        sweep=sweep if sweep is not None else {"sigma": [0.1, 0.3], "stiffness": list(STIFFNESS)},
        results_dir=directory,
        question="As contact stiffens, which gradient stays right?",
        marks=marks if marks is not None else {"stiffness": {"step size limit": 6400}},
    )
