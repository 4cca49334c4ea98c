"""Counts the rule of when to trust `fobg` on scenes that were not used to find it: `python validation/trusted.py [new]`.

The rule trusts a cell where one estimate spreads by less than half of its mean and the command `gradcheck` refuses nothing.
Eighteen families have three or four scenes each. A cell is one scene and one seed. It is wrong where the relative RMSE is
0.5 or more. The truth is a dense rule in one dimension, and 4 million pairs of costs in more.
"""

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
from bench.plugins.studies.bias_variance.trust import SPREAD, WRONG
from bench.plugins.studies.gradient_check.points import is_trusted

from bench.cli import main as command
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


def scenes():
    """Yield every scene, family by family."""
    for at, height, drag in ((1.2, 1.0, 1.0), (1.7, 1.0, 1.0), (1.3, 5.0, 0.7)):
        yield Scene("edge", f"at {at} by {height}, drag {drag}", edge(at, height, drag), (2.0,), 0.2)
    for at, drop, sigma in ((1.2, 0.5, 0.2), (1.5, 0.1, 0.1), (1.7, 0.02, 0.3)):
        yield Scene("ledge", f"at {at}, drop {drop}", ledge(at, drop), (3.0,), sigma)
    for low, high, prize in ((1.4, 1.6, 0.5), (1.9, 2.5, 5.0), (0.95, 1.0, 0.2)):
        yield Scene("gate", f"{low} to {high} for {prize}", gate(low, high, prize), (0.4,), 0.3)
    for force, stiffness, theta in ((0.2, 20.0, 0.8), (0.0, 5.0, 1.4), (0.0, 1.0, 0.7)):
        yield Scene("latch", f"force {force}, k {stiffness}, v {theta}", latch(force, stiffness), (theta,), 0.2)
    for mu, width, theta in ((0.3, 0.01, 1.0), (0.1, 0.001, 1.0), (0.2, 0.1, 2.0)):
        yield Scene("friction", f"mu {mu}, slip {width}, v {theta}", friction(mu, width), (theta,), 0.2)
    for target, wind, theta in ((2.0, 0.1, (3.0, 2.0)), (5.0, 0.05, (2.0, 5.0)), (0.0, 1.0, (6.0, 6.0))):
        yield Scene("free flight", f"to {target}, drag {wind}, v {theta}", flight(target, wind), theta, 0.3)
    for stiffness, wall, theta in ((1e3, 0.3, 1.0), (1e4, 0.6, 0.8), (1e5, 0.75, 1.0)):
        yield Scene("soft contact", f"k {stiffness:g}, wall {wall}, v {theta}", contact(stiffness, wall), (theta,), 0.1)
    for rate, steps in ((3.9, 6), (3.9, 30), (3.57, 40)):
        yield Scene("chaos", f"rate {rate}, {steps} steps", chaos(rate, steps), (0.3,), 0.1)
    for limit, gain in ((0.5, 2.0), (5.0, 1.0), (0.1, 4.0)):
        yield Scene("saturation", f"limit {limit}, gain {gain}", saturation(limit, gain), (1.0,), 0.3)
    for dim, at, height in ((3, 2.0, 3.0), (5, 2.5, 10.0), (10, 3.0, 22.6)):
        yield Scene("plane", f"d {dim}, at {at} by {height}", plane(dim, at, height), (0.5,) * dim, 1.0)
    for height, at, width in ((5.0, 0.7, 1e-5), (2.0, 1.5, 1e-6), (0.5, 0.2, 1e-4), (20.0, 2.2, 1e-5)):
        yield Scene("steep switch", f"{height} at {at} over {width}", switch(height, at, width), (0.0,), 1.0)
    for stiffness, at in ((2e4, 3.6), (3.12e4, 3.9), (1e3, 3.3), (50.0, 2.5)):
        yield Scene("far stop", f"k {stiffness:g} at {at}", stop(stiffness, at), (0.0,), 1.0)
    for first, second, height in ((2.0, 2.0, 651.4), (1.0, 1.0, 5.0), (1.5, 0.5, 3.0), (2.5, 2.5, 2000.0)):
        yield Scene("corner", f"{first}, {second} by {height}", corner(first, second, height), (0.0, 0.0), 1.0)
    for gain, dead, theta in ((1.0, 0.1, 0.6), (3.0, 0.05, 0.5), (1.0, 0.3, 0.5), (2.0, 0.2, 1.5)):
        yield Scene("relay", f"gain {gain}, dead {dead}, from {theta}", relay(gain, dead), (theta,), 0.1)
    for gap, rate, theta in ((0.1, 0.1, 1.0), (0.3, 0.1, 1.0), (0.5, 0.3, 0.6), (0.05, 0.2, 2.0)):
        yield Scene("backlash", f"gap {gap}, rate {rate}, {theta}", backlash(gap, rate), (theta,), 0.2)
    for step, slope, theta in ((0.25, 0.1, 0.6), (0.01, 0.5, 0.4), (1.0, 1.0, 0.3), (0.1, 5.0, 0.2)):
        yield Scene("quantiser", f"step {step}, slope {slope}, {theta}", quantiser(step, slope), (theta,), 0.3)
    for steps, gain, theta in ((1, 1.0, 1.0), (5, 1.0, 1.0), (10, 2.0, 0.8), (20, 1.5, 1.0)):
        yield Scene("delay", f"{steps} steps, gain {gain}", delay(steps, gain), (theta,), 0.2)
    for edges, values, width in (
        ((0.5, 1.0), (0.0, 0.3, 0.1), 0.0), ((0.5, 1.0), (0.0, 0.3, 0.1), 0.2), ((1.2,), (0.0, 4.0), 1e-4), ((-0.4, 2.0), (0.0, 0.02, 3.0), 0.01),
    ):  # fmt: skip
        yield Scene("table", f"{values} over {width}", table(edges, values, width), (0.0,), 1.0)


