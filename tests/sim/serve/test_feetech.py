"""The virtual robot as Feetech servos: driven by the vendor's SDK, recorded by a listener."""

import json
import math
import time

import numpy as np
import pytest
from scservo_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

from support import recorders
from support.processes import UNDULOG, process
from undulog.capture import Session

SCENARIO = """description = "Twelve STS3215 servos on flat ground."
robot = "snake12-sts3215"
duration_s = 60.0
[gait.horizontal]
amplitude = 0.4
frequency_hz = 0.5
lag = 0.5235987755982988
"""
STEP = math.tau / 4096
IDS = range(1, 13)


@pytest.fixture
def served(tmp_path):
    (tmp_path / "sts.toml").write_text(SCENARIO)
    port = tmp_path / "ttySNAKE"
    words = (*UNDULOG, "sim", "serve", tmp_path / "sts.toml", "--feetech", port, "--json")
    with process(*words) as robot:
        yield robot, json.loads(robot.stdout.readline())
    assert not port.is_symlink()


@pytest.mark.slow
@pytest.mark.clock(0.1, "the vendor's SDK waits by the computer's clock")
def test_the_vendors_sdk_drives_it_and_a_second_adapter_records_it(tmp_path, served):
    _, ready = served
    log = tmp_path / "run.mcap"
    listener = f"sts=serial:{ready['listen']}?protocol=feetech"
    with recorders.recording(log, listener, "--robot", "snake12-sts3215") as recorder:
        time.sleep(1.0)
        port, sdk = PortHandler(ready["port"]), PacketHandler(0)
        assert port.openPort()
        model, result, _ = sdk.ping(port, 3)
        assert (model, result) == (777, COMM_SUCCESS)
        write = GroupSyncWrite(port, sdk, 42, 2)
        read = GroupSyncRead(port, sdk, 56, 15)
        for servo in IDS:
            read.addParam(servo)
        sent, answered = [], []
        start = time.monotonic()
        for k in range(200):
            angle = 0.3 * math.sin(2 * math.pi * 0.5 * k / 50) * np.sin(np.arange(12))
            steps = 2048 + np.rint(angle / STEP).astype(int)
            for servo, step in zip(IDS, steps.tolist(), strict=True):
                write.addParam(servo, [step & 0xFF, step >> 8])
            assert write.txPacket() == COMM_SUCCESS
            write.clearParam()
            sent.append(steps)
            if read.txRxPacket() == COMM_SUCCESS:
                answered.append([read.getData(servo, 56, 2) for servo in IDS])
            else:  # it gave up too early on a busy computer; what comes later is not for it
                time.sleep(0.1)
                port.ser.reset_input_buffer()
            time.sleep(max(0.0, start + (k + 1) / 50 - time.monotonic()))
        port.closePort()
        time.sleep(0.3)
        report, _ = recorders.ended(recorder, 2)
    assert report["sources"]["sts"]["malformed"] == 0
    assert len(answered) > 100
    with Session.open(log) as session:
        command = np.array([m.position for _, m in session.messages("/joint_commands")])
        position = np.array([m.position for _, m in session.messages("/joint_states")])
        volts = [m for _, m in session.messages("/joint_voltage")]
        warm = np.array([m.position for _, m in session.messages("/joint_temperature")])
        raw = session.fd_frames("/serial/sts")
        stamps = [m.header.stamp for _, m in session.messages("/joint_commands")]
    np.testing.assert_allclose(command, (np.array(sent) - 2048) * STEP, atol=1e-9)
    rounds = iter(np.rint(position / STEP + 2048).astype(int).tolist())
    assert all(any(cycle == reply for cycle in rounds) for reply in answered), (
        "a reply is not recorded"
    )
    assert len(position) == len(volts) == 200
    writes = (raw["id_flags"] == 0xFE) & (raw["data"][:, 4] == 0x83)
    times_ns = np.maximum.accumulate(raw["t_host_ns"])[writes]  # none before one that came before
    assert [10**9 * s.sec + s.nanosec for s in stamps] == times_ns.tolist()
    assert (warm == 25.0).all()
    assert len(raw) > 200 * 14
    assert np.ptp(position[:, 2]) > 0.4
