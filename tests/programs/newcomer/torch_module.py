import torch

import bench


class Policy(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Linear(2, 1, bias=False).double()

    def forward(self, weight):
        state = torch.tensor([1.0, 0.0], dtype=torch.float64)
        for _ in range(100):
            force = torch.nn.functional.linear(state, weight).squeeze(0)
            speed = state[1] + 0.02 * (force - state[0])
            state = torch.stack([state[0] + 0.02 * speed, speed])
        return state @ state


policy = Policy()
print(bench.examine(policy, policy.gain.weight.detach().numpy(), grad="torch"))
