"""nimblephysics, a bouncing ball: needs NumPy 1, so a Python of its own, $NIMBLE_PYTHON (`make examples` builds it)."""

import json
import os
import subprocess
import sys


def serve():
    """Answer each height [m] and speed [m/s] with the squared distance of the last height to 0.3 m and its gradient."""
    import nimblephysics as nimble
    import torch

    world = nimble.simulation.World()
    world.setTimeStep(4e-3)
    world.setGravity([0.0, -9.81, 0.0])
    for kind, shape in ("Weld", nimble.dynamics.BoxShape([9, 0.2, 9])), ("Prismatic", nimble.dynamics.SphereShape(0.1)):
        joint, body = getattr(skeleton := nimble.dynamics.Skeleton(), f"create{kind}JointAndBodyNodePair")()
        body.createShapeNode(shape).createCollisionAspect()
        body.setRestitutionCoeff(0.8)
        world.addSkeleton(skeleton)
    joint.setAxis([0.0, 1.0, 0.0])
    for line in sys.stdin:
        state = start = torch.tensor(json.loads(line), dtype=torch.float64, requires_grad=True)
        for _ in range(100):
            state = nimble.timestep(world, state, torch.zeros(1))
        (cost := (state[0] - 0.3) ** 2).backward()
        print(json.dumps([cost.item(), start.grad.tolist()]), flush=True)


if sys.argv[1:] == ["serve"]:
    serve()
elif __name__ == "__main__":
    import bench

    words = [os.environ.get("NIMBLE_PYTHON", ".venv-nimble/bin/python"), __file__, "serve"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        ask = lambda x: (print(json.dumps([*x]), file=child.stdin, flush=True), json.loads(child.stdout.readline()))[1]  # noqa: E731
        settings = {"sigma": [0.003, 0.05], "budget": "200s", "name": "nimblephysics"}
        print(bench.examine(lambda x: ask(x)[0], [0.5, -1.0], lambda x: ask(x)[1], **settings))
