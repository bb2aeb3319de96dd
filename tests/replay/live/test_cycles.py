"""Cycles computed while a session comes in are those of its analysis."""

import os

import numpy as np
import pytest
from mcap.reader import make_reader

from support.live_stage import EPOCH_NS, WAIT_S, Relay, seen_live
from support.processes import UNDULOG, process
from support.written_topics import write_topics
from undulog.analysis.session.analyse import analyse_session
from undulog.capture import Session
from undulog.capture.recorder.live_wire import LiveMessage
from undulog.capture.robot.model import Plane
from undulog.replay.live.cycles import CycleMeter
from undulog.replay.live.decode import LiveLog

FREQUENCY_HZ = 0.8
GAIN = 0.95
TORQUE, SPEED = 0.2, 0.5


@pytest.fixture(scope="module")
def walk(snake25, tmp_path_factory):
    """Nine seconds: known gain and lag of the yaw joints, each sampled in its turn, with noise.

    The torque goes with the velocity, so that each cycle's mean power is half the product of their
    amplitudes. From 4 s on the gait is half as large: a run of its own.
    """
    path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    yaw = snake25.joint_indices(Plane.HORIZONTAL)
    k, t = np.arange(len(yaw)), np.arange(900)[:, None] / 100.0
    offset = np.tile(np.linspace(0.0, 6e-3, 25), (900, 1))
    omega = 2 * np.pi * FREQUENCY_HZ
    size = np.where(t < 4.0, 0.4, 0.2)
    wave = omega * (t + offset[:, yaw]) - k * np.pi / 6
    noise = np.random.default_rng(5).normal(0, 1e-4, wave.shape)
    command, position, velocity, effort = np.zeros((4, 900, 25))
    command[:, yaw] = size * np.sin(omega * t - k * np.pi / 6)
    position[:, yaw] = GAIN * size * np.sin(wave - 0.1 - 0.02 * k) + noise
    velocity[:, yaw] = SPEED * np.cos(wave)
    effort[:, yaw] = TORQUE * np.cos(wave)
    phase = np.angle(np.exp(1j * omega * t))  # within a turn, as some controllers log it
    gait = np.hstack([size, np.full_like(t, omega), np.full_like(t, np.pi / 6), phase])
    parts = ["horizontal.A", "horizontal.omega", "horizontal.lag", "horizontal.phase"]
    names = snake25.joint_names
    topics = {
        "/joint_sample_offset": (names, "s", offset),
        "/joint_commands": (names, "rad", command),
        "/joint_states": (names, "rad", position, velocity, effort),
        "/gait": (parts, "rad, omega in rad/s", gait),
    }
    write_topics(path, EPOCH_NS + np.arange(900) * 10_000_000, topics, robot=snake25)
    return path


def measured_in_batches(path, length_ns):
    """All cycles of a file that comes in pieces."""
    log, cycles, meter = LiveLog(), [], None
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        for record in (
            *reader.iter_metadata(),
            *summary.schemas.values(),
            *summary.channels.values(),
            *reader.iter_attachments(),
        ):
            log.define(record)
        batch, end_ns = [], 0
        for _, _, m in reader.iter_messages():
            meter = meter or CycleMeter(m.log_time)
            if m.log_time >= end_ns:
                cycles += meter.add(log.decode(batch), log.robot)
                batch, end_ns = [], m.log_time + length_ns
            message = LiveMessage(m.channel_id, m.sequence, m.log_time, m.publish_time, 0, m.data)
            batch.append(message)
    return [*cycles, *meter.add(log.decode(batch), log.robot)]


@pytest.mark.nightly
@pytest.mark.parametrize("length_ns", [30_000_000, 700_000_000, 7_000_000_000, 20_000_000_000])
def test_cycles_are_those_of_the_analysis_however_they_come_in(walk, length_ns):
    with Session.open(walk) as session:
        joints = {joint.name: joint for joint in analyse_session(session).over_time.joints}
        start_ns = session.start_ns
    cycles = measured_in_batches(walk, length_ns)
    assert len({cycle.start_ns for cycle in cycles}) == len(cycles)  # each once
    given = {}
    for cycle in cycles:
        for name, gain, lag in zip(cycle.names, cycle.gain, cycle.lag_rad, strict=True):
            if np.isfinite(gain):
                given[name, round((cycle.start_ns - start_ns) * 1e-6)] = gain, lag
    expected = {
        (name, round(start_s * 1e3)): (gain, lag)
        for name, joint in joints.items()
        for start_s, gain, lag in zip(joint.start_s, joint.gain, joint.lag_rad, strict=True)
        if gain is not None
    }
    assert len(expected) == 13 * 4  # two whole cycles and their surroundings in either run
    assert given.keys() == expected.keys()
    ours = [given[key] for key in expected]
    np.testing.assert_allclose(ours, [*expected.values()], rtol=0, atol=1e-9)


