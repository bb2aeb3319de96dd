"""A servo that speaks only when it is spoken to: ArcSnake's RMD-X8, written from its manual."""

import math
import struct

import can
import numpy as np
import pytest

from support.arm_limits import ARM_LIMITS
from support.can_messages import speaking
from support.written_sessions import write_commands
from undulog.capture import Session, load_robot
from undulog.capture.bus.encoding import poll_frames
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX
from undulog.sim.drive.motion import find_motion
from undulog.sim.drive.outcome import DriveEnding
from undulog.sim.drive.over_bus import bus_plan, drive_bus

SHIPPED = load_robot("arcsnake-joint")
ADDRESS = 0x14B


class Servo:
    """One motor at its bus: 0x92 asks for the angle, 0xA4 commands one, both are answered."""

    def __init__(self, degrees):
        self.degrees, self.temperature, self.received = degrees, 30, []

    def answer(self, bus):
        while (message := bus.recv(0.05)) is not None:
            data = bytes(message.data)
            self.received.append(data)
            if data[0] == 0x92:
                reply = bytes([0x92]) + round(self.degrees * 100).to_bytes(7, "little", signed=True)
            elif data[0] == 0xA4:
                self.degrees = struct.unpack("<i", data[4:])[0] / 100
                reply = struct.pack("<BbhhH", 0xA4, self.temperature, 10, 0, 0)
            else:
                continue
            bus.send(can.Message(arbitration_id=ADDRESS, data=reply, is_extended_id=False))


@pytest.fixture
def robot(tmp_path):
    """The shipped joint, with limits."""
    path = tmp_path / "arm.toml"
    path.write_text(SHIPPED.toml + ARM_LIMITS)
    for name, text in SHIPPED.databases:
        (tmp_path / name).write_text(text)
    return load_robot(path)


def planned(tmp_path, robot, channel, angles):
    recorded = write_commands(tmp_path / "commands.mcap", ["joint01"], angles[:, None], robot=robot)
    on = f"can:virtual:{channel}"
    return bus_plan(find_motion(str(recorded)), on, output=tmp_path / "a.mcap")


def test_the_request_of_the_shipped_joint_is_the_one_of_its_manual():
    (frame,) = poll_frames(SHIPPED)
    assert int(frame["id_flags"]) == ADDRESS
    assert bytes(frame["data"][: frame["dlc"]]) == bytes([0x92, 0, 0, 0, 0, 0, 0, 0])
    assert frame["dir"] == DIR_TX
    assert not len(poll_frames(load_robot("snake25")))  # it tells unasked


@pytest.mark.clock(0.02, "a servo in a thread has to answer within a control tick")
def test_it_is_asked_where_it_is_and_driven_from_there(tmp_path, robot):
    angles = 0.5 + 0.2 * np.sin(np.arange(121).clip(max=40) / 10)  # then it catches up
    servo = Servo(math.degrees(0.3))
    with speaking("polled", servo.answer):
        report = drive_bus(planned(tmp_path, robot, "polled", angles), stop=StopRequest())
    assert report.outcome.how is DriveEnding.COMPLETE, report.outcome
    requests = [data for data in servo.received if data[0] == 0x92]
    commands = [data for data in servo.received if data[0] == 0xA4]
    assert len(requests) + len(commands) == report.tally.sent == len(servo.received)
    assert servo.received[:40] == [bytes([0x92]) + bytes(7)] * 40  # it listens before it commands
    given = np.radians([struct.unpack("<i", data[4:])[0] / 100 for data in commands])
    assert given[0] == pytest.approx(0.3, abs=0.011)
    assert np.abs(np.diff(given)).max() <= 4.0 * 0.01 + 2e-4
    assert given[-1] == pytest.approx(angles[-1], abs=1e-4)
    with Session.open(tmp_path / "a.mcap") as session:
        frames = session.frames("/can/polled")
        assert (frames["dir"] == DIR_TX).sum() == len(servo.received)
        assert (frames["dir"] == DIR_RX).sum() > 0
        assert np.nanmax(np.abs(session.joints("/joint_states").values[0] - 0.3)) < 0.5


@pytest.mark.clock(0.02, "a servo in a thread has to answer within a control tick")
def test_its_temperature_ends_the_drive(tmp_path, robot):
    servo = Servo(math.degrees(0.5))
    servo.temperature = 61
    with speaking("polled-hot", servo.answer):
        plan = planned(tmp_path, robot, "polled-hot", np.full(200, 0.5))
        report = drive_bus(plan, stop=StopRequest())
    assert report.outcome.why.startswith("joint01: temperature 61 degC, more than 60 degC for 0.3")
    assert abs(servo.degrees) <= 0.005
