"""Checks of contact laws on two masses over a floor, and in rollouts of the registered scenes."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.conformance.kit import require, skip_unless, verifies
from bench.conformance.subjects import (
    ROUNDED,
    BareScene,
    NewtonOps,
    distance,
    largest_jump,
    law_for,
    rng,
    sound_scenes,
    stepping,
)
from bench.model import Array, ContactLaw, ContactScene, ForceLaw, ImpulseLaw, Ops, State, compose


@dataclass(frozen=True)
class _Tower(BareScene, ContactScene):
    """Two masses, one above the other, over a floor: two contacts that share a body."""

    name = "conformance_tower"
    n_q = 2
    n_contacts = 2
    masses: ClassVar[tuple[float, float]] = (0.5, 2.0)

    def gap(self, xp: Any, q: Array) -> Array:
        return xp.stack([q[0], q[1] - q[0] - 1.0])

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        return xp.stack([v[0], v[1] - v[0]])

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        return xp.stack([(force[0] - force[1]) / self.masses[0], force[1] / self.masses[1]])


PUSH_DT = 0.01


def _push(law: ContactLaw, gap: Any, rate: Any, ops: Ops | None = None) -> np.ndarray:
    """Return the normal impulses of a tower's two contacts over 0.01 s [N s], for gaps and gap rates, all ``(2, B)``."""
    gaps, rates = (np.asarray(part, dtype=float).reshape(2, -1) for part in (gap, rate))
    if isinstance(law, ForceLaw):
        return PUSH_DT * law.force(np, gaps, rates)
    assert isinstance(law, ImpulseLaw)
    scene = _Tower()
    before = State(np.stack([gaps[0], gaps[0] + gaps[1] + 1.0]), np.stack([rates[0], rates[0] + rates[1]]))
    free = State(before.q + PUSH_DT * before.v, before.v)
    change = law.impulse(ops or NewtonOps(), scene.contact(np), before, free, PUSH_DT).v
    upper = scene.masses[1] * change[1]
    return np.stack([scene.masses[0] * change[0] + upper, upper])


