"""The twin's samples, written to the log contract.

Sensor samples are written when they arrive at the robot's computer: ``header.stamp`` is the
sampling time (of joints the start of the polling cycle, and ``/joint_sample_offset`` has each
joint's own turn after it), the log time is that of the arrival. Effort, current and voltage are
means over one control period (:mod:`.sim.physics.sensors`). Their products miss what happens within
a period, so each joint's powers are logged besides, accumulated at the physics rate. Commands,
gait, odometry, powers and ledger are the twin's own; powers carry the middle of their period, the
others the tick. Time is simulated: nothing of the machine's clock enters the file, and the same
scenario gives the same bytes.

The robot as URDF, for viewers and simulators that know no robot TOML.

URDF puts the frame of a link that hangs on a joint *at that joint*; the head's frame is at its
centre. So rear links have their centre at x = -length/2 of their URDF frame. A link looks like its
mesh, where it has one (the file lies beside the URDF among the session's attachments), else like a
capsule: a cylinder from joint to joint with a ball at either end (URDF viewers know cylinders and
spheres, few know capsules).
"""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from xml.etree import ElementTree as ET

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.log.messages.definitions import PowerTopic
from undulog.capture.log.write.writer import SessionWriter, open_sensor
from undulog.capture.robot.kinematics import rotation_from_quaternion
from undulog.capture.robot.model import Joint, Link, Plane, Robot
from undulog.capture.robot.run import RUN_RECORD, TwinRun, drag_ratio

from ..gait.contract import CONTROL_RATE_HZ
from ..physics.ledger import JOINT_TERMS, TERMS
from ..physics.sensing import JointSample, RangeSample, SensorSample
from ..scenario.scenario import Kernels, Scenario
from .stability import warnings
from .twin import Sample, Twin

_AXES = {Plane.HORIZONTAL: "0 0 1", Plane.VERTICAL: "0 1 0"}
_ALONG_X = "0 1.5707963267948966 0"  # a URDF cylinder lies along z

GAIT_UNIT = "rad, omega in rad/s"
"""Unit of the values on ``/gait``."""

_TF_EVERY = 5  # ticks: 20 Hz, a view aid
_TICK_NS = 1_000_000_000 // CONTROL_RATE_HZ
# Rows of :attr:`.sim.twin.twin.Sample.joint_energy` whose rates of change are logged.
_POWER_TERMS = {
    PowerTopic.MECHANICAL: JOINT_TERMS.index("mechanical_net"),
    PowerTopic.MECHANICAL_PLUS: JOINT_TERMS.index("mechanical_plus"),
    PowerTopic.ELECTRICAL: JOINT_TERMS.index("electrical_net"),
    PowerTopic.ELECTRICAL_PLUS: JOINT_TERMS.index("electrical_plus"),
}

# Powers are rounded to 60 nW, without bias: the digits beyond would be half of their bytes.
_POWER_PER_W = float(2**24)


