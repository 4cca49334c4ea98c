"""MuJoCo Warp: the scene's twin in MuJoCo's engine on Warp, without derivatives, in a Python of its own."""

from dataclasses import dataclass

from bench.engines.backend import EngineBackend
from bench.model import param


@dataclass(frozen=True)
class MujocoWarp(EngineBackend):
    """No gradients: zeroth-order estimators only; float32. A contact cancels a share ``impedance`` of all other forces."""

    name = "mujoco_warp"
    file = "../engines/mujoco_warp.py"
    reads_mjcf = True
    damping_mode = "clipped"
    libraries = ("mujoco-warp", "warp-lang", "mujoco", "numpy")
    provides = frozenset({"value", "score", "physics"})

    dtype: str = param("float32", "floating-point type of the simulation", choices=("float32",))
    impedance: float = param(1e-3, "share of other forces that a contact cancels", low=1e-4, high=0.9999)
