"""Sessions that earlier versions wrote are read as before: opened, checked, analysed, exported."""

import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest

from support.read_back import decoded_of
from undulog.capture import Session, SessionWriter
from undulog.capture.log.messages.definitions import CONTRACT_VERSION

EARLIER = Path(__file__).parent / "earlier"
FILES = sorted(EARLIER.glob("*.mcap"))
TWINS = [path for path in FILES if path.stem.endswith("twin")]


@pytest.fixture(params=FILES, ids=lambda path: path.stem)
def session_file(request, tmp_path):
    """A copy of a session of an earlier version."""
    return Path(shutil.copy(request.param, tmp_path / "run.mcap"))


def positions(path):
    """Joints and positions [rad], shape (n, m), by the format's own reader."""
    messages = [m for *_, m in decoded_of(path, ["/joint_states"])]
    return list(messages[0].name), np.array([message.position for message in messages])


def test_each_is_listed_in_the_readme():
    text = (EARLIER / "README.md").read_text()
    assert len(FILES) == 7
    assert [p.name for p in EARLIER.iterdir() if p.stem != "README" and p.name not in text] == []


def test_each_opens_with_every_message_and_no_warning(session_file):
    names, expected = positions(session_file)
    with Session.open(session_file) as session:
        signals = session.joints("/joint_states", "position")
        assert list(signals.names) == names
        for column, values in zip(expected.T, signals.values, strict=True):
            np.testing.assert_array_equal(values, column)
        assert session.metadata["undulog"]["contract"] == "1"
        assert session.robot is not None
        assert session.verdict in ("good", "degraded")
        assert session.warnings == []


@pytest.mark.slow
def test_each_is_checked_analysed_and_exported(session_file, command):
    shown = json.loads(command("log", "check", session_file, "--json").out)
    assert shown["verdict"] == "good"
    report = json.loads(command("analyse", session_file, "--json").out)
    assert [joint["name"] for joint in report["joints"]] == positions(session_file)[0]
    table = session_file.with_suffix(".csv")
    command("log", "export", session_file, "-o", table)
    assert table.stat().st_size > 1000


@pytest.mark.parametrize("path", TWINS, ids=lambda path: path.stem)
def test_the_twins_of_all_versions_have_the_same_response_and_servos(path, command):
    report = json.loads(command("analyse", path, "--json").out)
    lags = {j["name"]: j["lag_rad"] for j in report["joints"] if j["plane"] == "horizontal"}
    assert lags == pytest.approx(
        {"joint01": np.radians(85.6), "joint03": np.radians(88.4)}, abs=np.radians(0.2)
    )
    with Session.open(path) as session:
        assert session.run.physics_rate_hz == 2000
        assert {joint.servo.stall_torque for joint in session.robot_as_run.joints} == {0.25}
        assert session.settle_s == 0.2


def test_can_frames_of_both_kinds_are_kept():
    with Session.open(EARLIER / "2026-11-21-can-fd.mcap") as session:
        frames = session.fd_frames("/can_fd/can0")
        assert [bytes(row["data"][: row["len"]]).hex() for row in frames] == [
            "aabbccddeeff0011"
        ] * 3
        assert len(session.frames("/can/can0")) == 100


def test_packets_of_a_line_of_serial_servos_are_kept():
    with Session.open(EARLIER / "2026-11-26-serial.mcap") as session:
        packets = session.fd_frames("/serial/sts")
        commands = session.joints("/joint_commands", "position")
    assert len(packets) == 1400
    writes = packets[(packets["id_flags"] == 0xFE) & (packets["data"][:, 4] == 0x83)]
    low, high = writes["data"][:, 8:10].astype(int).T  # of the first servo's goal
    rad = (low + 256 * high - 2048) * 2 * np.pi / 4096
    assert commands.names[0] == "joint01"
    np.testing.assert_allclose(commands.values[0], rad, atol=1e-9)


def test_a_killed_recording_is_put_together_and_recovered(tmp_path, command):
    with tarfile.open(EARLIER / "2026-11-25-killed.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    (path,) = tmp_path.glob("*.mcap")
    whole = tmp_path / "whole.mcap"
    assert "none is missing" in command("log", "recover", path, "-o", whole).out
    names, expected = positions(whole)
    assert names == ["joint01", "joint02", "joint03"]
    with Session.open(path) as session:
        signals = session.joints("/joint_states", "position")
        for column, values in zip(expected.T, signals.values, strict=True):
            np.testing.assert_array_equal(values, column)
    assert len(expected) == 95


@pytest.mark.parametrize(
    ("version", "warns"), [("1", False), ("2", True), ("9" * 40, True), ("", False), ("x", False)]
)
def test_a_session_of_a_later_contract_is_read_with_a_warning(tmp_path, version, warns, opened):
    path = tmp_path / "later.mcap"
    facts = {"contract": version}
    with SessionWriter(path, session_id="a", epoch_ns=0, metadata=facts) as writer:
        writer.joint_state("/joint_states", ["a"], unit="rad")
    warnings = [text for text in opened(path).warnings if "of the log contract" in text]
    assert bool(warnings) == warns
    assert all(f"reads up to {CONTRACT_VERSION}:" in text for text in warnings)
