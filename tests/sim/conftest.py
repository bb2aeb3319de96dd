"""What the twin's tests share: small robots and scenarios built in code, and a harmonic fit."""

import dataclasses
import math

import numpy as np
import pytest

from undulog.capture.robot.model import ClockDomain, Joint, Link, Plane, Robot, Servo
from undulog.sim import PlaneGait, Scenario, Serpentine, World


@pytest.fixture(scope="session")
def make_robot():
    """Chain of like links, joints alternately yaw and pitch (or all yaw)."""

    def build(links=26, *, planar=False, limit=math.pi / 6, **servo):
        names = [f"{i + 1:02d}" for i in range(links)]
        planes = [
            Plane.HORIZONTAL if planar or i % 2 == 0 else Plane.VERTICAL for i in range(links)
        ]
        return Robot(
            name="chain",
            description="a chain of like links",
            clock=ClockDomain.SIMULATED,
            links=tuple(Link(f"link{n}", 0.06, 0.025, 0.1, (4e-5, 5e-5, 5e-5)) for n in names),
            joints=tuple(
                Joint(f"joint{n}", plane, -limit, limit, 10.0, Servo(**servo))
                for n, plane in zip(names[:-1], planes, strict=False)
            ),
        )

    return build


@pytest.fixture(scope="session")
def make_uneven(make_robot):
    """Chain of links that differ in every respect, so that no mix-up goes unseen."""

    def build(links, **options):
        robot = make_robot(links, **options)
        uneven, joints = [], []
        for i, link in enumerate(robot.links):
            inertia = (5e-5 + 1e-6 * i, 6e-5, 6e-5 + 1e-5 * i)
            size = (0.05 + 0.01 * i, 0.02 + 1e-3 * i)
            uneven.append(Link(link.name, *size, 0.1 + 0.02 * i, inertia))
        for i, joint in enumerate(robot.joints):
            changes = {"stall_torque": 0.3 + 0.1 * i, "backlash": 0.02 * (i % 2), "supply_v": 6 + i}
            changes["static_friction"] = 0.05 * (i % 3 == 0)
            servo = dataclasses.replace(joint.servo, **changes)
            joints.append(dataclasses.replace(joint, servo=servo))
        return dataclasses.replace(robot, links=tuple(uneven), joints=tuple(joints))

    return build


@pytest.fixture(scope="session")
def make_scenario(make_robot):
    """Lateral undulation of that chain; ``amplitude=0`` holds it straight."""

    def build(
        robot=None,
        *,
        amplitude=0.4,
        frequency_hz=0.5,
        lag=math.pi / 3,
        ramp_s=2.0,
        gait=None,
        world=None,
        **fields,
    ):
        wave = PlaneGait(amplitude, frequency_hz, lag)
        scenario = Scenario(
            name="test",
            description="a test",
            robot_name="chain",
            robot=robot or make_robot(),
            gait=gait or Serpentine({Plane.HORIZONTAL: wave}, ramp_s),
            duration_s=1.0,
            world=world or World(),
        )
        return dataclasses.replace(scenario, **fields)

    return build


@pytest.fixture(scope="session")
def response():
    """Complex response, signal over command, at one frequency, by linear least squares."""

    def fit(command, signal, frequency_hz, rate_hz=100.0):
        t = np.arange(len(command)) / rate_hz
        turn = 2 * np.pi * frequency_hz * t
        basis = np.column_stack([np.ones_like(t), np.cos(turn), np.sin(turn)])
        parts = [np.linalg.lstsq(basis, x, rcond=None)[0] for x in (command, signal)]
        c, a = (p[1] - 1j * p[2] for p in parts)
        return a / c

    return fit
