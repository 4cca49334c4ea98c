"""Compares certified references with known gradients, on a bank of problems: `python validation/bank.py [SAMPLES]`.

Ridges f(x) = sum_j g_j(a_j . x) have grad J = sum_j a_j dE[g_j]/du with one-dimensional Gaussian expectations of powers,
hinges, steps, bumps, waves and exponentials.
"""

import itertools
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from bench.plugins.backends.numpy import Numpy
from scipy.special import ndtr

from bench.measure.reference import certify
from bench.model import FunctionScene, compose
from bench.model.program import Program

TOLERANCE = 0.005
"""Relative error at which sampling stops, as in experiments."""
SAMPLED = 4.0
"""Standard errors allowed for a sampled reference. The stated error of a reference without sampling is a bound."""
WORST = 3.0
"""Largest error of any reference, in units of the allowed error."""


def density(z):
    return math.exp(-z * z / 2) / math.sqrt(2 * math.pi)


@dataclass(frozen=True)
class Piece:
    """g(u), and dE[g(u + sigma w)]/du as a function of u and sigma."""

    name: str
    g: Callable[[np.ndarray], np.ndarray]
    slope: Callable[[float, float], float]


def power(p, c=1.0):
    slopes = {1: lambda u, s: 1.0, 2: lambda u, s: 2 * u, 3: lambda u, s: 3 * (u * u + s * s)}
    slopes[4] = lambda u, s: 4 * (u**3 + 3 * u * s * s)
    return Piece(f"{c:g}u^{p}", lambda u: c * u**p, lambda u, s: c * slopes[p](u, s))


def ramp(at, c):
    return Piece(f"ramp({at:g},{c:g})", lambda u: c * np.maximum(u - at, 0), lambda u, s: c * ndtr((u - at) / s))


def step(at, c):
    return Piece(f"step({at:g},{c:g})", lambda u: c * (u > at), lambda u, s: c * density((u - at) / s) / s)


def square(at, c):
    def slope(u, s):
        z = (u - at) / s
        return 2 * c * s * (density(z) + z * float(ndtr(z)))

    return Piece(f"hinge2({at:g},{c:g})", lambda u: c * np.maximum(u - at, 0) ** 2, slope)


def bump(at, width, c):
    def slope(u, s):
        v = width * width + s * s
        return -c * width / math.sqrt(v) * math.exp(-((u - at) ** 2) / (2 * v)) * (u - at) / v

    return Piece(f"bump({at:g},{width:g},{c:g})", lambda u: c * np.exp(-((u - at) ** 2) / (2 * width**2)), slope)


def wave(k, c=1.0):
    return Piece(
        f"wave({k:g},{c:g})",
        lambda u: c * np.sin(k * u),
        lambda u, s: c * k * math.cos(k * u) * math.exp(-((k * s) ** 2) / 2),
    )


def gaussian(a):
    """exp(a u^2), whose mean exists for a sigma^2 < 1/2, with its mass at several standard deviations, off centre."""

    def slope(u, s):
        shrink, v = 1.0 - 2.0 * a * s * s, u + 0.5
        return 2.0 * a * v / shrink**1.5 * math.exp(a * v * v / shrink)

    return Piece(f"gauss({a:g})", lambda u: np.exp(a * (u + 0.5) ** 2), slope)


def growth(k):
    return Piece(f"exp({k:g})", lambda u: np.exp(k * u), lambda u, s: k * math.exp(k * u + (k * s) ** 2 / 2))


class Undeclared(FunctionScene):
    """A sum of pieces along unit vectors, without a declaration of continuity."""

    name = "undeclared"

    def __init__(self, pieces, along, theta, sigma, **more):
        values = dict(
            pieces=pieces, along=along, start=np.asarray(theta, float), sigma=sigma, noise="parameter", **more
        )
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def theta0(self):
        return self.start

    def cost(self, xp, x):
        return sum(piece.g(a @ x) for piece, a in zip(self.pieces, self.along, strict=True))

    def truth(self):
        slopes = [
            piece.slope(float(a @ self.start), self.sigma) for piece, a in zip(self.pieces, self.along, strict=True)
        ]
        return sum(a * slope for a, slope in zip(self.along, slopes, strict=True))


class Ridge(Undeclared):
    """The same with declarations: ``says`` is whether it is declared continuous, ``listed`` are its breakpoints."""

    name = "ridge"

    def __init__(self, pieces, along, theta, sigma, says=True, listed=()):
        super().__init__(pieces, along, theta, sigma, says=says, listed=listed)

    @property
    def continuous(self):
        return self.says

    def breakpoints(self):
        return self.listed


@dataclass(frozen=True)
class Case:
    """A problem and its exact gradient ``truth``, shape (d,)."""

    label: str
    program: Program
    truth: np.ndarray


