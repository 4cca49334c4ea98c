"""Counts the rule of when to trust `fobg` on scenes that were not used to find it: `python validation/trusted.py [PART ...]`.

The rule trusts a cell where one estimate spreads by less than half of its mean and the command `gradcheck` refuses nothing.
32 families have two to four scenes each, in three parts. A cell is one scene and one seed. It is wrong where the relative
RMSE is 0.5 or more. The truth is a dense rule in one dimension, and 4 million pairs of costs in more. Intervals are over
scenes: one is wrong if a trusted cell of it is.
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
import yaml
from bench.plugins.backends.jax import Jax
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.studies import SPREAD
from bench.plugins.studies.bias_variance.trust import WRONG
from bench.plugins.studies.gradient_check import is_trusted
from scipy.stats import beta

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


def aliasing(steps, dt):
    """A sum of samples of a wave of frequency theta, which peaks where the wave is sampled at its own period."""
    return lambda xp, x: x[0] + sum(xp.cos(2.0 * math.pi * i * dt * x[0]) for i in range(steps)) / steps


def order(first, second, gain):
    """Two carts reach a gate; the one that comes first sets the price."""

    def cost(xp, v):
        early, late = first / (1.0 + v[0] ** 2), second / (1.0 + v[1] ** 2)
        return xp.where(early < late, gain * early, late) + 0.3 * v[0]

    return cost


def chatter(dt, steps, push):
    """A mass slides along a switching line, on which its controller switches at each step."""

    def cost(xp, x0):
        x, v = x0[0], 0.0 * x0[0]
        for _ in range(steps):
            v = v + dt * (push - xp.where(x + v > 0.0, 2.0, -2.0))
            x = x + dt * v
        return x**2 + 0.2 * x0[0]

    return cost


def far(at, height):
    """An edge that almost no sample passes, and that costs enough to count."""
    return lambda xp, x: x[0] + 0.2 * x[0] ** 2 + height * xp.where(x[0] > at, 1.0, 0.0)


def pulse(height, at, width):
    """A smooth pulse."""
    return lambda xp, x: x[0] + height * xp.exp(-(((x[0] - at) / width) ** 2))


def clipped(limit, wind):
    """A cart with feedback of gain theta, whose action is cut off at a limit."""

    def cost(xp, k):
        x, v = 1.0 + 0.0 * k[0], 0.0 * k[0]
        for _ in range(30):
            v = v + 0.1 * (xp.clip(-k[0] * x - k[-1] * v, -limit, limit) + wind)
            x = x + 0.1 * v
        return x**2 + 0.1 * v**2 + 0.02 * k[0]

    return cost


def rotation(goal, shortest):
    """The angle from the attitude of a quaternion, normalised, to a goal about the same axis, the shorter way or not."""

    def cost(xp, q):
        q = q / xp.sqrt((q**2).sum(axis=0))
        along = q[0] * math.cos(goal / 2) + q[3] * math.sin(goal / 2)
        along = xp.abs(along) if shortest else along
        return 1.0 - along + 0.3 * q[1] - 0.2 * q[2]

    return cost


def single(offset, scale):
    """A distance far from the origin in single precision."""
    return lambda xp, x: scale * ((offset + x[0]).astype("float32") ** 2 - offset**2).astype("float64") / offset


def heavy(rate, floor):
    """A barrier and an exponential growth, whose rare samples decide the mean."""
    return lambda xp, x: xp.exp(rate * x[0]) + 0.1 / (floor + (x[0] - 2.0) ** 2)


def mixed(fine, coarse, height):
    """Inputs whose effects have scales far apart, and a step in the finest."""
    return lambda xp, x: (
        (fine * x[0]) ** 2 + x[1] + (x[2] / coarse) ** 2 + height * xp.where(fine * x[0] > 1.0, 1.0, 0.0)
    )


def wide(dim, at, height):
    """A cost of many inputs with an edge at a distance from the origin."""
    return lambda xp, x: x[0] + (x**2).sum(axis=0) / dim + height * xp.where((x**2).sum(axis=0) > at * dim, 1.0, 0.0)


def median(spread, tilt):
    """The median of five distances."""
    return lambda xp, x: xp.sort(xp.stack([xp.abs(x[0] - spread * i) for i in range(-2, 3)]), axis=0)[2] + tilt * x[0]


def newton(steps, start):
    """A root found by a fixed number of Newton steps from a start that does not depend on theta."""

    def cost(xp, x):
        y = start + 0.0 * x[0]
        for _ in range(steps):
            y = y - (y**3 - y - x[0]) / (3.0 * y**2 - 1.0)
        return y

    return cost


def thermostat(low, high, heat):
    """A room whose heater turns on below a temperature and off above another."""

    def cost(xp, outside):
        x, on = 0.0 * outside[0], 1.0 + 0.0 * outside[0]
        for _ in range(50):
            on = xp.where(x > high, 0.0, xp.where(x < low, 1.0, on))
            x = x + 0.1 * (outside[0] - x + heat * on)
        return (x - 0.5) ** 2 + 0.1 * outside[0]

    return cost


FAMILIES = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
"""By part: the scenes of each family."""


def scenes():
    """Return every scene."""
    return [
        Scene(
            part,
            one["cost"],
            str(given),
            globals()[one["cost"]](*given),
            tuple(one["theta"]) * one.get("times", 1),
            one["sigma"],
        )
        for part, every in FAMILIES.items()
        for one in every
        for given in one["given"]
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


def refused(seed, folder, parts):
    """Return by number why the command `gradcheck` refuses scenes, empty where it does not; ``folder`` has the plugin."""
    with tempfile.TemporaryDirectory() as results:
        names = [f"counted[index={i},sigma={scene.sigma}]" for i, scene in enumerate(scenes()) if scene.part in parts]
        settings = ["backends=[jax]", "workers=0", f"seed={seed}", f"plugins={folder}", f"results_dir={results}"]
        command(["gradcheck", *names, *settings, "--quiet"])
        rows = pd.read_parquet(Path(results) / "gradcheck" / "rows.parquet")
    return {
        json.loads(row.parameters)["scene"]["index"]: ", ".join(
            f"{verdict} ({point})"
            for point, verdict in zip(row.point, row.check_verdict, strict=True)
            if not is_trusted(point, verdict)
        )
        for row in rows.itertuples()
    }


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
    parts = sys.argv[1:] or list(FAMILIES)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "counted.py").write_text(PLUGIN)
        verdicts = {seed: refused(seed, folder, parts) for seed in SEEDS}
    counted = pd.DataFrame(
        [
            (*scene[:3], seed, verdicts[seed][index], *outcomes(scene, seed))
            for index, scene in enumerate(scenes())
            if scene.part in parts
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
        is_wrong = trusted.groupby(["family", "label"])["wrong"].any()
        most = beta.ppf(0.95, is_wrong.sum() + 1, max(len(is_wrong) - is_wrong.sum(), 1e-9))
        print(f"| {part} | {rule} | {len(trusted)} of {len(cells)} | {bad.sum()} | {right.sum()} |")
        print(f"wrong: {is_wrong.sum()} of {len(is_wrong)} scenes, below {100 * most:.0f}% with 95% confidence")
    return int((counted["with `gradcheck`"] & counted["wrong"]).any())


if __name__ == "__main__":
    sys.exit(main())
