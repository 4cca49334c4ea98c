"""Writes the numbers of the conformance set for differentiable simulators: ``python validation/conformance_set.py [CASE ...]``.

The inputs of a case are in its files: the model, the start, the controls, the parameter and the weights. From these come
its value and derivatives by up to four sources that have to agree, and the numbers that typical faults give.
"""

import dataclasses
import json
import re
import sys

import mujoco
import numpy as np
from bench.plugins.engines.mujoco_conformance import TERMS
from bench.plugins.engines.mujoco_conformance import Engine as MujocoC

from bench.engines import conformance

STEP = 1e-6
"""Step of the differences of single terms."""
VISIBLE = 1e-3
"""Smallest change of a term, relative to its size, that makes a fault's number part of the set."""
BY_TERMS = ("sign of equality", "dropped J-dot v", "frozen normal", "stale velocity")
"""Faults of a derivative by terms, whose value is right."""


class ByTerms:
    """The implicit-function theorem for a step of MuJoCo's C engine, from differences of single terms, with a planted fault.

    The acceleration a solves M a = s + J^T f(J a - r, D), with the smooth forces s, reference accelerations r and
    constraint masses D. Where the state changes, H da = ds - dM a + dJ^T f - J^T W (dJ a - dr) + J^T f dD / D with the
    force law's slope -W and H = M + J^T W J. For the integrator Euler without damping.
    """

    def __init__(self, fault=""):
        self._fault, self._engine = fault, MujocoC()

    def rollout(self, case):
        """Return the C engine's cost."""
        return self._engine.rollout(case)

    def gradient(self, case):
        """Return the derivatives by state and controls."""
        model, data = self._engine.start(case)
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        steps, before = [], case.qvel
        for control in case.controls:
            data.ctrl = control
            q, v = data.qpos.copy(), data.qvel.copy()
            mujoco.mj_step(model, data)
            stale = before if self._fault == "stale velocity" else v
            steps.append(self._derivatives(model, (q, v, control), data.qacc_warmstart.copy(), stale))
            before = v
        end = dataclasses.replace(case, qpos=data.qpos.copy())
        up = np.concatenate([case.data["weights"]["qpos"] @ end.tangent(), case.data["weights"]["qvel"]])
        by_control = []
        for a, b in reversed(steps):
            by_control.insert(0, up @ b)
            up = up @ a
        return {"qpos": up[: model.nv], "qvel": up[model.nv :], "controls": np.array(by_control)}

    def _derivatives(self, model, at, warm, stale):
        """Return the derivatives of the next state by the state and by the controls."""
        data, nv, nu = mujoco.MjData(model), model.nv, model.nu
        q, v, u = at
        data.qpos, data.qvel, data.ctrl, data.qacc_warmstart = q, v, u, warm
        mujoco.mj_forward(model, data)
        a, force, frames = data.qacc.copy(), data.efc_force.copy(), data.contact.frame.copy()
        jac = self._jacobian(model, data)
        slope = self._slope(model, data, jac)  # before the terms, which overwrite it
        mass, *_ = self._terms(model, data, q, v, u)
        hessian = mass + jac.T @ slope @ jac
        acts = np.abs(slope).sum(axis=1) > 0
        by = np.zeros((nv, 2 * nv + nu))
        for i in range(2 * nv + nu):
            ends = []
            for h in (STEP, -STEP):
                change = h * np.eye(2 * nv + nu)[i]
                moved = q.copy()
                mujoco.mj_integratePos(model, moved, change[:nv], 1.0)
                fixed = frames if self._fault == "frozen normal" else None
                inputs = (moved, stale + change[nv : 2 * nv], u + change[2 * nv :])
                ends.append(self._terms(model, data, *inputs, fixed))
            d_mass, d_smooth, d_jac, d_ref, d_logs, d_bias = (
                (one - two) / (2 * STEP) for one, two in zip(*ends, strict=True)
            )
            if self._fault == "dropped J-dot v":
                d_ref = d_ref - d_bias
            if self._fault == "sign of equality":
                d_ref = np.where(data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY, -d_ref, d_ref)
            right = d_smooth - d_mass @ a + d_jac.T @ force - jac.T @ (slope @ (d_jac @ a - d_ref))
            by[:, i] = np.linalg.solve(hessian, right + jac.T @ (force * acts * d_logs))
        by_v = np.hstack([np.zeros((nv, nv)), np.eye(nv), np.zeros((nv, nu))]) + model.opt.timestep * by
        after = q.copy()
        mujoco.mj_integratePos(model, after, v + model.opt.timestep * a, model.opt.timestep)
        by_q = np.zeros_like(by)
        for i in range(2 * nv + nu):
            for h in (STEP, -STEP):
                moved, shift = q.copy(), np.zeros(nv)
                mujoco.mj_integratePos(model, moved, h * np.eye(nv, 2 * nv + nu)[:, i], 1.0)
                mujoco.mj_integratePos(model, moved, v + model.opt.timestep * a + h * by_v[:, i], model.opt.timestep)
                mujoco.mj_differentiatePos(model, shift, 1.0, after, moved)
                by_q[:, i] += shift / (2 * h)
        return np.vstack([by_q, by_v])[:, : 2 * nv], np.vstack([by_q, by_v])[:, 2 * nv :]

    def _terms(self, model, data, q, v, u, frames=None):
        """Return M, s, J, r, log D and the share of r that is -dJ/dt v, with contact ``frames`` in place of their own."""
        data.qpos, data.qvel, data.ctrl = q, v, u
        mujoco.mj_fwdPosition(model, data)
        if frames is not None:
            data.contact.frame[:] = frames
            mujoco.mj_makeConstraint(model, data)
            mujoco.mj_projectConstraint(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        k, b, imp, _ = data.efc_KBIP.reshape(-1, 4).T
        law = -b * data.efc_vel - k * imp * (data.efc_pos - data.efc_margin)
        jac, reference = self._jacobian(model, data), data.efc_aref.copy()
        return mass, data.qfrc_smooth.copy(), jac, reference, np.log(data.efc_D), reference - law

    @staticmethod
    def _slope(model, data, jac):
        """Return W: the constraint masses of rows that act, and the Hessians of elliptic contacts that slide."""
        spring = -data.efc_D * (jac @ data.qacc - data.efc_aref)
        acts = (data.efc_force != 0) & (np.abs(data.efc_force - spring) <= 1e-6 * np.abs(data.efc_force))
        slope = np.diag(np.where(acts, data.efc_D, 0.0))
        for contact in data.contact:
            rows = slice(contact.efc_address, contact.efc_address + contact.dim)
            is_cone = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and contact.efc_address >= 0
            if is_cone and data.efc_force[rows].any() and not acts[rows].all():
                slope[rows, rows] = np.reshape(contact.H, -1)[: contact.dim**2].reshape(contact.dim, contact.dim)
        return slope

    @staticmethod
    def _jacobian(model, data):
        """Return J, which is dense for models of this size."""
        return data.efc_J.reshape(data.nefc, model.nv).copy()


def closed_form(case):
    """Return the derivatives of cases whose motion along one coordinate is linear, by term and component."""
    stiffness, damping, width = 1 / (0.9 * 0.02) ** 2, 2 / (0.9 * 0.02), 0.9
    laws = {
        "position_servo": (0, -50 / 2, -20 / 2, 50 / 2, 1 / 2),
        "damped_joint": (0, -50 / 2.58, -20 / 2.58, 3 / 2.58, 3 / 2.58),
        "implicitfast": (0, -50 / 2.08, -20 / 2.08, 50 / 2.08, 1 / 2.08),
        "condim1": (2, -(width**2) * stiffness, -width * damping, 1 - width, 1 - width),
        "free_joint": (2, 0.0, 0.0, 1.0, 1.0),
    }
    if case.name not in laws:
        return {}
    at, by_q, by_v, by_u, by_p = laws[
        case.name
    ]  # the acceleration's derivatives, by_p times the control for a servo's gain
    dt, weights = 0.004, case.data["weights"]
    up, controls, parameter = np.array([weights["qpos"][at], weights["qvel"][at]]), [], 0.0
    for control in case.controls[::-1, 0]:
        push = dt * (up[1] + dt * up[0])
        controls.insert(0, push * by_u)
        parameter += push * by_p * (control if at == 0 else 1.0)
        up = np.array([up[0] + push * by_q, up[1] + dt * up[0] + push * by_v])
    found = {"qpos": {at: up[0]}, "qvel": {at: up[1]}, "parameter": {0: parameter}}
    return found if case.name == "free_joint" else found | {"controls": dict(enumerate(controls))}


def off(result, expected):
    """Return the largest difference, relative to the largest component that is expected."""
    return float(np.abs(np.ravel(result) - np.ravel(expected)).max() / np.abs(expected).max())


def along(case, result):
    """Return derivatives with those by qpos by velocities."""
    if result["qpos"].size > case.qvel.size:
        result["qpos"] = result["qpos"] @ case.tangent()
    return result


def seen(case, result, expected):
    """Return a fault's numbers of the terms that it changes."""
    result = along(case, result)
    return {term: flat(value) for term, value in result.items() if off(value, expected[term]) > VISIBLE}


def one_iteration_of_mjx(mjx, case, expected):
    """Return the numbers of MJX with one iteration, whose line search is its own."""
    once = type(mjx)(is_implicit=False, iterations=1)
    return seen(case, {"value": np.array(once.rollout(case))} | once.gradient(case), expected)


def numbers(case, mjx=None):
    """Return the expected value and derivatives, their certainty, the sources' disagreement, and the faults' numbers."""
    engine = MujocoC()
    expected, certainty = {"value": np.array(engine.rollout(case))}, {"value": 1e-12}
    for term in TERMS:
        expected[term], doubts = case.differences(engine, term)
        certainty[term] = float(doubts.max())
    sources = {"differences of MuJoCo C": {}}
    model, _ = engine.start(case)
    is_euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and not model.dof_damping.any()
    others = {"implicit-function theorem by terms of MuJoCo C": ByTerms().gradient(case)} if is_euler else {}
    has_mjx = mjx is not None and case.name not in mjx.differs
    if has_mjx:
        others["MJX, implicit"] = {"value": np.array(mjx.rollout(case))} | along(case, mjx.gradient(case))
    for source, result in others.items():
        sources[source] = {term: off(value, expected[term]) for term, value in result.items()}
    for term, components in closed_form(case).items():
        distance = max(abs(value - expected[term][i]) for i, value in components.items())
        sources.setdefault("closed form", {})[term] = distance / np.abs(expected[term]).max()
    exact = others.get("MJX, implicit", {})
    for term in TERMS:
        sources["differences of MuJoCo C"][term] = certainty[term] / np.abs(expected[term]).max()
        if term in exact:
            certainty[term] = float(np.abs(np.ravel(exact[term]) - expected[term]).max())
            expected[term] = np.ravel(exact[term])
    faults = {fault: ByTerms(fault).gradient(case) for fault in BY_TERMS} if is_euler else {}
    planted = {"one iteration": MujocoC(iterations=1), "impratio ignored": MujocoC(impratio=1.0)}
    for fault, other in planted.items():
        faults[fault] = {"value": np.array(other.rollout(case))} | other.gradient(case)
    visible = {fault: seen(case, result, expected) for fault, result in faults.items()}
    if has_mjx and visible["one iteration"] and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        visible["one iteration of MJX"] = one_iteration_of_mjx(mjx, case, expected)
    return {
        "expected": {term: flat(value) for term, value in expected.items()},
        "certainty": {term: float(f"{value:.1e}") for term, value in certainty.items()},
        "sources": {
            name: {term: float(f"{value:.1e}") for term, value in off_.items()} for name, off_ in sources.items()
        },
        "faults": {fault: result for fault, result in visible.items() if result},
        "not_available": [] if is_euler else list(BY_TERMS),
        "versions": engine.versions | (mjx.versions if mjx else {}),
    }


def flat(value):
    """Return a number, or a flat list."""
    return float(value) if np.ndim(value) == 0 else [float(number) for number in np.ravel(value)]


def main(*names):
    """Write the numbers into the files of the named cases, or of all."""
    from bench.plugins.engines.mjx_conformance import Engine as Mjx

    mjx = Mjx()
    for case in conformance.cases(*names):
        inputs = ("mechanism", "qpos", "qvel", "quaternions", "controls", "parameter", "weights")
        data = {key: case.data[key] for key in inputs} | numbers(case, mjx)
        text = re.sub(
            r"\[\s+([^][{}]*?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", json.dumps(data, indent=1)
        )
        case.model.with_suffix(".json").write_text(text + "\n")
        print(case.name, data["sources"], *data["faults"], flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
