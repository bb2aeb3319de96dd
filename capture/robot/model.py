"""What a robot is: the model that a robot TOML describes.

The chain runs from the head to the tail everywhere in undulog: ``links[0]`` is the head,
``joints[i]`` joins ``links[i]`` to ``links[i + 1]``. A link's frame sits at its centre, x
forward (out of the head), y left, z up. At zero angle all frames are parallel and link
``i + 1`` lies behind link ``i``. A horizontal joint turns about z (yaw), a vertical one about y
(pitch); the angle is that of the rear link relative to the front link, right-handed.

How far a robot may be driven: the ``safety`` of a robot description.

Nothing here has a default that matters: a limit that the file does not give is None, and a robot
that lacks one that arming needs is not driven (:func:`missing_limits`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated

import numpy as np

from ..common.arrays import FloatArray, IntArray, frozen
from ..common.config import Count, Name, NonNegative, Positive
from ..common.strict_table import NONZERO, above, at_least, at_most

JOINT_LIMITS = (
    "max_rate",
    "ramp_rate",
    "max_tracking_error",
    "max_current",
    "max_temperature",
    "min_voltage",
)
"""The limits that a single joint may have otherwise."""


class OnFault(StrEnum):
    """What the joints do when a drive has to end early."""

    HOLD = "hold"
    RAMP_DOWN = "ramp-down"


@dataclass(frozen=True)
class Safety:
    """Limits of driving a robot over its bus.

    Attributes:
        max_rate: Greatest rate of a command [rad/s].
        ramp_rate: Greatest rate of a command on the way to the first pose, and down [rad/s].
        max_tracking_error: Greatest distance of a measured angle from its command [rad].
        max_current: Greatest current of a servo [A].
        max_temperature: Greatest temperature of a servo [degC].
        min_voltage: Least supply voltage of a servo [V].
        reply_timeout_s: Time without a reply after which a joint is lost [s].
        max_late_s: So late a control tick may be [s].
        fault_after_s: Tracking error and current are a fault when they last so long [s].
        on_fault: How a drive ends that has to end early.
        of: Limits that single joints have otherwise: joint, limit, value.
    """

    max_rate: Positive | None = None
    ramp_rate: Positive | None = None
    max_tracking_error: Positive | None = None
    max_current: Positive | None = None
    max_temperature: float | None = None
    min_voltage: Positive | None = None
    reply_timeout_s: Positive | None = None
    max_late_s: Positive | None = None
    fault_after_s: Positive = 0.3
    on_fault: OnFault = OnFault.RAMP_DOWN
    of: tuple[tuple[str, str, float], ...] = ()

    def values(self, limit: str, joint_names: tuple[str, ...]) -> FloatArray:
        """Return one limit of each joint.

        Args:
            limit: One of :data:`JOINT_LIMITS`.

        Returns:
            Shape (m,); NaN where there is none.
        """
        common: float | None = getattr(self, limit)
        by_joint = {joint: value for joint, name, value in self.of if name == limit}
        fallback = math.nan if common is None else common
        return frozen(np.array([by_joint.get(name, fallback) for name in joint_names]))


class Seat(StrEnum):
    """Where a servo's velocity and effort are measured."""

    LOOP = "loop"
    JOINT = "joint"


class Plane(StrEnum):
    """The plane in which a joint bends the body."""

    HORIZONTAL = "horizontal"
    VERTICAL = "vertical"


class ClockDomain(StrEnum):
    """Whose clock stamps the robot's samples."""

    HOST = "host"
    DEVICE = "device"
    SIMULATED = "simulated"


class SensorKind(StrEnum):
    """Kind of sensor."""

    IR = "ir"
    SONAR = "sonar"
    ACCELEROMETER = "accelerometer"
    COMPASS = "compass"