def combinations():
    """Yield name, pieces in units of sigma from theta, whether declared continuous, and whether jumps are listed."""
    line = power(1)
    smooth = [
        [line], [power(2), line], [power(3)], [power(3), power(4, 0.1)], [wave(1.0)], [wave(3.0), line], [growth(0.5)],
        [growth(1.0), power(1, -1.5)], [bump(1.0, 0.3, 2.0)], [power(1, 0.01), wave(4.0, 0.05)], [power(2, 0.001), power(1, 1e-6)],
    ]  # fmt: skip
    kinked = [
        [line, ramp(at, c)]
        for at, c in ((0.5, 5.0), (1.0, -1.0), (2.0, 10.0), (3.0, 33.0), (3.5, 200.0), (4.0, 30.0), (-2.5, 100.0))
    ]
    kinked += [[ramp(0.0, 1.0), ramp(0.7, -2.0)], [square(1.0, 3.0)], [square(2.5, 100.0), line], [ramp(3.0, 5.0)]]
    jumps = [
        [line, step(at, c)]
        for at, c in ((0.3, 1.0), (1.0, 0.1), (1.0, 10.0), (2.0, 1.0), (3.0, 1.0), (0.5, -0.01), (3.5, 20.0))
    ]
    jumps += [[step(0.4, 1.0), step(-0.9, 2.0)], [wave(2.0), step(0.1, 0.5)], [step(2.5, 1.0)]]
    narrow = [[line, bump(at, w, 100.0)] for at, w in ((0.5, 0.01), (1.0, 0.001), (0.2, 0.1))]
    for group, pieces in (("smooth", smooth), ("kink", kinked), ("unlisted jump", jumps), ("narrow", narrow)):
        for each in pieces:
            yield group, each, True, False
    for each in jumps[:5]:
        yield "declared jump", each, False, False
        yield "listed jump", each, False, True


def scaled(piece, unit):
    """Return the piece as a function of u in units of ``unit``."""
    return Piece(piece.name, lambda u: piece.g(u / unit), lambda u, s: piece.slope(u / unit, s / unit) / unit)


def ridges():
    """Yield every combination in 1, 2, 3 and 10 dimensions, along one axis or in random directions, with sigma 0.3 or 1.7."""
    draw = np.random.default_rng(11)
    for dim, (i, (group, pieces, says, listed)) in itertools.product((1, 2, 3, 10), enumerate(combinations())):
        if listed and dim > 1:
            continue
        sigma = (0.3, 1.7)[(i + dim) % 2]
        along = [draw.standard_normal(dim) for _ in pieces] if i % 2 else [np.eye(dim)[0] for _ in pieces]
        if dim > 1 and i % 4 == 1:
            along = [along[0]] * len(pieces)
        along = [a / np.linalg.norm(a) for a in along]
        at = tuple(
            sorted(float(p.name.split("(")[1].split(",")[0]) * sigma * along[0][0] for p in pieces if "step" in p.name)
        )
        scene = Ridge([scaled(p, sigma) for p in pieces], along, np.zeros(dim), sigma, says, (at,) if listed else ())
        label = f"{group} d={dim} {'+'.join(p.name for p in pieces)}"
        yield Case(label, compose(scene), scene.truth())


def tails():
    """Yield costs whose mean lies beyond the usual limits of integration, in one and two dimensions."""
    for piece in (*map(growth, (3.0, 6.0, 8.0, 12.0)), *map(gaussian, (0.3, 0.4, 0.45))):
        for dim, theta in itertools.product((1, 2), (0.0, 0.3)):
            along = np.ones(dim) / math.sqrt(dim)
            scene = Ridge([piece], [along], np.full(dim, theta), 1.0)
            yield Case(f"tail d={dim} theta={theta:g} {piece.name}", compose(scene), scene.truth())


def undeclared():
    """Yield jumps across a slanted plane in several dimensions that no class declares, some seen once in 740 samples."""
    for dim, at, height in itertools.product((3, 5, 10), (1.0, 2.0, 3.0), (0.5, 22.6, 67.7)):
        slanted = np.ones(dim)
        slanted[-1] = 0.0
        scene = Undeclared(
            [power(1), step(at, height)], [np.eye(dim)[0], slanted / math.sqrt(dim - 1)], np.zeros(dim), 1.0
        )
        yield Case(f"undeclared jump d={dim} at {at:g} by {height:g}", compose(scene), scene.truth())


def certified(case, samples):
    """Return the certified reference of a case."""
    return certify(Numpy().compile(case.program), Numpy.provides, samples, TOLERANCE)


def excess(case, found):
    """Return the error of a reference divided by the allowed error: the stated one, or 4 standard errors if sampled."""
    stated = found.known().standard_error * (SAMPLED if len(found.batches) > 1 else 1.0)
    error = float(np.linalg.norm(found.gradient - case.truth))
    # the known gradients have rounding errors of double precision
    error = max(0.0, error - 1e-14 * float(np.linalg.norm(case.truth)) - 1e-300)
    return error / stated if stated else math.inf if error else 0.0


def cases():
    """Return every case."""
    return [*ridges(), *tails(), *undeclared()]


def main(samples=1 << 18):
    """Print a line per case and the number within the allowed error; return 1 if under 99% or one is over WORST."""
    certain = []
    every = cases()
    for case in every:
        found = certified(case, samples)
        over = excess(case, found)
        print(f"{over:8.2f}  {case.label}  {found.method}  {found.note}", flush=True)
        if over <= 1.0 or not found.note:
            certain.append(over)
    held = sum(over <= 1.0 for over in certain)
    print(
        f"{len(every)} references: {held} of {len(certain)} within what they state, the worst at {max(certain):.2f} times that;"
    )
    print(f"{len(every) - len(certain)} more are off and say that they are not certain")
    return int(held < 0.99 * len(certain) or max(certain) > WORST)


if __name__ == "__main__":
    sys.exit(main(*(int(word) for word in sys.argv[1:2])))