def urdf(robot: Robot) -> str:
    """Write the robot as URDF.

    Returns:
        XML text. Masses and inertias are exact, joints have limits, stall torque as effort, no
        damping and no friction (the servos bring their own).
    """
    root = ET.Element("robot", name=robot.name)
    ET.SubElement(ET.SubElement(root, "material", name="body"), "color", rgba="0.55 0.6 0.65 1")
    for i, link in enumerate(robot.links):
        _add_link(root, link, 0.0 if i == 0 else -link.length / 2)
    for i, joint in enumerate(robot.joints):
        front, rear = robot.links[i], robot.links[i + 1]
        at = -front.length / 2 if i == 0 else -front.length
        _add_joint(root, joint, front.name, rear.name, at)
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def frame_origins(robot: Robot, centres: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Where the URDF frames of the links are, given the links' centres.

    Args:
        robot: The robot, n links.
        centres: In the world [m], shape (n, 3).
        quaternions: x, y, z, w, shape (n, 4).

    Returns:
        Origins of the URDF frames [m], shape (n, 3): the joint in front of each link, and the
        head's centre.
    """
    half = np.array([0.0, *(link.length / 2 for link in robot.links[1:])])
    return centres + half[:, None] * rotation_from_quaternion(quaternions)[:, :, 0]


def _add_link(root: ET.Element, link: Link, centre: float) -> None:
    element = ET.SubElement(root, "link", name=link.name)
    inertial = ET.SubElement(element, "inertial")
    ET.SubElement(inertial, "origin", xyz=f"{centre!r} 0 0", rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(link.mass))
    ixx, iyy, izz = (repr(moment) for moment in link.inertia)
    ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    if link.mesh:
        visual = ET.SubElement(element, "visual")
        ET.SubElement(visual, "origin", xyz=f"{centre!r} 0 0", rpy="0 0 0")
        shape = {"filename": link.mesh, "scale": " ".join([repr(link.mesh_scale)] * 3)}
        ET.SubElement(ET.SubElement(visual, "geometry"), "mesh", shape)
        return
    half, radius = link.length / 2, repr(link.radius)
    for shape, at, size in (
        ("cylinder", centre, {"radius": radius, "length": repr(link.length)}),
        ("sphere", centre + half, {"radius": radius}),
        ("sphere", centre - half, {"radius": radius}),
    ):
        visual = ET.SubElement(element, "visual")
        ET.SubElement(visual, "origin", xyz=f"{at!r} 0 0", rpy=_ALONG_X)
        ET.SubElement(ET.SubElement(visual, "geometry"), shape, size)
        ET.SubElement(visual, "material", name="body")


def _add_joint(root: ET.Element, joint: Joint, parent: str, child: str, at: float) -> None:
    element = ET.SubElement(root, "joint", name=joint.name, type="revolute")
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "origin", xyz=f"{at!r} 0 0", rpy="0 0 0")
    ET.SubElement(element, "axis", xyz=_AXES[joint.plane])
    ET.SubElement(
        element,
        "limit",
        lower=repr(joint.lower),
        upper=repr(joint.upper),
        effort=repr(joint.servo.stall_torque),
        velocity=repr(joint.max_velocity),
    )
    ET.SubElement(element, "dynamics", damping="0", friction="0")


def session_facts(scenario: Scenario, kernels: Kernels = Kernels.NUMPY) -> Mapping[str, str]:
    """Return the metadata of a run.

    Args:
        kernels: What computes the force laws.

    Returns:
        Names to text: scenario, seed, times, the joints' sampling, and versions.
    """
    return {
        "scenario": scenario.name,
        "seed": str(scenario.seed),
        "planned_duration_s": repr(scenario.duration_s),
        "settle_s": repr(scenario.settle_s),
        "physics_rate_hz": str(scenario.physics_rate_hz),
        "joint_sampling": _sampling(scenario.sensing.servo.slot_s),
        "engine": scenario.engine,
        "kernels": kernels,
        scenario.engine.package: version(scenario.engine.package),
        **{name: version(name) for name in ("numpy", kernels)},
        "python": platform.python_version(),
    }


class SessionLog:
    """Writes one run into an open session."""

    def __init__(self, writer: SessionWriter, twin: Twin, *, epoch_ns: int | None = None) -> None:
        """Open the channels and store what explains the run.

        Args:
            writer: The session; the log does not close it.
            epoch_ns: Unix time of the first sample [ns]; that of the scenario by default.
        """
        self._writer, self._twin = writer, twin
        scenario = self._scenario = twin.scenario
        self._epoch_ns = scenario.epoch_ns if epoch_ns is None else epoch_ns
        robot = scenario.robot
        names, head = robot.joint_names, robot.links[0].name
        description = urdf(robot)
        writer.attach("robot.urdf", "application/xml", description.encode())
        writer.attach("scenario.toml", "application/toml", scenario.toml().encode())
        writer.note(RUN_RECORD, _run_facts(scenario, twin.kernels))
        self._commands = writer.joint_state("/joint_commands", names, unit="rad")
        self._states = writer.joint_state(
            "/joint_states", names, unit="rad", velocity=True, effort=True
        )
        self._offsets = writer.joint_state("/joint_sample_offset", names, unit="s")
        self._current = writer.joint_state("/joint_current", names, unit="A")
        self._voltage = writer.joint_state("/joint_voltage", names, unit="V")
        gait_names = twin.gait.names  # recorded commands may come without their gait
        self._gait = writer.joint_state("/gait", gait_names, unit=GAIT_UNIT) if gait_names else None
        self._powers = {topic: writer.joint_state(topic, names, unit="W") for topic in _POWER_TERMS}
        self._booked = 0, np.zeros((len(JOINT_TERMS), len(names)))
        self._energy = writer.joint_state("/energy_ledger", TERMS, unit="J")
        self._odometry = writer.odometry("/odom", frame="world", child=head)
        self._transforms = writer.transforms(
            "/tf", parent="world", children=[link.name for link in robot.links]
        )
        sensors = robot.sensors if scenario.sensing.enabled else ()
        self._sensors = {sensor.name: open_sensor(writer, sensor) for sensor in sensors}
        self._mode = writer.string("/gait/mode")
        self._events = writer.log("/rosout")
        self._lower, self._upper = robot.limits()
        self._last_mode = ""
        self._logged: set[str] = set()
        self._t_ns = self._epoch_ns
        writer.string("/robot_description").write(self._t_ns, description)
        for text in warnings(scenario):
            self.log_event("warn", text)
        if scenario.faults:
            text = "the scenario's faults are those of a bus, which this run does not have"
            self.log_event("warn", text)
        self.log_event(
            "info", f"start of {scenario.name}, seed {scenario.seed}: {scenario.description}"
        )

    def log_event(self, level: str, text: str) -> None:
        """Write an event, once.

        Args:
            level: ``info``, ``warn`` or ``error``.
        """
        if text not in self._logged:
            self._logged.add(text)
            self._events.write(self._t_ns, level, "twin", text)

    def end(self, verdict: str, reason: str) -> None:
        """Write the samples that have not arrived yet, and set the verdict.

        Args:
            verdict: ``good``, ``degraded`` or ``bad``.
            reason: Its reason, where it isn't good.
        """
        self.receive(self._twin.flush())
        self._writer.set_verdict(verdict, [] if verdict == "good" else [reason])

    def write(self, sample: Sample) -> None:
        """Write one sample to all channels."""
        t_ns = self._t_ns = self._epoch_ns + sample.tick * _TICK_NS
        body = sample.step.body
        self._commands.write(t_ns, sample.gait.command)
        self.receive(sample.sensed)
        if self._gait is not None:
            self._gait.write(t_ns, sample.gait.values)
        self._energy.write(t_ns, sample.energy)
        self._write_powers(sample)
        position, quaternion = body.position[:, 0], body.quaternion[:, 0]
        into_head = rotation_from_quaternion(quaternion).T
        self._odometry.write(
            t_ns, position, quaternion, into_head @ body.velocity[:, 0], into_head @ body.spin[:, 0]
        )
        if sample.tick % _TF_EVERY == 0:
            centres, turns = body.position.T, body.quaternion.T
            self._transforms.write(t_ns, frame_origins(self._scenario.robot, centres, turns), turns)
        if sample.gait.mode != self._last_mode:
            self._last_mode = sample.gait.mode
            self._mode.write(t_ns, sample.gait.mode)
        self._note(sample)

    def receive(self, samples: Sequence[SensorSample]) -> None:
        """Write sensor samples, as arrived by the time of the last sample written.

        Args:
            samples: From :attr:`Sample.sensed`, or from :meth:`Twin.flush` at the end of the run.
        """
        for sample in samples:
            if isinstance(sample, JointSample):
                self._write_joints(sample)
            else:
                ranged = isinstance(sample, RangeSample)
                values = np.array([sample.distance]) if ranged else sample.vector
                t_ns = self._epoch_ns + round(sample.time_s * 1e9)
                self._sensors[sample.name].write(t_ns, values, log_time_ns=self._t_ns)

    def _write_joints(self, sample: JointSample) -> None:
        t_ns, now_ns = self._epoch_ns + sample.cycle * _TICK_NS, self._t_ns
        states = sample.position, sample.velocity, sample.effort
        self._states.write(t_ns, *states, log_time_ns=now_ns)
        self._offsets.write(t_ns, sample.offset_s, log_time_ns=now_ns)
        self._current.write(t_ns, sample.current, log_time_ns=now_ns)
        self._voltage.write(t_ns, sample.voltage, log_time_ns=now_ns)

    def _write_powers(self, sample: Sample) -> None:
        """Write the joints' mean powers since the sample before."""
        (tick, energy), self._booked = self._booked, (sample.tick, sample.joint_energy)
        if sample.tick == tick:  # the first sample
            return
        length_ns = (sample.tick - tick) * _TICK_NS
        power = (sample.joint_energy - energy) * (1e9 / length_ns)
        power = np.rint(power * _POWER_PER_W) / _POWER_PER_W
        middle_ns = self._t_ns - length_ns // 2
        for topic, row in _POWER_TERMS.items():
            self._powers[topic].write(middle_ns, power[row], log_time_ns=self._t_ns)

    def _note(self, sample: Sample) -> None:
        """Log events of a sample."""
        if sample.tick == round(self._scenario.settle_s * CONTROL_RATE_HZ):
            self.log_event("info", f"settled: {self._scenario.settle_s:g} s have passed")
        target = self._scenario.world.target
        head = sample.step.body.position[:2, 0]
        if target is not None and math.dist(head, target.position) <= target.radius:
            self.log_event("info", "the head has met the target")
        for name in sample.gait.clamped:
            self.log_event("warn", f"{name} clamped to the joint limits")
        angle = sample.step.body.angle
        for i in np.flatnonzero((angle < self._lower) | (angle > self._upper)):
            joint = self._scenario.robot.joints[i]
            self.log_event(
                "warn", f"{joint.name} passed its limits {joint.lower:g} to {joint.upper:g} rad"
            )


def _run_facts(scenario: Scenario, kernels: Kernels) -> dict[str, str]:
    """Entries of the metadata record of what runs."""
    ground = scenario.world.ground
    run = TwinRun(
        physics_rate_hz=scenario.physics_rate_hz,
        start_heading_rad=scenario.world.heading,
        contact=ground is not None or bool(scenario.world.obstacles),
        drag_ratio=None if ground is None else drag_ratio(ground.mu_normal, ground.mu_tangential),
        servo_of={joint.name: dataclasses.asdict(joint.servo) for joint in scenario.robot.joints},
        mass_factor=scenario.modules.mass_factor,
    )
    law = {} if ground is None else {"contact_law": ground.law}
    return {"engine": scenario.engine, "kernels": kernels, **law, **run.record()}


def _sampling(slot_s: float) -> str:
    """How the joints are sampled, in words."""
    at = (
        f"each joint {slot_s:g} s after the one before it, at the stamp plus /joint_sample_offset"
        if slot_s
        else "all joints at the stamp"
    )
    return f"{at}; effort, current and voltage are means over one control period around it"
