"""Counts the rule of when to trust `fobg` on scenes that were not used to find it: `python validation/trusted.py`.

The rule trusts a cell where one estimate spreads by less than half of its mean and the command `gradcheck` refuses nothing.
Eighteen families have three or four scenes each. A cell is one scene and one seed. It is wrong where the relative RMSE is
0.5 or more. The truth is a dense rule in one dimension, and 4 million pairs of costs in more.
"""

import itertools
import json
import math
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from bench.plugins.backends.jax import Jax
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.studies import SPREAD
from bench.plugins.studies.bias_variance.trust import WRONG
from bench.plugins.studies.gradient_check import is_trusted

from bench.cli import main as command
from bench.measure.statistics import Truth, summarise
from bench.model import FunctionScene, compose, param

SAMPLES, REPEATS, SEEDS = 100, 32, (1, 2, 3)
POINTS = 1 << 21
"""Points of the rule that computes the truth in one dimension."""
PAIRS, PART = 1 << 22, 1 << 16
COLUMNS = 128


@dataclass(frozen=True)
class Given(FunctionScene):
    """A scene with the given cost, a function of ``xp`` and ``x (d, B)``."""

    name = "given"
    key: str = param("", "what tells programs apart, so that none runs the code compiled for another")

    def __init__(self, key, function, theta, sigma):
        for name, value in dict(key=key, function=function, start=theta, sigma=sigma, noise="parameter").items():
            object.__setattr__(self, name, value)

    def theta0(self):
        return np.array(self.start)

    def cost(self, xp, x):
        return self.function(xp, x)


class Scene(NamedTuple):
    """A scene of a family, with its theta and noise."""

    part: str
    family: str
    label: str
    cost: Callable[[Any, Any], Any]
    theta: tuple[float, ...]
    sigma: float


def edge(at, height, drag):
    """A puck slides with viscous drag for 1 s; beyond the edge of the table the target is another."""

    def cost(xp, v0):
        x, v = 0.0 * v0[0], v0[0]
        for _ in range(100):
            x, v = x + 0.01 * v, v - 0.01 * drag * v
        return xp.where(x > at, (x - 2.0) ** 2 + height, 0.1 * (x - 2.0) ** 2)

    return cost


def ledge(at, drop):
    """A ball thrown from 1 m lands on a floor that drops behind a ledge; the cost is the distance to 2 m."""

    def cost(xp, v):
        g, up = 9.81, 1.0
        near = (up + math.sqrt(up * up + 2 * g * 1.0)) / g
        far = (up + math.sqrt(up * up + 2 * g * (1.0 + drop))) / g
        x = v[0] * near
        return (xp.where(x > at, v[0] * far, x) - 2.0) ** 2

    return cost


def gate(low, high, prize):
    """A cart passes a plane; between the posts it earns a prize."""

    def cost(xp, x):
        y = x[0] + 0.3 * xp.sin(x[0])
        return 0.5 * (y - 1.0) ** 2 - prize * xp.where((y > low) & (y < high), 1.0, 0.0)

    return cost


def latch(force, stiffness):
    """A mass on a spring; once it passes 1 m, a second spring catches it for good."""

    def cost(xp, v0):
        x, v, caught = 0.0 * v0[0], v0[0], 0.0 * v0[0]
        for _ in range(40):
            caught = xp.where(x > 1.0, 1.0, caught)
            v = v + 0.05 * (force - x - stiffness * caught * (x - 1.0))
            x = x + 0.05 * v
        return (x - 0.5) ** 2 + 0.1 * x

    return cost


def friction(mu, width):
    """A block slides with friction that is smoothed over a slip speed."""

    def cost(xp, v0):
        x, v = 0.0 * v0[0], v0[0]
        for _ in range(50):
            v = v - 0.02 * mu * 9.81 * xp.tanh(v / width)
            x = x + 0.02 * v
        return (x - 0.3) ** 2

    return cost


def flight(target, wind):
    """A ball in free flight with quadratic drag."""

    def cost(xp, theta):
        x, y, vx, vy = 0.0 * theta[0], 0.0 * theta[0], theta[0], theta[-1]
        for _ in range(30):
            speed = xp.sqrt(vx * vx + vy * vy + 1e-9)
            vx, vy = vx - 0.02 * wind * speed * vx, vy - 0.02 * (9.81 + wind * speed * vy)
            x, y = x + 0.02 * vx, y + 0.02 * vy
        return (x - target) ** 2 + 0.1 * y**2

    return cost


