"""Newton 1.8.0, Featherstone: the derivative of a free box depends on its position.

A tape of one step without contacts has a derivative of the next angular velocity by the position: in the case ``free_joint``, before the last
step, -0.151 rad/s per metre for the rate about x by y, where differences are 0. Over eight steps the derivative of the cost by x and y is
(-1.364, 1.243) instead of (-0.87, 2.04). Derivatives by the rotation are right. Run it in Newton's environment, with the folder
``bench/engines/conformance`` on the path.
"""

from runner import cases, load

(case,) = cases("free_joint")
engine = load("plugins/engines/newton_conformance.py", "Engine")["Engine"]()
print((engine.gradient(case)["qpos"] @ case.tangent())[:3], case.data["weights"]["qpos"])
