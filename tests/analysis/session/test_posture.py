"""Heading and lean of a session: where they are read, against a known orientation."""

import math

import numpy as np
import pytest

from undulog.analysis.parts.gait.result import Window
from undulog.analysis.session.runs import posture
from undulog.capture import Session, SessionWriter, load_robot

EPOCH_NS = 1_735_689_600_000_000_000
ROBOT = load_robot("snake25")
(IMU,) = [sensor for sensor in ROBOT.sensors if sensor.kind == "accelerometer"]
WINDOWS = (Window(1.0, 3.0, 2.0),)


def lying(path, *, fall=0.0, plan=None, metadata=None, heading=None, robot=ROBOT):
    """A session whose accelerometer lies on a floor that falls towards the head."""
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=robot) as writer:
        if plan is not None:
            writer.note("undulog.plan", {"plan": "reversal", **plan})
        if metadata is not None:
            writer.note("undulog", metadata)
        if heading is not None:
            text = f"[world]\nheading = {heading}\n".encode()
            writer.attach("scenario.toml", "application/toml", text)
        channel = writer.imu(IMU.topic, frame=IMU.name)
        for k in range(400):
            t = k / 100
            sway = math.sin(2 * math.pi * t) if 1 <= t < 3 else 40.0  # whole cycles; else thrown
            force = (-9.81 * math.sin(fall) + sway, 0.3 * sway, 9.81 * math.cos(fall))
            channel.write(EPOCH_NS + k * 10_000_000, np.array(force))
    return path


def read(path):
    with Session.open(path) as session:
        return posture(session, WINDOWS)


@pytest.mark.parametrize("fall", [0.0, 0.02, -0.1])
def test_gravity_leans_as_the_floor_falls(tmp_path, fall):
    assert read(lying(tmp_path / "a.mcap", fall=fall)).lean_rad == pytest.approx(fall, abs=1e-6)


def test_the_heading_is_the_plans_then_the_sessions_then_the_scenarios(tmp_path):
    given = {"plan": {"heading_rad": "3.14"}, "metadata": {"heading_rad": "1.5"}, "heading": 0.3}
    for k, heading in enumerate((3.14, 1.5, 0.3)):
        assert read(lying(tmp_path / f"{k}.mcap", **given)).heading_rad == heading
        given.pop(next(iter(given)))
    assert math.isnan(read(lying(tmp_path / "none.mcap")).heading_rad)
    assert math.isnan(read(lying(tmp_path / "odd.mcap", plan={"heading_rad": "north"})).heading_rad)


def test_without_a_robot_or_a_gait_no_lean_is_known(tmp_path, opened):
    assert math.isnan(read(lying(tmp_path / "a.mcap", robot=None)).lean_rad)
    assert math.isnan(posture(opened(lying(tmp_path / "b.mcap")), ()).lean_rad)