SEPARATED = ([[0.05, 0.2, 1.0], [0.05, 0.2, 1.0]], [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Gaps [m] and gap rates [m/s], by contact, of bodies that do not meet within the step."""


def _sharpened(law: ContactLaw, factor: float) -> ContactLaw:
    """Return the law with its smoothing multiplied or divided by ``factor``, whichever pushes less at a distance."""
    value = getattr(law, law.smoothing)
    changed = [dataclasses.replace(law, **{law.smoothing: value * f}) for f in (factor, 1 / factor)]
    return min(changed, key=lambda one: np.abs(_push(one, *SEPARATED)).max())


@verifies(ContactLaw)
def does_not_push_from_afar(law: ContactLaw) -> str:
    """Verify that separated bodies get no force, or, under a smoothed law, a force that vanishes with the smoothing."""
    push = np.abs(_push(law, *SEPARATED)).max() / PUSH_DT
    if not law.smoothing:
        require(push == 0, f"a force of {push:.3g} N on separated bodies")
        return "no force on separated bodies"
    sharp = np.abs(_push(_sharpened(law, 100.0), *SEPARATED)).max() / PUSH_DT
    detail = f"{push:.2g} N at 5 cm or more, {sharp:.2g} N at 100 times sharper {law.smoothing}"
    require(sharp <= 0.05 * push + 1e-12, detail)
    return detail


@verifies(ContactLaw)
def pushes_in_contact(law: ContactLaw) -> str:
    """Verify that bodies that overlap and approach are pushed apart, and no less by a faster approach."""
    push = _push(law, [[-0.01] * 3, [1.0] * 3], [[-1.0, -2.0, -4.0], [0.0] * 3])[0] / PUSH_DT
    require((push > 0).all(), f"forces of {push.round(3).tolist()} N on bodies that overlap and approach: it pulls")
    require((np.diff(push) >= -1e-9 * push.max()).all(), f"a faster approach lowers the force: {push.tolist()} N")
    return f"{push.min():.3g} to {push.max():.3g} N at 1 cm overlap"


@verifies(ForceLaw)
def force_grows_with_penetration(law: ForceLaw) -> str:
    """Verify that at rest the force is repulsive and grows with penetration."""
    depth = np.linspace(0.001, 0.1, 40)
    force = law.force(np, np.stack([-depth, -depth]), np.zeros((2, depth.size)))
    require(force.shape == (2, depth.size), f"shape {force.shape}, not {(2, depth.size)}")
    require((force > 0).all(), f"a force of {force.min():.3g} N in penetration: it pulls")
    require((np.diff(force) > 0).all(), "a deeper penetration does not give a larger force")
    return f"{force.min():.3g} N at 1 mm to {force.max():.3g} N at 10 cm"


@verifies(ForceLaw)
def contacts_are_separate(law: ForceLaw) -> str:
    """Verify that the force of one contact does not depend on the gap and gap rate of another."""
    draw = rng("separate")
    gap, rate = 0.02 * draw.standard_normal((2, 50)), draw.standard_normal((2, 50))
    together = law.force(np, gap, rate)
    alone = np.concatenate([law.force(np, gap[i : i + 1], rate[i : i + 1]) for i in range(2)])
    require(distance(together, alone) < ROUNDED, "two contacts together differ from each contact separately")
    return "2 contacts equal to each separately"


@verifies(ContactLaw)
def smoothing_converges(law: ContactLaw) -> str:
    """Verify that forces converge as smoothing decreases by factors of 10."""
    skip_unless(law.smoothing, "has no smoothing")
    gaps = np.array([[-0.05, -0.01, -0.001, 0.0, 0.001, 0.01, 0.05], [1.0] * 7])
    forces = [_push(_sharpened(law, 10.0**k), gaps, 0 * gaps)[0] / PUSH_DT for k in range(5)]
    changes = [float(np.abs(b - a).max()) for a, b in itertools.pairwise(forces)]
    detail = "changes of " + ", ".join(f"{c:.2g}" for c in changes) + " N"
    require(changes[-1] <= 0.2 * changes[0] + 1e-9 * np.abs(forces[-1]).max(), f"{detail} do not fall")
    return detail


@verifies(ImpulseLaw)
def impulse_keeps_momentum(law: ImpulseLaw) -> str:
    """Verify that bodies that meet in the air get equal and opposite impulses, and do not approach afterwards."""
    sharp = _sharpened(law, 1e4) if law.smoothing else law
    rate = np.array([[0.0, 0.3, -0.2], [-1.0, -3.0, -0.5]])
    push = _push(sharp, [[1.0] * 3, [0.0] * 3], rate)
    require((push[1] > 0).all(), f"impulses of {push[1].round(4).tolist()} N s on bodies that meet: it pulls")
    lost = np.abs(push[0]).max() / push[1].max()
    require(lost < 1e-3, f"{lost:.1e} of the impulse changes the momentum of the pair")
    after = rate[1] + push[1] * sum(1 / m for m in _Tower.masses)
    require((after > -1e-6).all(), f"after the impact the gap changes at {after.min():.3g} m/s: still approaching")
    return f"momentum to {lost:.0e}, gap rates from {rate[1].min():g} m/s to {after[1]:.3g} m/s"


@verifies(ContactLaw)
def needs_root_of_law_is_truthful(law: ContactLaw) -> str:
    """Verify that the law solves an equation if and only if it declares ``needs_root``."""
    ops = NewtonOps()
    _push(law, [[-0.01], [1.0]], [[-1.0], [0.0]], ops)
    require(
        bool(ops.solved) == law.needs_root, f"needs_root is {law.needs_root}, but {ops.solved} equations were solved"
    )
    return f"{ops.solved} equations a step"


@verifies(ContactLaw)
def continuity_in_rollouts_is_as_declared(law: ContactLaw) -> str:
    """Verify that costs of continuous scenes do not jump along theta if ``continuous``, and jump in some scene if not."""
    values = {f.name: getattr(law, f.name) for f in dataclasses.fields(law) if getattr(law, f.name) != f.default}
    scenes = [s for s in sound_scenes() if isinstance(s, ContactScene) and s.continuous]
    jumps: dict[bool, dict[str, float]] = {True: {}, False: {}}
    for scene in scenes:
        program = compose(scene, law_for(scene, type(law), values), stepping())
        jumps[program.continuous][scene.name] = largest_jump(program)
    details = []
    for continuous, sizes in jumps.items():
        if not sizes:
            continue
        name, jump = max(sizes.items(), key=lambda item: item[1])
        if continuous:
            require(not jump, f"declares to be continuous, but {name} jumps by {jump:.1e} of its range")
            details.append(f"no jump in {', '.join(sizes)}")
        else:
            require(jump, f"declares to jump, but no jump was found in {', '.join(sizes)}")
            details.append(f"a jump of {jump:.2g} of the range in {name}")
    skip_unless(details, "no continuous scene with contacts is registered")
    return "; ".join(details)