@dataclass(frozen=True)
class Servo:
    """DC servo with a series-elastic gear.

    Attributes:
        supply_v: Supply voltage V [V].
        stall_torque: Torque at full voltage and standstill [N m]; fixes R = Kt V / stall.
        torque_constant: Kt = Ke [N m/A].
        proportional_gain: Kp, duty per angle error [1/rad].
        rotor_inertia: Jm, referred to the joint [kg m^2].
        viscous_friction: b [N m s/rad].
        coulomb_friction: t_c [N m].
        gear_stiffness: k_g [N m/rad].
        gear_damping: c_g [N m s/rad].
        backlash: B, the gear's play between its flanks [rad]; 0: none.
        static_friction: t_s, torque that a rotor at rest withstands [N m], at least t_c; 0: the
            rotor never rests, its Coulomb friction is smooth about zero speed.
        stribeck_speed: v_s, rotor speed over which friction falls from t_s to t_c [rad/s].
    """

    supply_v: Positive = 6.0
    stall_torque: Positive = 1.5
    torque_constant: Positive = 1.0
    proportional_gain: Positive = 8.0
    rotor_inertia: Positive = 1.5e-3
    viscous_friction: NonNegative = 0.005
    coulomb_friction: NonNegative = 0.03
    gear_stiffness: Positive = 40.0
    gear_damping: NonNegative = 0.05
    backlash: NonNegative = 0.0
    static_friction: NonNegative = 0.0
    stribeck_speed: Positive = 0.05

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Check that a rotor at rest withstands no less than a moving one."""
        if 0 < self.static_friction < self.coulomb_friction:
            yield "static_friction", f"0, or at least coulomb_friction = {self.coulomb_friction:g}"

    @property
    def resistance_ohm(self) -> float:
        """Winding resistance R = Kt V / stall torque [ohm]."""
        return self.torque_constant * self.supply_v / self.stall_torque


@dataclass(frozen=True)
class Joint:
    """One actuated joint.

    Attributes:
        plane: The plane in which it bends the body.
        lower: Lower limit [rad].
        upper: Upper limit [rad].
        max_velocity: Rate limit [rad/s].
        sits: Where velocity and effort are measured: inside of the servo's own ``loop``, which
            takes them from the encoder that it controls, or outside of it, at the ``joint``.
    """

    name: Name
    plane: Plane
    lower: float = -math.pi / 6
    upper: float = math.pi / 6
    max_velocity: Positive = 10.0
    servo: Servo = field(default_factory=Servo)
    sits: Seat = Seat.LOOP

    def contradictions(self) -> Iterator[tuple[str, str, str]]:
        """Check that the upper limit is above the lower one."""
        if self.lower >= self.upper:
            yield "upper", f"more than lower = {self.lower:g}", f"{self.upper:g}"


@dataclass(frozen=True)
class Link:
    """One rigid link, a capsule along x.

    Attributes:
        length: Joint to joint [m].
        radius: [m].
        mass: [kg].
        inertia: Principal moments about the centre, along x, y, z [kg m^2].
        mesh: File of its shape for the picture, in the link's frame; empty: it is drawn as the
            capsule that it is to the physics.
        mesh_scale: Metres in one unit of that file.
    """

    name: Name
    length: Positive
    radius: Positive
    mass: Positive
    inertia: Annotated[tuple[float, float, float], above(0.0)]
    mesh: str = ""
    mesh_scale: Positive = 1.0


@dataclass(frozen=True)
class Sensor:
    """One sensor and where it is mounted.

    Attributes:
        name: Unique in the robot; an IR sensor ``ir01`` is logged on ``/ir/01``.
        link: Name of the link that carries it.
        position: Mount point in the link's frame [m].
        rpy: Roll, pitch, yaw of the sensor's frame in the link's frame [rad]; rays leave along x.
        range_min: Shortest distance it can measure [m]; None where it has no range.
        range_max: Longest distance it can measure [m]; None where it has no range.
        field_of_view: Full cone angle [rad]; None where it has none.
        axes: Measured axes of the sensor's frame, e.g. ``("x", "y", "z")``.
        assumed: Names of the fields that were assumed rather than known.
    """

    name: Name
    kind: SensorKind
    link: str
    position: tuple[float, float, float]
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    range_min: NonNegative | None = None
    range_max: Positive | None = None
    field_of_view: Annotated[float, above(0.0), at_most(6.29)] | None = None
    axes: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()

    def contradictions(self) -> Iterator[tuple[str, str, str]]:
        """Check that a range has an extent."""
        least, most = self.range_min, self.range_max
        if least is not None and most is not None and least >= most:
            yield "range_max", f"more than range_min = {least:g}", f"{most:g}"

    @property
    def topic(self) -> str:
        """Topic on which a session holds it: ``/ir/NN``, ``/sonar``, ``/imu`` or ``/compass``.

        Further sensors of a kind that has one topic follow below it, by their own names.
        """
        if self.kind is SensorKind.IR:
            return f"/ir/{self.name.removeprefix('ir')}"
        base = "/imu" if self.kind is SensorKind.ACCELEROMETER else f"/{self.kind}"
        return base if self.name == self.kind else f"{base}/{self.name}"


class Direction(StrEnum):
    """Way of a frame on the bus, seen from the computer on the robot."""

    TX = "tx"
    RX = "rx"


class Quantity(StrEnum):
    """What a bus signal or a CSV column means."""

    COMMAND = "command"
    POSITION = "position"
    VELOCITY = "velocity"
    EFFORT = "effort"
    CURRENT = "current"
    VOLTAGE = "voltage"
    TEMPERATURE = "temperature"
    RANGE = "range"
    ACCELERATION = "acceleration"
    MAGNETIC_FIELD = "magnetic_field"


@dataclass(frozen=True)
class BusSignal:
    """Where one quantity of one joint or sensor is found on the bus.

    The physical value is ``scale * raw + offset`` of the decoded DBC value, in ``unit``; readers
    get it in SI.

    Attributes:
        direction: Way of the frame; a request and its reply may share one identifier.
        target: Name of the joint or sensor.
        quantity: What it is of that target.
        unit: Unit of the decoded DBC value, e.g. ``deg``.
        scale: Applied to the decoded value (gear ratio, sign), 1 by default.
        offset: Added after ``scale``, in ``unit``.
        axis: Axis of the sensor's frame for a vector quantity (``x``, ``y``, ``z``), else empty.
        unknown: Raw number of the DBC signal, before its scale, that stands for no value (NaN).
        out_of_range: Raw number of a range's signal that stands for nothing in range (+inf).
    """

    message: str
    signal: str
    direction: Direction
    target: str
    quantity: Quantity
    unit: str
    scale: Annotated[float, NONZERO] = 1.0
    offset: float = 0.0
    axis: str = ""
    unknown: int | None = None
    out_of_range: int | None = None


@dataclass(frozen=True)
class BusPoll:
    """A request for the state of a servo or a sensor, which moves nothing.

    Attributes:
        signals: Signal names with their raw numbers, before the DBC's scale; others are 0.
    """

    message: str
    signals: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Motor:
    """One motor of a family of :mod:`.capture.robot.families`.

    Attributes:
        joint: The joint that it turns.
        id: Its number on the bus.
        model: Model of its family; empty where all are alike.
        reply_id: Identifier of its replies, where that is a setting; None for the usual one.
        scale: Joint angle to motor angle (gear ratio, sign); of commands, positions and velocities.
        offset: Added after ``scale`` to commands and positions [rad].
    """

    joint: str
    id: Annotated[int, at_least(0)]
    model: str = ""
    reply_id: Annotated[int, at_least(0)] | None = None
    scale: Annotated[float, NONZERO] = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Bus:
    """The robot's bus: databases and the map from signals to quantities.

    Attributes:
        databases: DBC file names, relative to the robot TOML.
        bitrate: [bit/s].
        polls: Requests of each control tick; empty where the robot sends unrequested.
        family: Family of the motors that the map was made for; empty for a map of its own.
        motors: The motors of a family.
    """

    databases: tuple[str, ...]
    bitrate: Count
    signals: tuple[BusSignal, ...]
    polls: tuple[BusPoll, ...] = ()
    family: str = ""
    motors: tuple[Motor, ...] = ()


@dataclass(frozen=True)
class Robot:
    """A chain of links and joints with its sensors and its bus.

    Example::

        robot = undulog.load_robot("snake25")
        names = [joint.name for joint in robot.joints]

    Attributes:
        name: Short name, e.g. ``snake25``.
        clock: Whose clock stamps its samples.
        links: From the head; one more than joints.
        joints: From the head.
        bus: The bus map, or None.
        toml: The text it was read from; stored in every session.
        databases: DBC file name to text, for the session's attachments.
        meshes: Mesh file name to bytes, likewise.
        assumed: Parts of the description (``links``, ``servo``, ``bus``, ...) that were assumed
            rather than known.
        safety: How far it may be driven, or None.
        serial: Serial number, which separates robots of one name; empty if not given.
    """

    name: Name
    description: str
    clock: ClockDomain
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    sensors: tuple[Sensor, ...] = ()
    bus: Bus | None = None
    toml: str = ""
    databases: tuple[tuple[str, str], ...] = ()
    meshes: tuple[tuple[str, bytes], ...] = field(default=(), repr=False)
    assumed: tuple[str, ...] = ()
    safety: Safety | None = None
    serial: str = ""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of all joints, head to tail."""
        return tuple(joint.name for joint in self.joints)

    @property
    def total_mass(self) -> float:
        """Mass of all links [kg]."""
        return math.fsum(link.mass for link in self.links)

    def joint_indices(self, plane: Plane) -> IntArray:
        """Return indices of the joints of one plane, head to tail.

        Returns:
            Indices into ``joints``, shape (number of joints in that plane,).
        """
        chosen = [i for i, joint in enumerate(self.joints) if joint.plane is plane]
        return frozen(np.array(chosen, dtype=np.int64))

    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper joint limits [rad], each of shape (m,)."""
        lower = np.array([joint.lower for joint in self.joints], dtype=np.float64)
        upper = np.array([joint.upper for joint in self.joints], dtype=np.float64)
        return frozen(lower), frozen(upper)

    def with_modules(
        self, servo_of: Mapping[str, Mapping[str, float]], mass_factor: Mapping[str, float]
    ) -> Robot:
        """Return the robot with other servos and links.

        Args:
            servo_of: Joint to the parameters of its servo that differ, by name.
            mass_factor: Link to the factor of its mass and moments of inertia, as a denser material
                of that shape has it.
        """
        joints = tuple(
            replace(joint, servo=replace(joint.servo, **servo_of.get(joint.name, {})))
            for joint in self.joints
        )
        links = tuple(_heavier(link, mass_factor.get(link.name, 1.0)) for link in self.links)
        return replace(self, joints=joints, links=links)


def _heavier(link: Link, factor: float) -> Link:
    ixx, iyy, izz = link.inertia
    inertia = (factor * ixx, factor * iyy, factor * izz)
    return replace(link, mass=factor * link.mass, inertia=inertia)
