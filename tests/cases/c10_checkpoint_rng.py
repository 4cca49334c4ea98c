"""guided-diffusion #167, pytorch #190758: checkpointing recomputes a random block in the backward pass with other numbers.

Ten steps of a driven oscillator, kicks drawn from torch's generator seeded at the start of the cost (so it repeats exactly).
The checkpointed step draws again when it is recomputed. RIGHT: ``plain`` (no checkpoint), the derivative of the same numbers.
"""

import torch

theta = [0.5, -0.3, 0.7]


class Checkpoint(torch.autograd.Function):
    @staticmethod
    def forward(context, block, *state):
        context.block = block
        context.save_for_backward(*state)
        with torch.no_grad():
            return block(*state)

    @staticmethod
    def backward(context, *slopes):
        state = [s.detach().requires_grad_() for s in context.saved_tensors]
        with torch.enable_grad():
            out = context.block(*state)  # new random numbers
        return (None, *torch.autograd.grad(out, state, slopes))


def block(q, v, k):
    mask = (torch.rand((), dtype=torch.float64) > 0.3) / 0.7
    v = v - 0.1 * k * torch.sin(q) * mask
    return q + 0.1 * v, v, k * 1


def rollout(x, step):
    torch.manual_seed(0)
    state = (x[0], x[1], x[2])
    for _ in range(10):
        state = step(*state)
    return (state[0] - 1) ** 2 + 0.1 * state[1] ** 2


def cost(x):
    return rollout(x, lambda *s: Checkpoint.apply(block, *s))


def plain(x):
    return rollout(x, block)
