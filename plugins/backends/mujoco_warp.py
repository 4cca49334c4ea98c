"""MuJoCo Warp: the scene's twin in MuJoCo's engine on Warp, without derivatives, in a Python of its own."""

from dataclasses import dataclass
from typing import Any

from bench.engines.backend import EngineBackend
from bench.model import Program, param

from ..contacts.penalty import Penalty


@dataclass(frozen=True)
class MujocoWarp(EngineBackend):
    """No gradients: zeroth-order estimators only; float32. A contact cancels a share ``impedance`` of all other forces."""

    name = "mujoco_warp"
    file = "../engines/mujoco_warp.py"
    helpers = ("mujoco_twin.py",)
    libraries = ("mujoco-warp", "warp-lang", "mujoco", "numpy")
    provides = frozenset({"value", "score", "physics"})

    dtype: str = param("float32", "floating-point type of the simulation", choices=("float32",))
    impedance: float = param(1e-3, "share of other forces that a contact cancels", low=1e-4, high=0.9999)

    def unsupported_twin(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why the engine cannot run the program: a damper that pulls; or None."""
        law = program.contact
        if isinstance(law, Penalty) and law.damping and law.damping_mode != "clipped":
            return f"mujoco_warp's contacts never pull: it supports damping_mode=clipped only, not {law.damping_mode}"
        return None
