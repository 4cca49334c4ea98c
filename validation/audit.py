"""Measures intervals and references with a second implementation: `python validation/audit.py [SETS [SECTION]]`.

The true values come from closed forms, or from code below that imports no statistics, scene or contact law of this package.
Coverage is the share of SETS simulated data sets whose 95% interval contains the true value, without leaving out any set.
Sections: tails, references, features.
"""

import json
import math
import sys

import numpy as np
import pandas as pd
from scipy import special

Line = tuple[str, bool]
"""What was measured with its value, and whether that is wrong."""


def within(interval, truth):
    return bool(interval[0] <= truth <= interval[1])


# ---------------------------------------------------------------------------------- estimators (bias_variance)


def tails(sets):
    """Intervals of some estimators of exp(x) and of a hinge that 1 sample in 160 meets, and of every one on a sum of sines.

    Many estimates give the true bias, variance and RMSE.
    """
    import bank
    from bench.plugins.backends.numpy import Numpy
    from bench.plugins.studies.bias_variance.measure import summarise_diagnostics

    from bench.measure.statistics import Truth, summarise
    from bench.model import SampleMean, columns, compose, per_repeat, registry
    from bench.report.views import rmse_interval

    few = [
        ("fobg", {}), ("reinforce", {}), ("reinforce", {"baseline": "leave_one_out"}), ("control_variate", {}),
        ("randomized_smoothing", {}), ("randomized_smoothing", {"variant": "forward"}),
    ]  # fmt: skip
    every = [(name, {}) for name in sorted(registry.entries()["estimators"])]
    one = [np.ones(1)], np.zeros(1), 1.0
    for label, scene, samples, estimators in (
        ("exp(x)", bank.Ridge([bank.growth(1.0)], *one), 16, few),
        ("hinge", bank.Ridge([bank.ramp(2.5, 20.0)], *one), 16, few),
        ("sines", bank.Ridge([bank.wave(1.0)] * 3, list(np.eye(3)), np.full(3, 0.3), 0.2), 32, every),
    ):
        problem, theta, truth = Numpy().compile(compose(scene)), scene.start, Truth.exact(scene.truth())
        for name, values in estimators:
            method = registry.make("estimators", name, values)
            if refused := method.refusal(problem.program, problem.provides, "numpy"):
                print(f"{label}: {refused}")
                continue
            random = np.random.default_rng(10)
            size = 2000, samples, theta.size
            many = np.concatenate(
                [method.estimate(problem, theta, random.standard_normal(size)) for _ in range(960 // samples)]
            )
            bias = (
                float(np.linalg.norm(many.mean(axis=0) - truth.mean))
                if not method.declares_unbiased(problem.program)
                else 0.0
            )
            variance = float(many.var(axis=0).sum())
            for repeats in (16, 64):
                inside = []
                for _ in range(sets):
                    noise = random.standard_normal((repeats, samples, theta.size))
                    sums = None
                    if isinstance(method, SampleMean) and method.separable:
                        terms = per_repeat(method.terms(problem, theta, columns(noise)), noise)
                        terms = terms - terms[0].mean(axis=0)
                        sums = terms.sum(axis=1), np.einsum("rnd,rnd->r", terms, terms)
                    estimates, diagnostics = method.estimate_with_diagnostics(problem, theta, noise)
                    found = summarise(estimates, truth, samples, sums)
                    doubt = method.remark(json.loads(summarise_diagnostics([diagnostics]))) if diagnostics else ""
                    inside.append((
                        within((found.bias_low, found.bias_high), bias),
                        within((found.variance_low, found.variance_high), variance),
                        within((found.variance_per_sample_low, found.variance_per_sample_high), variance * samples),
                        within(rmse_interval(pd.Series(found.__dict__)), math.sqrt(variance + bias**2) / truth.norm),
                        not (found.note or doubt),
                    ))  # fmt: skip
                held = np.array(inside)
                plain = held[held[:, -1]]
                kind = f"{label}, {', '.join([name, *values.values()])}, R = {repeats}, {1 - len(plain) / sets:.0%} with a remark"
                for place, what in enumerate(("bias", "variance", "variance per sample", "RMSE")):
                    without = f", without {plain[:, place].mean():.1%}" if len(plain) else ""
                    yield f"{what}, {kind}{without}: {held[:, place].mean():.1%}", False


# --------------------------------------------------------------------------------------------------- references


def _block(theta):
    """Return the costs ``(B,)`` of a block dragged with friction, for ``(V, a)`` in columns ``(2, B)``, defaults of the scene."""
    dt, mass, g, mu, slip, k, depth, w, stiffness = 1e-3, 1.0, 9.81, 0.5, 0.005, 400.0, 9.81e-5, 8.0, 1e5
    x, z, vx, vz = np.zeros(theta.shape[1]), np.full(theta.shape[1], -depth), 0.0, 0.0
    for i in range(1500):
        end = theta[0] * (i * dt - theta[1] * math.sin(w * i * dt) / w)
        normal = np.maximum(-stiffness * z, 0.0)
        ax = (k * (end - x) - mu * normal * np.tanh(vx / slip)) / mass
        vx, vz = vx + dt * ax, vz + dt * (normal / mass - g)
        x, z = x + dt * vx, z + dt * vz
    return 0.5 * ((x - 1.0) ** 2 + z**2)


def _hop(theta, noise, kappa=0.0):
    """Return the costs ``(B,)`` of a hopper with forces ``noise (horizon, B)``, with a spring or on the central path."""
    dt, big, small, rest, k, b, g, target, effort, stiffness = 2e-3, 1.0, 0.1, 0.5, 400.0, 6.0, 9.81, 0.7, 1e-5, 1e4
    y = np.full(noise.shape[1], 0.15)
    z, vz, vy = y + rest, 0.0 * y, 0.0 * y
    total = 0.0 * y

    def height(z, y, vz):
        return z + vz**2 / (2 * g) + k * (rest - (z - y)) ** 2 / (2 * big * g)

    for shock in noise:
        c = rest - (z - y)
        u = c * vz * (theta[0] + theta[1] * (target - height(z, y, vz))) + shock
        total += ((height(z, y, vz) - target) ** 2 + effort * u * u) / len(noise)
        push = k * c + b * (vy - vz) + u
        force = 0.0 if kappa else np.maximum(-stiffness * y, 0.0)
        vz, vy = vz + dt * (push / big - g), vy + dt * ((force - push) / small - g)
        if kappa:
            # (a + c force) force = kappa with the gap a of a step without contact
            a, opened = y + dt * vy, dt * dt / small
            root = np.sqrt(a * a + 4.0 * opened * kappa)
            force = np.where(a > 0, 2.0 * kappa / (np.abs(a) + root), (np.abs(a) + root) / (2.0 * opened))
            vy = vy + dt * force / small
        z, y = z + dt * vz, y + dt * vy
    return total + (height(z, y, vz) - target) ** 2


def _by_hermite(cost, theta, sigma, count):
    """Return grad J for noise on two parameters, E[f w] / sigma, by Gauss-Hermite quadrature."""
    nodes, weights = special.roots_hermitenorm(count)
    w = np.array(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
    both = np.outer(weights, weights).ravel() / weights.sum() ** 2
    return (w * both) @ cost(theta[:, None] + sigma * w) / sigma


def _by_differences(cost, theta, sigma, noise):
    """Return grad J and its standard errors ``(d,)``, by central differences of theta with the same noise ``(horizon, B)``."""
    columns = []
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-4 * theta[i]
        columns.append((cost(theta + step, sigma * noise) - cost(theta - step, sigma * noise)) / (2e-4 * theta[i]))
    terms = np.array(columns)
    return terms.mean(axis=1), terms.std(axis=1, ddof=1) / math.sqrt(noise.shape[1])


def _reference(scene, contact, backend, samples):
    from bench.measure.reference import certify
    from bench.model import compose, registry

    method = registry.make("integrators", "semi_implicit_euler", {})
    law = None if contact is None else registry.make("contacts", *contact)
    problem = registry.make("backends", backend, {}).compile(compose(registry.make("scenes", scene, {}), law, method))
    return problem, certify(problem, problem.provides, samples, 0.005)


def references(sets):
    """Certified references of scenes without closed form, against the simulations above and the engine's own costs."""
    _, found = _reference("friction_block", ("penalty", {"stiffness": 1e5}), "fused", 1 << 14)
    own = [_by_hermite(_block, np.array([0.3, 1.0]), 0.02, count) for count in (44, 60)]
    allowed = 4 * found.known().standard_error + float(np.linalg.norm(own[0] - own[1]))
    yield _compared("friction_block, penalty", found, own[1], allowed)
    laws = {
        "penalty": (("penalty", {"stiffness": 1e4}), 0.0),
        "complementarity": (("complementarity", {"kappa": 1e-4}), 1e-4),
    }
    noise = np.random.default_rng(8).standard_normal((1000, max(400, 10 * sets)))
    for name, (law, kappa) in laws.items():
        _, found = _reference("hopper", law, "implicit" if kappa else "fused", (1 << 10) if kappa else (1 << 13))
        own_mean, error = _by_differences(
            lambda t, w, kappa=kappa: _hop(t, w, kappa), np.array([100.0, 400.0]), 1.0, noise
        )
        allowed = 4 * math.hypot(found.known().standard_error, float(np.linalg.norm(error)))
        yield _compared(f"hopper, {name}", found, own_mean, allowed)
    try:
        problem, found = _reference("tossed_box", None, "mujoco", 1 << 11)
    except Exception as error:  # the library is not installed
        print(f"tossed_box on mujoco was not run: {error}")
        return
    # antithetic pairs of costs with a fitted line subtracted: no gradient of the backend is used
    w = np.random.default_rng(9).standard_normal((3, 20 * sets))
    theta, sigma = problem.program.theta0, 0.1
    d = (problem.value(theta, w) - problem.value(theta, -w)) / (2 * sigma)
    line = np.linalg.lstsq(w.T, d, rcond=None)[0]
    terms = (d - line @ w) * w + line[:, None]
    error = terms.std(axis=1, ddof=1) / math.sqrt(w.shape[1])
    allowed = 4 * math.hypot(found.known().standard_error, float(np.linalg.norm(error)))
    yield _compared("tossed_box, mujoco", found, terms.mean(axis=1), allowed)


def _compared(name, found, own, allowed):
    apart = float(np.linalg.norm(found.gradient - own))
    size = float(np.linalg.norm(own))
    stated = found.known().standard_error
    label = (
        f"{name} ({found.method}): error {apart / size:.1e} of the norm, stated {stated / size:.1e}, allowed "
        f"{allowed / size:.1e}"
    )
    return label, not apart <= allowed


# ----------------------------------------------------------------------------------------------------- features


def _slope(kind, k, m, width, radius):
    """Return the derivative by m of E[g(|W - c|)] over W ~ N(0, I_k) with |c| = m; ``width`` is the power of a pole."""
    if kind == "pole":
        factor = 2 ** (-width / 2) * special.gamma((k - width) / 2) / special.gamma(k / 2)
        return float(-m * width / k * factor * special.hyp1f1(width / 2 + 1, k / 2 + 1, -(m**2) / 2))
    if kind != "shell":
        v = 1 + width**2
        return -((width / math.sqrt(v)) ** k) * math.exp(-(m**2) / (2 * v)) * m / v
    # the density of the distance is that of a noncentral chi distribution
    x, weight = special.roots_legendre(400)
    low, high = max(radius - 8 * width, 0.0), radius + 8 * width
    rho, order = (low + high) / 2 + (high - low) / 2 * x, k / 2 - 1
    change = rho * special.ive(order + 1, rho * m) - m * special.ive(order, rho * m)
    density = rho * (rho / m) ** order * np.exp(-((rho - m) ** 2) / 2) * change
    return float((high - low) / 2 * weight @ (density * np.exp(-(((rho - radius) / width) ** 2) / 2)))


def _profile(kind, width, radius):
    if kind == "pole":
        return lambda rho: rho**-width
    return lambda rho: np.exp(-(((rho - radius) / width) ** 2) / 2)


def _featured(kind, d, random):
    """Return a scene of .2 x plus a feature, its gradient at 0, and the feature's width or power.

    A feature is a function of the distance from a centre, or from a plane (a ridge), that many standard deviations from
    theta: .5 to 3.2; a shell has this radius and its centre at .3 to 1. Widths are 3e-5 to .1, powers .1 to .9 of d.
    """
    import bank

    k = 1 if kind == "ridge" else d
    m, radius = random.uniform(0.5, 3.2), 0.0
    if kind == "shell":
        m, radius = random.uniform(0.3, 1.0), m
    width = random.uniform(0.1, 0.9) * d if kind == "pole" else 10 ** random.uniform(math.log10(3e-5), -1)
    axes = np.linalg.qr(random.standard_normal((d, d)))[0][:k]
    centre = random.standard_normal(k)
    centre *= m / np.linalg.norm(centre)
    slope = _slope(kind, k, m, width, radius)
    height = 0.2 * 10 ** random.uniform(-0.5, 1.0) / abs(slope)
    profile = _profile(kind, width, radius)
    first = np.eye(d)[0]
    feature = bank.Piece(
        kind, lambda u: height * profile(np.linalg.norm(u - centre[:, None], axis=0)), lambda u, s: 0.0
    )
    scene = bank.Ridge([bank.power(1, 0.2), feature], [first, axes], np.zeros(d), 1.0)
    return scene, 0.2 * first - height * slope * axes.T @ centre / m, width


def _smooth(d, random):
    """Return a scene of one to four waves, bumps, powers and exponentials along random lines, and its gradient."""
    import bank

    makers = (
        lambda: bank.wave(random.uniform(0.3, 2.0)), lambda: bank.bump(random.normal(), random.uniform(0.5, 2.0), 1.0),
        lambda: bank.power(int(random.integers(2, 4))), lambda: bank.growth(random.uniform(0.1, 0.7)),
    )  # fmt: skip
    pieces = [makers[random.integers(4)]() for _ in range(random.integers(1, 5))]
    along = [v / np.linalg.norm(v) for v in random.standard_normal((len(pieces), d))]
    scene = bank.Ridge(pieces, along, random.standard_normal(d), 10 ** random.uniform(-2, 0))
    return scene, scene.truth(), 0.0


def features(sets):
    """References of costs with a narrow feature in 1, 2 and 3 to 10 dimensions, and of smooth costs, which need no remark."""
    import bank

    from bench.model import compose

    random = np.random.default_rng(11)
    kinds = ("spike", "ridge", "pole", "shell")
    groups = [(f"{kind}s, d = {d}", kind, (d,), sets // 8) for d in (1, 2) for kind in kinds]
    groups += [(f"{kind}s, d = 3 to 10", kind, range(3, 11), sets // 16) for kind in kinds]
    for label, kind, dims, count in [*groups, ("smooth costs, d = 1 to 10", "", range(1, 11), sets)]:
        results = []
        for i in range(count):
            d = dims[i % len(dims)]
            scene, truth, width = _featured(kind, d, random) if kind else _smooth(d, random)
            object.__setattr__(scene, "name", f"{label} {i}")  # noise is drawn by name
            found = bank.certified(bank.Case("", compose(scene), truth), 1 << 16)
            is_off = found.is_finite and np.linalg.norm(found.gradient - truth) > 4 * found.known().standard_error
            silent = is_off and not found.note
            results.append((is_off, bool(found.note), silent, silent and not width <= found.spacing))
        off, noted, silent, wide = np.array(results).sum(axis=0)
        yield (
            f"{label}: {count}, off by more than 4 stated errors {off}, with a remark {noted}, off without {silent}, "
            f"of these wider than the spacing of the points {wide}",
            bool(wide) and dims in ((1,), (2,)),
        )


SECTIONS = (tails, references, features)


def main(sets=200, *sections):
    """Print a line per figure; return 1 if a difference is too large."""
    failed = False
    for section in SECTIONS:
        if sections and section.__name__ not in sections:
            continue
        for line, is_wrong in section(sets):
            failed |= is_wrong
            print(f"{section.__name__:10} {line}{'  <-- wrong' if is_wrong else ''}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:2]), *sys.argv[2:]))