def contact(stiffness, wall):
    """A ball hits a wall of stiffness k (penalty), dt = 0.01 s."""

    def cost(xp, v0):
        x, v = 0.0 * v0[0], v0[0]
        for _ in range(60):
            v = v + 0.01 * (-stiffness * xp.maximum(x - wall, 0.0))
            x = x + 0.01 * v
        return (x - 0.2) ** 2

    return cost


def chaos(rate, steps):
    """The logistic map, whose gradient grows with the steps where it is chaotic."""

    def cost(xp, x):
        y = 1.0 / (1.0 + xp.exp(-x[0]))
        for _ in range(steps):
            y = rate * y * (1.0 - y)
        return y

    return cost


def saturation(limit, gain):
    """A servo with a limited actuator follows a step."""

    def cost(xp, k):
        x, v = 0.0 * k[0], 0.0 * k[0]
        for _ in range(40):
            u = gain * k[0] * (1.0 - x) - 0.8 * v
            u = limit * xp.tanh(u / limit)
            v = v + 0.05 * u
            x = x + 0.05 * v
        return (x - 1.0) ** 2 + 0.05 * v * v

    return cost


def plane(dim, at, height):
    """A smooth cost of several inputs with a jump across a slanted plane."""
    slanted = np.ones(dim) / math.sqrt(dim)

    def cost(xp, x):
        along = sum(float(a) * x[i] for i, a in enumerate(slanted))
        return x[0] + 0.3 * x[-1] ** 2 + height * xp.where(along > at, 1.0, 0.0)

    return cost


def switch(height, at, width):
    """A smoothed switch that may be too narrow for any sample."""
    return lambda xp, x: x[0] + 0.1 * x[0] ** 2 + height * 0.5 * (1 + xp.tanh((x[0] - at) / width))


def stop(stiffness, at):
    """A stiff stop, continuous, met by few samples or none."""
    return lambda xp, x: x[0] + 0.1 * x[0] ** 2 + stiffness * xp.maximum(x[0] - at, 0.0 * x[0])


def corner(first, second, height):
    """A jump in a quadrant of the plane."""
    return lambda xp, x: x[1] + 0.3 * x[0] + height * xp.where((x[0] > first) & (x[1] > second), 1.0, 0.0)


def relay(gain, dead):
    """A mass under a relay with a dead zone."""

    def cost(xp, x0):
        x, v = x0[0], 0.0 * x0[0]
        for _ in range(40):
            u = xp.where(x > dead, -gain, xp.where(x < -dead, gain, 0.0))
            v = v + 0.05 * (u - 0.5 * v)
            x = x + 0.05 * v
        return x**2 + 0.1 * v**2

    return cost


def backlash(gap, rate):
    """A load behind a gear with backlash follows a sine of amplitude theta."""

    def cost(xp, a):
        y = 0.0 * a[0]
        for i in range(40):
            x = a[0] * math.sin(rate * i)
            y = xp.minimum(xp.maximum(y, x - gap), x + gap)
        return (y - 0.5) ** 2 + 0.1 * a[0]

    return cost


def quantiser(step, slope):
    """A sensor with steps beside a part that is continuous."""
    return lambda xp, x: (step * xp.floor(x[0] / step) - 1.0) ** 2 + slope * x[0]


def delay(steps, gain):
    """Feedback of gain theta that acts after a dead time."""

    def cost(xp, k):
        past = [1.0 + 0.0 * k[0]] * (steps + 1)
        for _ in range(60):
            past.append(past[-1] - 0.05 * gain * k[0] * past[-1 - steps])
        return past[-1] ** 2 + 0.05 * k[0] ** 2

    return cost


def table(edges, values, width):
    """A table between whose entries the cost jumps, or climbs over a width."""

    def cost(xp, x):
        total = values[0] + 0.2 * x[0]
        for at, low, high in zip(edges, values, values[1:], strict=False):
            risen = xp.where(x[0] > at, 1.0, 0.0) if width == 0 else xp.clip((x[0] - at) / width, 0.0, 1.0)
            total = total + (high - low) * risen
        return total

    return cost


