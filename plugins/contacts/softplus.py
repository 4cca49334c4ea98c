"""A penalty spring with its clip smoothed."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, ForceLaw, param


@dataclass(frozen=True)
class Softplus(ForceLaw):
    """The penalty law with max(0, z) replaced by softplus_beta(z) = log(1 + exp(beta z)) / beta.

    ``smooths="clip"``: the outer clip is smoothed, force = softplus_beta(k d + c d') with d = max(0, -gap). A kink
    remains at first touch, and so does a force of log(2)/beta [N] at any distance. The unit of beta is 1/N.
    ``smooths="gap"``: the gap is smoothed, force = max(0, k softplus_beta(-gap) + s c d') with the smoothed contact
    indicator s = 1 / (1 + exp(beta gap)). Without damping, force = k softplus_beta(-gap). The unit of beta is 1/m.
    As beta grows, both tend to ``penalty[damping_mode=clipped]``.
    """

    name = "softplus"
    smoothing = "beta"

    stiffness: float = param(1e3, "k, force per penetration", "N/m", positive=True)
    damping: float = param(0.0, "c, force per penetration rate", "N s/m", low=0.0)
    beta: float = param(1e2, "sharpness of the softplus, per newton with smooths=clip", "1/m", positive=True)
    smooths: str = param("gap", "whether gap and clip or only the clip is smoothed", choices=("gap", "clip"))

    @property
    def continuous(self) -> bool:
        """True with a smoothed gap or without damping: an unsmoothed damper acts immediately at first touch."""
        return self.smooths == "gap" or self.damping == 0.0

    def spring(self) -> tuple[float, float]:
        return self.stiffness, self.damping

    def force(self, xp: Any, gap: Array, gap_rate: Array) -> Array:
        """Return the normal force, never negative."""
        if self.smooths == "clip":
            penetration = xp.where(gap < 0, -gap, 0.0 * gap)
            damper = xp.where(gap < 0, -self.damping * gap_rate, 0.0 * gap)
            return _softplus(xp, self.stiffness * penetration + damper, self.beta)
        penetration = _softplus(xp, -gap, self.beta)
        # exp overflows beyond 709, and the derivative inf / inf would be NaN
        touching = 1.0 / (1.0 + xp.exp(xp.clip(self.beta * gap, -700.0, 700.0)))
        force = self.stiffness * penetration - self.damping * touching * gap_rate
        return xp.where(force > 0, force, 0.0 * force)


def _softplus(xp: Any, z: Array, beta: Any) -> Array:
    # (z + |z|) / 2 instead of xp.where, so that at z = 0 the derivatives of both terms add up to the correct 1/2
    return 0.5 * (z + xp.abs(z)) + xp.log1p(xp.exp(-beta * xp.abs(z))) / beta
