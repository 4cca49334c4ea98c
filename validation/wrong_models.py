"""Counts how often `identify` notices that its model is wrong: `python validation/wrong_models.py [RECORDS]`.

Records of a spring and of a pendulum, with terms that the model lacks or noise other than the model's, are fitted with two
parameters. Terms are as large as biases of 1, 2 and 4 standard errors need. Per case the program prints the share of records that
are not explained, the most that a test of one record could notice, the coverage of the intervals for independent noise of the
stated size and of those that are printed, and the share of records that are explained while an interval misses. The right
models have 4 times as many records; their share is the rate of false alarms of all tests together, 5% by design.
"""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
from bench.plugins.integrators.rk4 import Rk4
from bench.plugins.optimizers.gauss_newton import GaussNewton
from bench.plugins.scenes.mass_spring_damper import MassSpringDamper
from bench.plugins.scenes.pendulum import Pendulum
from bench.plugins.studies.identify import adequacy
from bench.plugins.studies.identify.fitting import Fitting, information, run_fits
from bench.plugins.studies.identify.missing import missing_terms
from bench.plugins.studies.identify.model import Model
from bench.plugins.studies.identify.record import evaluate
from scipy.stats import norm

from bench.measure import performance
from bench.model import Decision, compose

SIGMA, STEPS = 0.01, 200


def model_of(scene, names, state=()):
    program = compose(scene, None, Rk4(), Decision(names))
    return Model(program, names, (0,), tuple(range(1, STEPS + 1)), dict(state))


PAIRS = {
    "spring": model_of(MassSpringDamper(damping=0.3, start=3.0), ("stiffness", "damping")),
    "pendulum": model_of(
        Pendulum(damping=0.02, torque=0.0, horizon=STEPS, dt=0.03), ("length", "damping"), {"q0": 1.2}.items()
    ),
}
TERMS = (
    "v*abs(v)",
    "v**3",
    "sign(v)",
    "q**2",
    "q**3",
    "1",
    "v*q**2",
    "abs(q)",
    "cos(3*q)",
    "hysteresis",
)
"""Accelerations; those after the constant are in no list of the study, but hysteresis."""
NOISES = {
    "normal": lambda random, size: random.standard_normal(size),
    "Laplace": lambda random, size: random.laplace(size=size) / np.sqrt(2),
    "t5": lambda random, size: random.standard_t(5, size) / np.sqrt(5 / 3),
    "skewed": lambda random, size: random.exponential(size=size) - 1.0,
    "x 1.1": lambda random, size: 1.1 * random.standard_normal(size),
    "x 0.5": lambda random, size: 0.5 * random.standard_normal(size),
    "AR 0.5": lambda random, size: autoregressive(random, size, 0.5),
    "AR 0.9": lambda random, size: autoregressive(random, size, 0.9),
}


def autoregressive(random, size, rho):
    e = random.standard_normal(size)
    x = np.zeros(size)
    x[0] = e[0]
    for t in range(1, size[0]):
        x[t] = rho * x[t - 1] + np.sqrt(1 - rho**2) * e[t]
    return x


class Dragging:
    """The force of a spring with dry friction in series, as a function of the step and positions."""

    def __init__(self):
        self.force, self.q = 0.0, None

    def __call__(self, step, q, v):
        self.force = 0.0 if step == 0 else np.clip(self.force + (q - self.q) / 0.2, -1.0, 1.0)
        self.q = q
        return self.force


def pushed(model, term, size):
    """Return the record of a model with an acceleration more, ``(m,)``."""
    force = Dragging() if term == "hysteresis" else lambda s, q, v: evaluate(term, {"q": q, "v": v})
    return model.record(model.values[:, None], lambda s, q, v: -size * force(s, q, v))[:, 0]


def cases(pair):
    """Yield name, clean record ``(m,)`` and the noise as a function of a generator and a size."""
    model, plain = PAIRS[pair], NOISES["normal"]
    clean = pushed(model, "q", 0.0)
    for name, noise in NOISES.items():
        yield f"noise {name}", clean, noise
    known = information(model, model.values, SIGMA)
    for term in TERMS:
        effect = (pushed(model, term, 1e-4) - clean) / (1e-4 * SIGMA)
        bias = np.abs(np.linalg.pinv(known.jacobian) @ effect / known.bound).max()
        for errors in (1, 2, 4):
            yield f"{errors} se: {term}", pushed(model, term, errors / bias), plain
    yield "offset 0.5 sigma", clean + 0.5 * SIGMA, plain
    yield "drift 0.5 sigma", clean + 0.5 * SIGMA * np.linspace(-1, 1, STEPS), plain


def run(pair, clean, noise, records, seed=0):
    """Return shares of records: not explained, of plain and printed intervals that hold, and of silent ones that miss."""
    model = PAIRS[pair]
    data = clean[:, None] + SIGMA * noise(np.random.default_rng([seed, 5]), (STEPS, records))
    fitting = Fitting(model, "single", 1, SIGMA)
    start = fitting.start(np.repeat(model.values[:, None] * 1.1, records, axis=1), data)
    solution, _ = run_fits(fitting, GaussNewton(), start, data, 15)
    residual, jacobian = fitting.residuals(solution, data), fitting.jacobians(solution, data)
    terms = missing_terms(model, np.exp(solution[:, 0]), SIGMA)
    shares = []
    for i in range(records):
        noticed = not adequacy.judge(residual[:, i], jacobian[:, :, i], 1, terms, seed=i).is_explained
        plain = np.diag(np.linalg.inv(jacobian[:, :, i].T @ jacobian[:, :, i]))
        variance, _, quantile = adequacy.variances(residual[:, i], jacobian[:, :, i], 1)
        apart = abs(solution[:, i] - np.log(model.values))
        holds = apart <= quantile * np.sqrt(variance)
        shares.append(
            [noticed, np.mean(apart <= performance.Z * np.sqrt(plain)), holds.mean(), not (noticed or holds.all())]
        )
    return np.mean(shares, axis=0)


def limit(pair, clean, level=adequacy.LEVEL):
    """Return the share of records in which a test that knows the missing term, and tests no other, notices it."""
    model, data = PAIRS[pair], clean[:, None]
    fitting = Fitting(model, "single", 1, SIGMA)
    solution, _ = run_fits(fitting, GaussNewton(), fitting.start(model.values[:, None] * 1.1, data), data, 15)
    effect = float(np.linalg.norm(fitting.residuals(solution, data)))
    edge = norm.isf(level / 2.0)
    return float(norm.cdf(effect - edge) + norm.cdf(-effect - edge))


def main(records: int = 40) -> None:
    """Print a line per case, and means over both models by kind of case."""
    lines = []
    for pair in PAIRS:
        for name, clean, noise in cases(pair):
            shares = run(pair, clean, noise, 4 * records if name == "noise normal" else records)
            kind = name.partition(":")[0]
            most = np.nan if kind.startswith("noise") else limit(pair, clean)
            lines.append([kind, pair, name, shares[0], most, *shares[1:]])
            print(
                f"{pair:9}{name:18} not explained {shares[0]:6.1%} (at most {most:6.1%}), intervals hold: plain "
                f"{shares[1]:6.1%}, printed {shares[2]:6.1%}; silent and wrong {shares[3]:6.1%}",
                flush=True,
            )
    table = pd.DataFrame(lines, columns=["kind", "pair", "case", "noticed", "at most", "plain", "printed", "silent"])
    print((100 * table.groupby("kind", sort=False).mean(numeric_only=True)).round(1).to_string())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
