"""Counts how often `identify` notices that its model is wrong: `python validation/wrong_models.py [RECORDS]`.

Records of x'' = -k x - c v + ... with terms that the model lacks, or with noise other than the model's, are fitted with
k and c. For every wrong model the program prints the share of records that are not explained, the most that a test of one
record could notice, the coverage of the 95% intervals of c for independent noise of the stated size, and that of the
intervals that are printed. The right model has 16 times as many records; its share is the rate of false alarms of all
tests together, 5% by design.
"""

from __future__ import annotations

import sys

import numpy as np
from bench.plugins.integrators.rk4 import Rk4
from bench.plugins.optimizers.gauss_newton import GaussNewton
from bench.plugins.scenes.mass_spring_damper import MassSpringDamper
from scipy.stats import norm

from bench.measure import adequacy, performance
from bench.model import Decision, compose
from bench.studies.identify.measure import Fitting, Model, missing_terms, run_fits

SIGMA, STEPS = 0.01, 200
SCENE = MassSpringDamper(damping=0.3, start=3.0)
NAMES = ("stiffness", "damping")


def model_of(scene):
    program = compose(scene, None, Rk4(), Decision(NAMES))
    return Model(program, NAMES, (0,), tuple(range(1, STEPS + 1)))


TERMS = {
    "v|v|": lambda q, v: -v[0] * np.abs(v[0]),
    "v^3": lambda q, v: -(v[0] ** 3),
    "sign v": lambda q, v: -np.sign(v[0]),
    "q^2": lambda q, v: -(q[0] ** 2),
    "q^3": lambda q, v: -(q[0] ** 3),
    "constant": lambda q, v: 1.0 + 0.0 * q[0],
    "v q^2": lambda q, v: -v[0] * q[0] ** 2,
    "|q| spring": lambda q, v: -np.abs(q[0]),
}
SIZES = {
    "v|v|": (0.0002, 0.001, 0.004, 0.02, 0.1), "v^3": (0.0001, 0.0005, 0.002, 0.01), "sign v": (0.001, 0.005, 0.02, 0.1),
    "q^2": (0.0005, 0.002, 0.01, 0.05), "q^3": (0.0005, 0.002, 0.01, 0.05), "constant": (0.002, 0.01, 0.05, 0.2),
    "v q^2": (0.0005, 0.002, 0.01, 0.05), "|q| spring": (0.002, 0.01, 0.05, 0.2),
}  # fmt: skip


def autoregressive(random, size, rho):
    e = random.standard_normal(size)
    x = np.zeros(size)
    x[0] = e[0]
    for t in range(1, size[0]):
        x[t] = rho * x[t - 1] + np.sqrt(1 - rho**2) * e[t]
    return x


def cases():
    """Yield name, clean record ``(m,)`` and the noise as a function of a generator and a size."""
    plain = lambda random, size: random.standard_normal(size)  # noqa: E731
    right = model_of(SCENE)
    clean = right.record(right.values[:, None])[:, 0]
    yield "right", clean, plain
    for term, sizes in SIZES.items():
        for size in sizes:
            push = lambda s, q, v, term=term, size=size: size * TERMS[term](q, v)[None]  # noqa: E731
            yield f"{size:g} {term}", right.record(right.values[:, None], push)[:, 0], plain
    for offset in (0.1, 0.25, 0.5, 1.0):
        yield f"offset {offset:g} sigma", clean + offset * SIGMA, plain
    for gain in (0.99, 1.002, 1.01):
        yield f"gain {gain:g}", clean * gain, plain
    for drift in (0.5, 1.0, 2.0):
        yield f"drift {drift:g} sigma", clean + drift * SIGMA * np.linspace(-1, 1, STEPS), plain
    for delay in (0.02, 0.1, 0.5):
        t = np.arange(1, STEPS + 1)
        yield f"delay {delay:g} steps", np.interp(t - delay, np.r_[0, t], np.r_[SCENE.start, clean]), plain
    for rho in (0.3, 0.5, 0.7, 0.9):
        yield f"noise AR {rho:g}", clean, lambda random, size, rho=rho: autoregressive(random, size, rho)
    for factor in (1.1, 1.3, 2.0):
        yield f"noise x {factor:g}", clean, lambda random, size, factor=factor: factor * random.standard_normal(size)
    yield "noise t3", clean, lambda random, size: random.standard_t(3, size) / np.sqrt(3)
    for scale in (1.01, 1.001):
        wrong = model_of(MassSpringDamper(damping=0.3, start=3.0 * scale))
        yield f"start x {scale:g}", wrong.record(wrong.values[:, None])[:, 0], plain
    for step in (0.25, 1.0):
        half = np.arange(STEPS) >= STEPS // 2
        yield f"sensor jumps by {step:g} sigma", clean + step * SIGMA * half, plain
    for edge in (0.9, 0.99):
        most = edge * np.abs(clean).max()
        yield f"sensor clipped at {edge:.0%}", np.clip(clean, -most, most), plain
    for amplitude in (0.002, 0.01, 0.05, 0.2):
        wrong = model_of(MassSpringDamper(damping=0.3, start=3.0, force=amplitude))
        yield f"force {amplitude:g}", wrong.record(wrong.values[:, None])[:, 0], plain


