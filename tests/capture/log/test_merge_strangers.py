"""Logs that are hardly of one session: refused with the option that allows it, or warned of."""

import pytest
from hostile_logs import EPOCH_NS, NS, HostileLog, joint_state

from support.read_back import messages_of
from undulog.capture import SessionWriter, load_robot
from undulog.capture.common.errors import UsageError
from undulog.capture.log.merge import merge_logs

DAY = 86400 * NS


def bag(path, names, start_ns=EPOCH_NS):
    """One second of joints of another make's recorder, which names no robot."""
    log = HostileLog()
    log.channel("/joint_states", log.schema())
    stamps = [start_ns + tick * NS // 10 for tick in range(11)]
    log.chunk([(1, t_ns, joint_state(t_ns, names, [0.1] * len(names))) for t_ns in stamps])
    return log.write(path)


def session(path, robot):
    with SessionWriter(path, session_id=robot, epoch_ns=EPOCH_NS, robot=load_robot(robot)) as log:
        log.joint_state("/joint_states", ["joint01"], unit="rad").write(EPOCH_NS + 5, [0.1])
    return path


def test_logs_two_months_apart_are_merged_on_request(tmp_path, command):
    early = bag(tmp_path / "early.mcap", ["a", "b"])
    late = bag(tmp_path / "late.mcap", ["a", "b"], EPOCH_NS + 62 * DAY)
    out = tmp_path / "out.mcap"
    merge = ("log", "merge", late, early, "-o", out)
    refused = command(*merge, code=2).err
    assert "late.mcap begins 62.0 days after" in refused
    assert "--apart" in refused
    assert not out.exists()
    report = command(*merge, "--apart").out
    assert "warning: " in report
    assert "62.0 days" in report
    assert len(messages_of(out)) == 22


def test_an_hour_between_logs_is_warned_of_and_a_second_is_not(tmp_path):
    base = bag(tmp_path / "one.mcap", ["a"])
    hour = bag(tmp_path / "hour.mcap", ["a"], EPOCH_NS + 2 * 3600 * NS)
    near = bag(tmp_path / "near.mcap", ["a"], EPOCH_NS + 2 * NS)
    (warning,) = merge_logs([base, hour], tmp_path / "far.mcap").warnings
    assert "hour.mcap begins 2.0 h after" in warning
    assert merge_logs([base, near], tmp_path / "both.mcap").warnings == []
    late = bag(tmp_path / "late.mcap", ["a"], EPOCH_NS + 3 * DAY)
    log = HostileLog()  # that bridges the time between the two
    log.channel("/temperature", log.schema())
    log.chunk([(1, EPOCH_NS + k * DAY, joint_state(EPOCH_NS, ["a"], [20.0])) for k in range(5)])
    report = merge_logs([base, late, log.write(tmp_path / "long.mcap")], tmp_path / "out.mcap")
    assert not any("begins" in text for text in report.warnings)


def test_logs_without_a_joint_in_common_are_warned_of(tmp_path):
    base = bag(tmp_path / "one.mcap", ["a", "b"])
    other = bag(tmp_path / "other.mcap", ["x", "y"])
    warnings = merge_logs([base, other], tmp_path / "out.mcap").warnings
    assert any("has a, b" in text and "are they of one robot?" in text for text in warnings)
    same = bag(tmp_path / "same.mcap", ["b", "c"])
    warnings = merge_logs([base, same], tmp_path / "both.mcap").warnings
    assert not any("one robot" in text for text in warnings)


def test_logs_of_two_robots_are_refused_and_on_request_warned_of(tmp_path):
    first, other = (session(tmp_path / f"{name}.mcap", name) for name in ("snake25", "snake13"))
    with pytest.raises(UsageError, match=r"different robots.*--robot NAME"):
        merge_logs([first, other], tmp_path / "out.mcap")
    warnings = merge_logs([first, other], tmp_path / "out.mcap", robot="snake25").warnings
    assert any("is of snake13, not of snake25" in text for text in warnings)
