"""The bodies of a twin's MJCF, for engines that read it."""

import xml.etree.ElementTree as ElementTree


def bodies(program):
    """Return the root of the twin's MJCF without motors, springs and dampers, whose forces are inputs."""
    root = ElementTree.fromstring(f'<mujoco model="twin"><option gravity="0 0 0"/>{program["mjcf"]}</mujoco>')
    for tag in ("actuator", "tendon"):
        for node in root.findall(tag):
            root.remove(node)
    for joint in root.iter("joint"):
        joint.attrib.pop("damping", None)
        joint.attrib.pop("stiffness", None)
    return root
