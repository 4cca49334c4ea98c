"""A torch simulator as a module: a pushed block with friction, whose clamp in place hides from autograd."""

import torch


class Block(torch.nn.Module):
    """Pushed for half a second, then sliding to rest on a floor with regularised friction."""

    def __init__(self, in_place: bool) -> None:
        super().__init__()
        self.in_place = in_place

    def forward(self, push):
        """Return the squared distance to 0.5 m for a push that grows with time."""
        x = v = torch.zeros((), dtype=push.dtype)
        for t in range(60):
            force = push[0] + push[1] * t / 60 if t < 30 else torch.zeros((), dtype=push.dtype)
            v = v + 0.02 * (force - 2.0 * torch.tanh(v / 0.05))
            if self.in_place:
                v = v.clone()
                v.data.clamp_(max=0.8)
            x = x + 0.02 * v
        return (x - 0.5) ** 2


theta = [4.0, 1.0]
cost = Block(in_place=False)
clamped = Block(in_place=True)


if __name__ == "__main__":
    import bench

    for module in (cost, clamped):
        print(bench.examine(module, theta, grad="torch", sigma=0.1, budget="60s"), end="\n\n")
