"""Command against response: the right joints, the right stretch, the samples as they were."""

import dataclasses

import numpy as np
import pytest

from undulog.analysis.present import session_view as signals
from undulog.analysis.present.page import render
from undulog.capture import SessionWriter
from undulog.capture.common.errors import UsageError

RATE_HZ = 100
EPOCH_NS = 1_767_225_600_000_000_000


def test_head_middle_and_tail_of_the_driven_plane(snake, still, single):
    assert signals.chosen_joints(snake.joints) == [0, 12, 24]
    assert signals.chosen_joints(still.joints) == [0, 2, 3]
    assert signals.chosen_joints(single.joints) == [0]


def test_the_last_cycles_of_the_last_window(snake, still):
    assert signals.stretch_s(snake) == (11.0, 16.0)  # 2.5 cycles of 0.5 Hz
    assert signals.stretch_s(still) == (0.0, 3.0)


def test_traces_are_the_samples(snake, recorded, monkeypatch, opened):
    traces = signals.read_traces(opened(recorded), snake)
    assert [trace.joint.name for trace in traces] == ["joint01", "joint13", "joint25"]
    head, middle, _ = traces
    np.testing.assert_allclose(middle.command_t_s, np.arange(1100, 1600) / RATE_HZ, atol=1e-9)
    command = 0.4 * np.sin(np.pi * middle.command_t_s - 2 * np.pi)
    np.testing.assert_allclose(middle.command_rad, command, atol=1e-12)
    assert np.max(middle.response_rad) == pytest.approx(0.4 * middle.joint.gain.value, rel=1e-3)
    assert head.response_rad.size == head.command_rad.size - 1  # the NaN is not drawn
    monkeypatch.setattr(signals, "MOST_POINTS", 100)
    traces = signals.read_traces(opened(recorded), snake)
    assert traces[1].response_rad.size == 100


@pytest.mark.nightly
def test_a_page_that_grows_too_large_goes_without_signals(snake, recorded, monkeypatch, opened):
    session = opened(recorded)
    full = render(snake, session)
    size, left_out = len(full.encode()), "the cycles one by one, are not drawn"
    assert "Command and response of joint01, joint13, joint25" in full
    assert size < 300_000
    monkeypatch.setattr("undulog.analysis.present.page.LARGEST_BYTES", size - 1)
    smaller = render(snake, session)
    assert left_out in smaller
    assert left_out not in full
    monkeypatch.setattr("undulog.analysis.present.page.LARGEST_BYTES", 1000)
    with pytest.raises(UsageError, match=f"would be {len(smaller.encode()) / 1e6:.3g} MB"):
        render(snake, session)


def test_without_topics_the_page_has_no_such_figure(snake, tmp_path, opened):
    path = tmp_path / "empty.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        writer.log("/rosout").write(EPOCH_NS, "info", "test", "nothing else here")
    session = opened(path)
    assert signals.read_traces(session, snake) == ()
    assert "Command and response of joint" not in render(snake, session)


def test_joints_that_the_log_does_not_know_are_left_out(snake, recorded, opened):
    joints = list(snake.joints)
    joints[12] = dataclasses.replace(joints[12], name="stranger")
    other = dataclasses.replace(snake, joints=tuple(joints))
    traces = signals.read_traces(opened(recorded), other)
    assert [trace.joint.name for trace in traces] == ["joint01", "joint25"]
