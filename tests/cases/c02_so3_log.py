"""kornia #4007 and #4404, pytorch3d #189: rotation logarithm by acos(clamp(w)) at the identity: NaN gradient.

theta is a quaternion (w, x, y, z) at the identity. Cost: |log(q) - target|^2 with target = (0.1, 0.2, -0.1), forward value
finite by a guarded division. RIGHT at q = (1, 0, 0, 0): with w = 1 held the angle is 0, so the cost is constant in v, and with
v = 0 held it is constant in w: all four derivatives of this program are 0 (closed form), and autograd gives NaN. ``smooth``
has d/dv = -4 target.
"""

import torch

theta = [1.0, 0.0, 0.0, 0.0]
target = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)


def cost(q):
    v = q[1:]
    size = torch.sqrt(torch.sum(v * v))
    angle = 2 * torch.acos(torch.clamp(q[0], -1.0, 1.0))
    scale = torch.where(size < 1e-12, torch.full_like(size, 2.0), angle / torch.clamp(size, min=1e-30))
    return torch.sum((scale * v - target) ** 2)


def smooth(q):
    """The same logarithm by atan2(|v|, w), as written by the maintainers' fix: right gradient -4 target."""
    v = q[1:]
    n2 = torch.sum(v * v)
    safe = torch.where(n2 > 1e-24, n2, torch.ones_like(n2))
    scale = torch.where(n2 > 1e-24, 2 * torch.atan2(torch.sqrt(safe), q[0]) / torch.sqrt(safe), 2 / q[0])
    return torch.sum((scale * v - target) ** 2)