NEW = ("steep switch", "far stop", "corner", "relay", "backlash", "quantiser", "delay", "table")
"""Families that were added when the rule was complete."""
PLUGIN = '''"""The scenes of trusted.py as a plugin, so that `gradcheck` runs on them as a user runs it."""

from dataclasses import dataclass

import numpy as np
import trusted

from bench.plugin import FunctionScene, param

SCENES = list(trusted.scenes())


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


def refused(seed, indices, folder):
    """Return the verdicts with which the command `gradcheck` refuses scenes, by their number; empty for those it does not.

    ``folder`` has the plugin.
    """
    every = list(scenes())
    with tempfile.TemporaryDirectory() as results:
        names = [f"counted[index={i},sigma={every[i].sigma}]" for i in indices]
        settings = ["backends=[jax]", "workers=0", f"seed={seed}", f"plugins={folder}", f"results_dir={results}"]
        command(["gradcheck", *names, *settings, "--quiet"])
        rows = pd.read_parquet(Path(results) / "gradcheck" / "rows.parquet")
    verdicts = {}
    for row in rows.to_dict("records"):
        pairs = zip(row["point"], row["check_verdict"], strict=True)
        bad = [f"{verdict} ({point})" for point, verdict in pairs if not is_trusted(point, verdict)]
        verdicts[int(json.loads(row["parameters"])["scene"]["index"])] = ", ".join(dict.fromkeys(bad))
    return verdicts


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


class Outcome(NamedTuple):
    """What the rule says on one cell, and the relative RMSE of one estimate."""

    spread: float
    refused: str
    rmse: float

    @property
    def trusted_without_search(self):
        """Whether the spread alone trusts the cell."""
        return self.spread < SPREAD

    @property
    def trusted(self):
        """Whether the rule trusts the cell."""
        return self.trusted_without_search and not self.refused

    @property
    def wrong(self):
        """Whether one estimate is wrong by half of the gradient or more."""
        return self.rmse >= WRONG


def outcomes(index, scene, verdicts):
    """Return the outcome of every seed of a scene, from its estimates and the verdicts by seed and number."""
    problem = Jax().compile(compose(Given(f"{scene.family} {scene.label}", scene.cost, scene.theta, scene.sigma)))
    theta, known = np.array(scene.theta), truth(scene)
    found = []
    for seed, by_index in verdicts.items():
        w = np.random.default_rng(seed).standard_normal((REPEATS, SAMPLES, theta.size))
        estimates = np.asarray(Fobg().estimate(problem, theta, w))
        mean = np.linalg.norm(estimates.mean(axis=0))
        deviation = math.sqrt(float(estimates.var(axis=0, ddof=1).sum()))
        rmse = math.sqrt(float(np.square(estimates - known).sum(axis=1).mean())) / float(np.linalg.norm(known))
        found.append(Outcome(deviation / mean if mean else math.inf, by_index[index], rmse))
    return found


def main():
    """Print a line per scene and the counts by part; return 1 if the rule trusts a wrong cell.

    With the name of a part, as `new`, only its scenes are counted.
    """
    parts = {"first": [], "new": []}
    chosen = []
    for index, scene in enumerate(scenes()):
        part = "new" if scene.family in NEW else "first"
        if part in (sys.argv[1:] or parts):
            chosen.append((index, scene, part))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "counted.py").write_text(PLUGIN)
        indices = tuple(index for index, _, _ in chosen)
        verdicts = {seed: refused(seed, indices, folder) for seed in SEEDS}
    trusted_scenes = {part: set() for part in parts}
    for index, scene, part in chosen:
        found = outcomes(index, scene, verdicts)
        parts[part] += found
        trusted_scenes[part] |= {index} if any(o.trusted for o in found) else set()
        print(
            f"{scene.family:13}{scene.label:34}{part:13}"
            + "  ".join(f"{o.spread:.2g} {o.refused or '-'} rmse {o.rmse:.2g} {'TRUSTED' if o.trusted else '-'}{' WRONG' if o.trusted and o.wrong else ''}" for o in found),
            flush=True,
        )  # fmt: skip
    for name, cells in parts.items():
        for rule, trusts in (("spread alone", Outcome.trusted_without_search), ("the rule", Outcome.trusted)):
            trusted = [o for o in cells if trusts.fget(o)]
            bad, missed = sum(o.wrong for o in trusted), sum(not o.wrong for o in cells if not trusts.fget(o))
            print(
                f"{name}: {rule} trusts {len(trusted)} of {len(cells)} cells, {bad} of them wrong, and leaves {missed} right ones"
            )
        n = len(trusted_scenes[name])
        print(
            f"{name}: cells of {n} scenes are trusted"
            + (f"; no wrong one: below {100 * (1 - 0.05 ** (1 / n)):.0f}% by scene" if n else "")
        )
    return int(any(o.trusted and o.wrong for cells in parts.values() for o in cells))


if __name__ == "__main__":
    sys.modules["trusted"] = sys.modules[__name__]
    sys.exit(main())