def run(clean, noise, records, seed=0):
    """Return the share of records that are not explained, and the coverage of plain and of printed intervals."""
    model = model_of(SCENE)
    data = clean[:, None] + SIGMA * noise(np.random.default_rng([seed, 5]), (STEPS, records))
    fitting = Fitting(model, "single", 1, SIGMA)
    start = fitting.start(np.repeat(model.values[:, None] * 1.1, records, axis=1), data)
    solution, _ = run_fits(fitting, GaussNewton(), start, data, 15)
    residual, jacobian = fitting.residuals(solution, data), fitting.jacobians(solution, data)
    terms = missing_terms(model, np.exp(solution[:, 0]), SIGMA)
    noticed, inside, printed = 0, 0, 0
    for i in range(records):
        noticed += not adequacy.judge(residual[:, i], jacobian[:, :, i], 1, terms, seed=i).is_explained
        plain = np.linalg.inv(jacobian[:, :, i].T @ jacobian[:, :, i])
        variance, _, quantile = adequacy.variances(residual[:, i], jacobian[:, :, i], 1)
        apart = abs(solution[1, i] - np.log(SCENE.damping))
        inside += apart <= performance.Z * np.sqrt(plain[1, 1])
        printed += apart <= quantile * np.sqrt(variance[1])
    return noticed / records, inside / records, printed / records


def limit(clean, level=adequacy.LEVEL):
    """Return the share of records in which a test that knows the missing term, and tests no other, notices it."""
    model = model_of(SCENE)
    fitting = Fitting(model, "single", 1, SIGMA)
    solution, _ = run_fits(
        fitting, GaussNewton(), fitting.start(model.values[:, None] * 1.1, clean[:, None]), clean[:, None], 15
    )
    effect = float(np.linalg.norm(fitting.residuals(solution, clean[:, None])))
    edge = norm.isf(level / 2.0)
    return float(norm.cdf(effect - edge) + norm.cdf(-effect - edge))


def main(records: int = 64) -> None:
    """Print a line per model, and the number of wrong models that most records notice."""
    shares, limits = {}, {}
    for name, clean, noise in cases():
        shares[name], inside, printed = run(clean, noise, 16 * records if name == "right" else records)
        limits[name] = np.nan if name.startswith("noise") else limit(clean)
        print(
            f"{name:20} not explained {shares[name]:6.1%} (at most {limits[name]:6.1%})  c inside {inside:6.1%}, printed "
            f"{printed:6.1%}",
            flush=True,
        )
    wrong = [name for name in shares if name != "right"]
    known = [name for name in wrong if np.isfinite(limits[name])]
    print(
        f"{len(wrong)} wrong models: {sum(shares[n] > 0.5 for n in wrong)} noticed in most records, "
        f"{np.mean([shares[n] for n in wrong]):.1%} on average; of {len(known)} wrong terms "
        f"{np.mean([shares[n] for n in known]):.1%}, a test that knows the term {np.mean([limits[n] for n in known]):.1%}"
    )
    print(f"false alarms {shares['right']:.1%}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
