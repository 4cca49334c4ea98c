"""Base of robots with a torso on four legs, which end in feet with friction over a plane."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from bench.model import EngineScene, param


@dataclass(frozen=True)
class Legged(EngineScene):
    """A torso on slides and hinges, q = (x, y, z, yaw, pitch, roll, joints of the legs), for physics engines only."""

    neglected_effects = "joint limits, torque limits, self-collision, contacts other than the feet"
    n_contacts = 4
    legs: ClassVar[tuple[str, ...]]
    """Names of the legs; each leg's foot is the geom of that name."""
    joints: ClassVar[tuple[str, ...]]
    """Names of a leg's joints, each with a motor, from the torso to the foot."""
    torso: ClassVar[str]
    """Shape and size of the torso, as attributes of MJCF."""

    dt: float = 0.005
    mass: float = param(2.0, "mass of the torso", "kg", positive=True)
    leg_mass: float = param(0.2, "mass of a thigh and of a shank", "kg", positive=True)
    link: float = param(0.2, "length of a thigh", "m", positive=True)
    armature: float = param(0.02, "inertia of a motor, as seen from its joint", "kg m^2", low=0.0)
    friction: float = param(1.0, "Coulomb coefficient", low=0.0)
    gravity: float = param(9.81, "gravitational acceleration", "m/s^2", positive=True)

    clearance: float = param(
        1e-6,
        "height of the feet above the ground at the start, above rounding",
        "m",
        positive=True,
    )

    @property
    def foot_radius(self) -> float:
        """The radius of a foot [m]."""
        return 0.1 * self.link

    @abstractmethod
    def leg(self, name: str) -> str:
        """Return the body of a leg as MJCF, with motors' joints ``name_joint`` and the foot ``name``."""

    def mjcf(self) -> str:
        pairs = "".join(
            f'<pair geom1="ground" geom2="{leg}" condim="3" friction="{self.friction} {self.friction} 1 1 1"/>'
            for leg in self.legs
        )
        motors = "".join(f'<motor joint="{leg}_{joint}"/>' for leg in self.legs for joint in self.joints)
        return f"""
            <option gravity="0 0 {-self.gravity}"/>
            <default>
              <geom contype="0" conaffinity="0"/>
              <default class="motor"><joint armature="{self.armature}"/></default>
            </default>
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body>
                <joint name="x" type="slide" axis="1 0 0"/>
                <joint name="y" type="slide" axis="0 1 0"/>
                <joint name="z" type="slide" axis="0 0 1"/>
                <joint name="yaw" type="hinge" axis="0 0 1"/>
                <joint name="pitch" type="hinge" axis="0 1 0"/>
                <joint name="roll" type="hinge" axis="1 0 0"/>
                <geom {self.torso} mass="{self.mass}"/>
                {"".join(self.leg(leg) for leg in self.legs)}
              </body>
            </worldbody>
            <contact>{pairs}</contact>
            <actuator>{motors}</actuator>"""
