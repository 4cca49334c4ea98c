"""nimblephysics: rigid bodies with contact by a complementarity problem, and its Jacobians, a column at a time."""

import nimblephysics as nimble
import numpy as np

DEEP = 10.0
"""Size [m] of the box that is the ground."""


class Model:
    """A twin as a world."""

    takes_forces = True

    def __init__(self, program):
        self._world = world = nimble.simulation.World()
        world.setTimeStep(program["dt"])
        world.setGravity(program["gravity"])
        self._restitution = program["parameters"].get("restitution", 0.0)
        touching = {body for contact in program["contacts"] for body in contact["bodies"]}
        if program["has_ground"]:
            skeleton = nimble.dynamics.Skeleton()
            joint, body = skeleton.createWeldJointAndBodyNodePair()
            self._place(joint, [0.0, 0.0, -DEEP / 2])
            self._shape(body, nimble.dynamics.BoxShape([DEEP, DEEP, DEEP]))
            world.addSkeleton(skeleton)
        links, skeletons = [], []
        for i, given in enumerate(program["bodies"]):
            is_root = given["parent"] < 0
            skeleton = nimble.dynamics.Skeleton() if is_root else skeleton
            create = getattr(
                skeleton, f"create{'Prismatic' if given['joint'] == 'slide' else 'Revolute'}JointAndBodyNodePair"
            )
            joint, body = create() if is_root else create(links[given["parent"]])
            axis = np.array(given["axis"])
            joint.setAxis(axis / np.linalg.norm(axis))
            x, y, z = given["inertia"]
            offset = np.array(given["com"]) - given["centre"]
            inertia = nimble.dynamics.Inertia(given["mass"], offset, np.diag([x, y, z]))
            body.setInertia(inertia)
            self._place(joint, given["centre"])  # the body's frame is at its sphere
            if i in touching:
                self._shape(body, nimble.dynamics.SphereShape(given["radius"]))
            else:
                body.setCollidable(False)
            links.append(body)
            if is_root:
                skeletons.append(skeleton)
        for skeleton in skeletons:
            world.addSkeleton(skeleton)

    def _place(self, joint, position):
        pose = nimble.math.Isometry3()
        pose.set_translation(np.array(position))
        joint.setTransformFromParentBodyNode(pose)

    def _shape(self, body, shape):
        body.createShapeNode(shape).createCollisionAspect()
        body.setRestitutionCoeff(self._restitution)
        body.setFrictionCoeff(0.0)

    def _run(self, x, u):
        self._world.setState(x)
        self._world.setControlForces(u)
        self._world.setCachedLCPSolution(np.zeros(0))
        return nimble.neural.forwardPass(self._world, False)

    def step(self, x, u):
        """Return the states after one step."""
        after = np.empty_like(x)
        for c in range(x.shape[1]):
            self._run(x[:, c], u[:, c])
            after[:, c] = self._world.getState()
        return after

    def jacobians(self, x, u):
        """Return nimblephysics' derivatives of one step."""
        a, b = np.empty((len(x), len(x), x.shape[1])), np.empty((len(x), len(u), x.shape[1]))
        for c in range(x.shape[1]):
            snapshot = self._run(x[:, c], u[:, c])
            a[..., c] = snapshot.getStateJacobian(self._world)
            b[..., c] = snapshot.getActionJacobian(self._world)
        return a, b