FAMILIES = {
    "first": (
        (edge, (2.0,), 0.2, (1.2, 1.0, 1.0), (1.7, 1.0, 1.0), (1.3, 5.0, 0.7)),
        (ledge, (3.0,), 0.2, (1.2, 0.5)),
        (ledge, (3.0,), 0.1, (1.5, 0.1)),
        (ledge, (3.0,), 0.3, (1.7, 0.02)),
        (gate, (0.4,), 0.3, (1.4, 1.6, 0.5), (1.9, 2.5, 5.0), (0.95, 1.0, 0.2)),
        (latch, (0.8,), 0.2, (0.2, 20.0)),
        (latch, (1.4,), 0.2, (0.0, 5.0)),
        (latch, (0.7,), 0.2, (0.0, 1.0)),
        (friction, (1.0,), 0.2, (0.3, 0.01), (0.1, 0.001)),
        (friction, (2.0,), 0.2, (0.2, 0.1)),
        (flight, (3.0, 2.0), 0.3, (2.0, 0.1)),
        (flight, (2.0, 5.0), 0.3, (5.0, 0.05)),
        (flight, (6.0, 6.0), 0.3, (0.0, 1.0)),
        (contact, (1.0,), 0.1, (1e3, 0.3), (1e5, 0.75)),
        (contact, (0.8,), 0.1, (1e4, 0.6)),
        (chaos, (0.3,), 0.1, (3.9, 6), (3.9, 30), (3.57, 40)),
        (saturation, (1.0,), 0.3, (0.5, 2.0), (5.0, 1.0), (0.1, 4.0)),
        (plane, (0.5,) * 3, 1.0, (3, 2.0, 3.0)),
        (plane, (0.5,) * 5, 1.0, (5, 2.5, 10.0)),
        (plane, (0.5,) * 10, 1.0, (10, 3.0, 22.6)),
    ),
    "new": (
        (switch, (0.0,), 1.0, (5.0, 0.7, 1e-5), (2.0, 1.5, 1e-6), (0.5, 0.2, 1e-4), (20.0, 2.2, 1e-5)),
        (stop, (0.0,), 1.0, (2e4, 3.6), (3.12e4, 3.9), (1e3, 3.3), (50.0, 2.5)),
        (corner, (0.0, 0.0), 1.0, (2.0, 2.0, 651.4), (1.0, 1.0, 5.0), (1.5, 0.5, 3.0), (2.5, 2.5, 2000.0)),
        (relay, (0.6,), 0.1, (1.0, 0.1)),
        (relay, (0.5,), 0.1, (3.0, 0.05), (1.0, 0.3)),
        (relay, (1.5,), 0.1, (2.0, 0.2)),
        (backlash, (1.0,), 0.2, (0.1, 0.1), (0.3, 0.1)),
        (backlash, (0.6,), 0.2, (0.5, 0.3)),
        (backlash, (2.0,), 0.2, (0.05, 0.2)),
        (quantiser, (0.6,), 0.3, (0.25, 0.1)),
        (quantiser, (0.4,), 0.3, (0.01, 0.5)),
        (quantiser, (0.3,), 0.3, (1.0, 1.0)),
        (quantiser, (0.2,), 0.3, (0.1, 5.0)),
        (delay, (1.0,), 0.2, (1, 1.0), (5, 1.0), (20, 1.5)),
        (delay, (0.8,), 0.2, (10, 2.0)),
        (table, (0.0,), 1.0, ((0.5, 1.0), (0.0, 0.3, 0.1), 0.0), ((0.5, 1.0), (0.0, 0.3, 0.1), 0.2)),
        (table, (0.0,), 1.0, ((1.2,), (0.0, 4.0), 1e-4), ((-0.4, 2.0), (0.0, 0.02, 3.0), 0.01)),
    ),
}
"""By part, where `new` families were added when the rule was complete: cost, theta, noise, and arguments of each scene."""


def scenes():
    """Return every scene."""
    return [
        Scene(part, make.__name__, str(given), make(*given), theta, sigma)
        for part, families in FAMILIES.items()
        for make, theta, sigma, *every in families
        for given in every
    ]