def test_gain_lag_and_power_are_those_that_were_written(walk, snake25):
    cycles = measured_in_batches(walk, 50_000_000)
    yaw = snake25.joint_indices(Plane.HORIZONTAL)
    for cycle in cycles:
        assert cycle.names == snake25.joint_names
        np.testing.assert_allclose(cycle.gain[yaw], GAIN, atol=2e-3)
        np.testing.assert_allclose(cycle.lag_rad[yaw], 0.1 + 0.02 * np.arange(13), atol=2e-3)
        np.testing.assert_allclose(cycle.power_w[yaw], TORQUE * SPEED / 2, rtol=0.01)
        assert np.isnan(np.delete(cycle.gain, yaw)).all()  # held still
        assert (cycle.stop_ns - cycle.start_ns) * 1e-9 == pytest.approx(1 / FREQUENCY_HZ, abs=1e-6)


def test_without_a_logged_phase_there_are_no_cycles(write, tmp_path):
    assert measured_in_batches(write(tmp_path / "a.mcap", gait=False), 50_000_000) == []


@pytest.mark.nightly
def test_the_live_view_draws_bars_and_steps_of_each_cycle(walk, snake25, tmp_path, read_back):
    report, output = seen_live(walk, tmp_path)
    assert report["dropped"] == report["unread"] == 0
    drawn = read_back(output)
    expected = measured_in_batches(walk, 50_000_000)
    starts = [cycle.start_ns - EPOCH_NS for cycle in expected]
    for key, of in (
        ("gain_minus_one_percent", lambda cycle: 100 * (cycle.gain - 1)),
        ("lag_degrees", lambda cycle: np.degrees(cycle.lag_rad)),
        ("power_milliwatt", lambda cycle: 1e3 * cycle.power_w),
    ):
        steps = f"/cycles/{key}"
        assert drawn.times(steps).tolist() == starts
        shown = np.array(drawn.column(steps, "Scalars:scalars"), dtype=float)
        np.testing.assert_allclose(shown, [of(cycle) for cycle in expected], atol=1e-4)
        for i in (0, 24):
            bar = f"/segments/{key}/estimate/{snake25.joint_names[i]}"
            assert drawn.times(bar).tolist() == starts
            heights = [row[0]["buffer"] for row in drawn.column(bar, "BarChart:values")]
            measured = [of(cycle)[i] for cycle in expected]
            np.testing.assert_allclose(np.ravel(heights).astype(float), measured, atol=1e-4)


@pytest.mark.nightly
def test_a_real_recording_is_seen_as_it_is_analysed_afterwards(tmp_path, read_back, opened):
    """A recorder of the twin in real time, and a relay: two processes."""
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    environment.pop("RUNTIME_DIRECTORY", None)
    session_file, sockets = tmp_path / "run.mcap", tmp_path / "undulog"
    sockets.mkdir(mode=0o700)
    relay = Relay(sockets / "run.live", tmp_path / "live.rrd")
    words = ("record", "twin:weak-servo-pi3", "-o", session_file, "--duration", "9s", "--quiet")
    try:
        with process(*UNDULOG, *words, env=environment) as recorder:
            report = relay.finish()
            assert recorder.wait(WAIT_S) == 0
    finally:
        relay.process.kill()
        relay.process.wait()
    assert report["dropped"] == report["unread"] == 0
    drawn = read_back(tmp_path / "live.rrd")
    joints = {joint.name: joint for joint in analyse_session(opened(session_file)).over_time.joints}
    names = drawn.static("/cycles/lag_degrees", "SeriesLines:names")
    rows = drawn.column("/cycles/lag_degrees", "Scalars:scalars")
    assert len(rows) >= 2
    # The feed found its relay a moment after the gait began, so the cycles are not the same ones;
    # once the gait has settled they are alike.
    given = {name: lag for name, lag in zip(names, rows[-1], strict=True) if np.isfinite(lag)}
    assert len(given) == 13
    for name, lag in given.items():
        assert lag == pytest.approx(np.degrees(joints[name].lag_rad[-1]), abs=0.05)
