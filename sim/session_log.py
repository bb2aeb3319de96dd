"""The twin's samples, written to the log contract.

All joints are sampled at the stamp, as no real servo bus can: ``/joint_sample_offset`` is there so
that recordings of robot and twin are read alike, and it is zero. Position and velocity are those
of the instant; effort, current and voltage are means over one control period around it, so that
energies computed from the log are right (:mod:`sim.twin`). Time is simulated: nothing of
the machine's clock enters the file, and the same scenario gives the same bytes.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version

import numpy as np

from capture.log.writer import SessionWriter
from capture.robot.kinematics import rotation_from_quaternion

from .physics.ledger import TERMS
from .scenario import CONTROL_RATE_HZ, Scenario
from .stability import warnings
from .twin import Sample, Twin
from .urdf import frame_origins, urdf

_TF_EVERY = 5  # ticks: 20 Hz, a view aid
_TICK_NS = 1_000_000_000 // CONTROL_RATE_HZ


def session_facts(scenario: Scenario) -> Mapping[str, str]:
    """What the session's metadata says about the run.

    Args:
        scenario: The scenario.

    Returns:
        Names to text: scenario, seed, times, the joints' sampling, and versions.
    """
    return {
        "scenario": scenario.name,
        "seed": str(scenario.seed),
        "planned_duration_s": repr(scenario.duration_s),
        "settle_s": repr(scenario.settle_s),
        "physics_rate_hz": str(scenario.physics_rate_hz),
        "joint_sampling": "all joints at the stamp; effort, current and voltage are means over "
        "one control period around it",
        "engine": scenario.engine,
        scenario.engine.package: version(scenario.engine.package),
        "numpy": version("numpy"),
        "python": platform.python_version(),
    }


class SessionLog:
    """Writes one run into an open session."""

    def __init__(self, writer: SessionWriter, twin: Twin, *, epoch_ns: int | None = None) -> None:
        """Open the channels and store what explains the run.

        Args:
            writer: The session; the log does not close it.
            twin: What will be run.
            epoch_ns: Unix time of the first sample [ns]; that of the scenario by default.
        """
        scenario = self._scenario = twin.scenario
        self._epoch_ns = scenario.epoch_ns if epoch_ns is None else epoch_ns
        robot = scenario.robot
        names, head = robot.joint_names, robot.links[0].name
        description = urdf(robot)
        writer.attach("robot.urdf", "application/xml", description.encode())
        writer.attach("scenario.toml", "application/toml", scenario.toml().encode())
        self._commands = writer.joint_state("/joint_commands", names, unit="rad")
        self._states = writer.joint_state(
            "/joint_states", names, unit="rad", velocity=True, effort=True
        )
        self._offsets = writer.joint_state("/joint_sample_offset", names, unit="s")
        self._current = writer.joint_state("/joint_current", names, unit="A")
        self._voltage = writer.joint_state("/joint_voltage", names, unit="V")
        self._gait = writer.joint_state("/gait", twin.gait.names, unit="rad, omega in rad/s")
        self._energy = writer.joint_state("/energy_ledger", TERMS, unit="J")
        self._odometry = writer.odometry("/odom", frame="world", child=head)
        self._transforms = writer.transforms(
            "/tf", parent="world", children=[link.name for link in robot.links]
        )
        self._mode = writer.string("/gait/mode")
        self._events = writer.log("/rosout")
        self._lower, self._upper = robot.limits()
        self._random = np.random.default_rng(scenario.seed)
        self._noise = np.array(
            [[scenario.noise.position], [scenario.noise.velocity], [scenario.noise.effort]]
        )
        self._last_mode = ""
        self._said: set[str] = set()
        self._t_ns = self._epoch_ns
        writer.string("/robot_description").write(self._t_ns, description)
        for text in warnings(scenario):
            self.say("warn", text)
        self.say("info", f"start of {scenario.name}, seed {scenario.seed}: {scenario.description}")

    def say(self, level: str, text: str) -> None:
        """Write an event, once.

        Args:
            level: ``info``, ``warn`` or ``error``.
            text: What happened.
        """
        if text not in self._said:
            self._said.add(text)
            self._events.write(self._t_ns, level, "twin", text)

    def write(self, sample: Sample) -> None:
        """Write one sample to all channels.

        Args:
            sample: The twin's sample.
        """
        t_ns = self._t_ns = self._epoch_ns + sample.tick * _TICK_NS
        body, drive = sample.step.body, sample.drive
        truth = np.array([body.angle, body.rate, drive.torque])
        reported = truth + self._noise * self._random.standard_normal(truth.shape)
        self._commands.write(t_ns, sample.gait.command)
        self._states.write(t_ns, *reported)
        self._offsets.write(t_ns, np.zeros(truth.shape[1]))
        self._current.write(t_ns, drive.current)
        self._voltage.write(t_ns, drive.voltage)
        self._gait.write(t_ns, sample.gait.values)
        self._energy.write(t_ns, sample.energy)
        position, quaternion = body.position[:, 0], body.quaternion[:, 0]
        into_head = rotation_from_quaternion(quaternion).T
        self._odometry.write(
            t_ns, position, quaternion, into_head @ body.velocity[:, 0], into_head @ body.spin[:, 0]
        )
        if sample.tick % _TF_EVERY == 0:
            centres, turns = body.position.T, body.quaternion.T
            origins = frame_origins(self._scenario.robot, centres, turns)
            self._transforms.write(t_ns, origins, turns)
        if sample.gait.mode != self._last_mode:
            self._last_mode = sample.gait.mode
            self._mode.write(t_ns, sample.gait.mode)
        self._note(sample)

    def _note(self, sample: Sample) -> None:
        """Say what deserves saying about a sample."""
        if sample.tick == round(self._scenario.settle_s * CONTROL_RATE_HZ):
            self.say("info", f"settled: {self._scenario.settle_s:g} s have passed")
        for name in sample.gait.clamped:
            self.say("warn", f"{name} clamped to the joint limits")
        angle = sample.step.body.angle
        for i in np.flatnonzero((angle < self._lower) | (angle > self._upper)):
            joint = self._scenario.robot.joints[i]
            self.say(
                "warn", f"{joint.name} passed its limits {joint.lower:g} to {joint.upper:g} rad"
            )