PLUGIN = '''"""The scenes of trusted.py as a plugin, so that `gradcheck` runs on them as a user runs it."""

from dataclasses import dataclass

import numpy as np
import trusted

from bench.plugin import FunctionScene, param

SCENES = trusted.scenes()


@dataclass(frozen=True)
class Counted(FunctionScene):
    """One of the counted scenes."""

    name = "counted"
    sigma: float = param(1.0, "noise", positive=True)
    index: int = param(0, "number of the scene", low=0)

    def theta0(self):
        return np.array(SCENES[self.index].theta)

    def cost(self, xp, x):
        return SCENES[self.index].cost(xp, x)
'''


def refused(seed, folder):
    """Return by number why the command `gradcheck` refuses scenes, empty where it does not; ``folder`` has the plugin."""
    with tempfile.TemporaryDirectory() as results:
        names = [f"counted[index={i},sigma={scene.sigma}]" for i, scene in enumerate(scenes())]
        settings = ["backends=[jax]", "workers=0", f"seed={seed}", f"plugins={folder}", f"results_dir={results}"]
        command(["gradcheck", *names, *settings, "--quiet"])
        rows = pd.read_parquet(Path(results) / "gradcheck" / "rows.parquet")
    return {
        json.loads(row.parameters)["scene"]["index"]: ", ".join(
            f"{verdict} ({point})" for point, verdict in zip(row.point, row.check_verdict, strict=True) if not is_trusted(point, verdict)
        )
        for row in rows.itertuples()
    }  # fmt: skip


@cache
def truth(scene):
    """Return the smoothed gradient ``(d,)``, from costs only, without the harness."""
    theta, dim = np.array(scene.theta), len(scene.theta)
    if dim == 1:
        w = (np.arange(POINTS) + 0.5) / POINTS * 20.0 - 10.0
        weight = np.exp(-w * w / 2) / math.sqrt(2 * math.pi) * (20.0 / POINTS)
        f = scene.cost(np, theta[:, None] + scene.sigma * w[None, :])
        return np.array([float(((f - f[POINTS // 2]) * w * weight).sum()) / scene.sigma])
    random, total = np.random.default_rng(77), np.zeros(dim)
    for _ in range(PAIRS // PART):
        w = random.standard_normal((dim, PART))
        up, down = (scene.cost(np, theta[:, None] + s * scene.sigma * w) for s in (1.0, -1.0))
        total += ((up - down) * w).mean(axis=1) / (2.0 * scene.sigma)
    return total / (PAIRS // PART)


def outcomes(scene, seed):
    """Return spread and relative RMSE of one estimate of a scene."""
    problem = Jax().compile(compose(Given(f"{scene.family} {scene.label}", scene.cost, scene.theta, scene.sigma)))
    known, theta = truth(scene), np.array(scene.theta)
    w = np.random.default_rng(seed).standard_normal((REPEATS, SAMPLES, theta.size))
    found = summarise(np.asarray(Fobg().estimate(problem, theta, w)), Truth.exact(known), SAMPLES)
    return math.sqrt(found.variance) / found.grad_norm if found.grad_norm else math.inf, found.rmse_rel


def main():
    """Print a line per cell and the counts by part; return 1 if the rule trusts a wrong cell."""
    every = scenes()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "counted.py").write_text(PLUGIN)
        verdicts = {seed: refused(seed, folder) for seed in SEEDS}
    counted = pd.DataFrame(
        [
            (*scene[:3], seed, verdicts[seed][index], *outcomes(scene, seed))
            for index, scene in enumerate(every)
            for seed in SEEDS
        ],
        columns=["part", "family", "label", "seed", "refused", "spread", "rmse"],
    )
    counted["wrong"] = counted["rmse"] >= WRONG
    counted["spread alone"] = counted["spread"] < SPREAD
    counted["with `gradcheck`"] = counted["spread alone"] & (counted["refused"] == "")
    print(counted.to_string())
    for (part, cells), rule in itertools.product(counted.groupby("part"), counted.columns[-2:]):
        trusted, bad, right = cells[cells[rule]], cells["wrong"] & cells[rule], ~cells["wrong"] & ~cells[rule]
        n = len(trusted[["family", "label"]].drop_duplicates())
        print(f"| {part} | {rule} | {len(trusted)} of {len(cells)} | {bad.sum()} | {right.sum()} |")
        print(f"cells of {n} scenes; if none is wrong: below {100 * (1 - 0.05 ** (1 / max(n, 1))):.0f}% by scene")
    return int((counted["with `gradcheck`"] & counted["wrong"]).any())


if __name__ == "__main__":
    sys.exit(main())
