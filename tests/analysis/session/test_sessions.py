"""Whole sessions of known truth, written by a foreign writer: open, analyse, compare."""

import json
import struct

import numpy as np
import pytest

from support.analysed import analysed
from support.paths import SHARED
from undulog.analysis.signals.stretch import Options
from undulog.capture.common.errors import DataError, MissingChannelError, UsageError

SIGMA = 0.01


def write_wave(bag, wave, noise, *, offsets=True):
    """All joints in one message, polled one after the other over 5 ms."""
    for tick, t_ns in enumerate(wave.ticks_ns):
        own_ns = t_ns + np.rint(wave.skew_s * 1e9).astype(np.int64)
        bag.write_both(t_ns, wave.names, wave.command(t_ns), wave.response(own_ns) + noise[tick])
        if offsets and tick % 10 == 0:  # holds until the next
            bag.write("/joint_sample_offset", t_ns, wave.names, wave.skew_s)
    return bag


def lags(result):
    return np.array([joint.lag_rad.value for joint in result.joints])


def gains(result):
    return np.array([joint.gain.value for joint in result.joints])


def inside(estimates, truth):
    return [e.ci95[0] <= value <= e.ci95[1] for e, value in zip(estimates, truth, strict=True)]


@pytest.mark.nightly
def test_twenty_sessions_of_known_gain_lag_and_noise(bag, wave):
    """f = 0.97 Hz, 7.3 s at 100 Hz, A 0.3 to 0.5 rad, sigma = 0.01 rad, polling skew 5 ms."""
    rng = np.random.default_rng(2024)
    error, score, covered, gain_covered = [], [], [], []
    for k in range(20):
        truth = wave(rng)
        noise = rng.normal(0, SIGMA, (truth.ticks_ns.size, 25))
        result = write_wave(bag(f"{k}.mcap"), truth, noise).analysed()
        assert result.gait.frequency_hz.value == pytest.approx(0.97, abs=1e-8)
        error.append(lags(result) - truth.lag)
        score.append(error[-1] / truth.bound(SIGMA))
        covered += inside([j.lag_rad for j in result.joints], truth.lag)
        gain_covered += inside([j.gain for j in result.joints], truth.gain)
        assert all(joint.flags == () for joint in result.joints)
    # 500 lags: standard error of the ratio 3.2 %, of each coverage 1 %, of both together 0.7 %.
    assert np.sqrt(np.mean(np.square(score))) < 1.1
    assert 0.93 <= np.mean(covered) <= 0.97
    assert 0.93 <= np.mean(covered + gain_covered) <= 0.97
    # The last joint is sampled 5 ms late, 1.75 degrees at this frequency.
    assert np.max(np.abs(np.degrees(np.mean(error, axis=0)))) < 0.05
    assert abs(np.degrees(np.polyfit(truth.skew_s, np.mean(error, axis=0), 1)[0] * 5e-3)) < 0.05


@pytest.mark.nightly
def test_polling_skew_biases_the_lag_only_where_it_is_not_logged(bag, wave):
    truth = wave(np.random.default_rng(3))
    still = np.zeros((truth.ticks_ns.size, 25))
    logged = write_wave(bag("known.mcap"), truth, still).analysed()
    unknown = write_wave(bag("unknown.mcap"), truth, still, offsets=False).analysed()
    assert np.max(np.abs(np.degrees(lags(logged) - truth.lag))) < 1e-5
    biased = np.degrees(lags(unknown) - truth.lag)
    np.testing.assert_allclose(biased, -np.degrees(truth.omega * truth.skew_s), atol=1e-5)


def test_one_message_per_servo_is_read_right(bag, wave):
    truth = wave(np.random.default_rng(4), joints=7, duration=6.0)
    log = bag()
    for t_ns in truth.ticks_ns:
        # Servos are polled in turn, each with a stamp of its own, every other one half as often.
        for i, name in enumerate(truth.names):
            own_ns = t_ns + i * 1_000_000
            log.write("/joint_commands", own_ns, [name], [truth.command(own_ns)[i]])
            if i % 2 == 0 or t_ns % 20_000_000 < 10_000_000:
                own_ns += 300_000
                log.write("/joint_states", own_ns, [name], [truth.response(own_ns)[i]])
    result = log.analysed()
    assert [joint.name for joint in result.joints] == truth.names
    np.testing.assert_allclose(lags(result), truth.lag, atol=1e-7)
    np.testing.assert_allclose(gains(result), truth.gain, atol=1e-7)
    assert result.joints[0].samples > 1.9 * result.joints[1].samples
    assert all(joint.coverage == pytest.approx(1.0, abs=0.02) for joint in result.joints)


def test_energies_of_sinusoidal_torque_and_velocity(bag, epoch_ns):
    """Closed form: with tau = T sin(wt + p), q' = V cos(wt), net = T V sin(p) / 2 a second."""
    log = bag()
    omega, torque, phase = 2 * np.pi * 0.8, 0.7, np.array([0.3, -0.4])
    speed = 0.4 * omega
    for tick in range(1000):
        turn = omega * tick / 100 * np.ones(2)
        q, rate, effort = 0.4 * np.sin(turn), speed * np.cos(turn), torque * np.sin(turn + phase)
        log.write_both(epoch_ns + tick * 10**7, ["a", "b"], q, q, rate, effort)
    result = log.analysed()
    (window,) = result.gait.windows
    assert (window.cycles, window.stop_s - window.start_s) == (8, pytest.approx(10.0))
    net = torque * speed * np.sin(phase) / 2 * 10
    # |sin(wt + p) cos(wt)| = |sin(2wt + p) + sin p| / 2, mean over a cycle.
    absolute = torque * speed * (np.abs(phase) * np.sin(np.abs(phase)) + np.cos(phase)) / np.pi * 10
    for joint, n, a in zip(result.joints, net, absolute, strict=True):
        assert joint.energy_net_j == pytest.approx(n, rel=1e-9)
        assert joint.energy_abs_j == pytest.approx(a, rel=1e-4)
        assert joint.energy_plus_j == pytest.approx((a + n) / 2, rel=1e-4)
        assert joint.energy_el_j is None
    assert any("electrical energies are null" in text for text in result.notes)


def test_a_ramp_has_no_gait(bag, epoch_ns):
    log = bag()
    for tick in range(600):
        q = np.array([0.02, -0.01]) * tick / 100
        log.write_both(epoch_ns + tick * 10**7, ["a", "b"], q, q - 1e-3)
    result = log.analysed()
    assert (result.gait.frequency_hz.value, result.gait.wave) == (None, None)
    for joint in result.joints:
        assert (joint.gain.value, joint.gain.ci95, joint.lag_rad.value) == (None, None, None)
        assert (joint.command_amplitude_rad, joint.samples) == (None, 600)
    assert {index.value for index in result.heterogeneity.values()} == {None}
    (why,) = [text for text in result.warnings if text.startswith("no gait")]
    assert "no rhythm of at least 3 cycles" in why


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_a_constant_command_has_no_gait(bag, epoch_ns, value):
    log = bag()
    rng = np.random.default_rng(1)
    for tick in range(300):
        response = [value + rng.normal(0, 1e-3)]
        log.write_both(epoch_ns + tick * 10**7, ["a"], [value], response)
    result = log.analysed()
    assert result.gait.frequency_hz.value is None
    assert any("the commands never move" in text for text in result.warnings)


def test_two_cycles_are_not_a_gait(bag, wave):
    truth = wave(np.random.default_rng(5), joints=2, frequency=0.5, duration=4.0)
    result = write_wave(bag(), truth, np.zeros((truth.ticks_ns.size, 2))).analysed()
    assert result.gait.frequency_hz.value is None
    assert any(text.startswith("no gait") for text in result.warnings)


def test_a_real_arcsnake_trajectory_has_no_gait(bag):
    """ArcSnake's recorded trajectory is a ramp; the lag of 7.4 ms needs no gait to be there."""
    log = SHARED / "arcsnake" / "linear_trajectory.candump.log"
    if not log.exists():
        pytest.skip(f"the recording {log} is not here")
    session_log = bag()
    for line in log.read_text().splitlines():
        stamp, _, frame, way = line.split()
        data = bytes.fromhex(frame.partition("#")[2])
        seconds, _, fraction = stamp.strip("()").partition(".")
        t_ns = int(seconds) * 10**9 + int(fraction) * 1000
        if data[0] == 0xA4 and way == "T":
            angle = np.radians(struct.unpack("<i", data[4:8])[0] * 0.01)
            session_log.write("/joint_commands", t_ns, ["screw"], [angle])
        elif data[0] == 0x92 and way == "R":
            angle = np.radians(int.from_bytes(data[1:8], "little", signed=True) * 0.01)
            session_log.write("/joint_states", t_ns, ["screw"], [angle])
    result = session_log.analysed()
    (joint,) = result.joints
    assert (joint.gain.value, joint.lag_rad.value) == (None, None)
    assert joint.samples > 1000
    assert any(text.startswith("no gait") for text in result.warnings)
    assert result.to_dict()["joints"][0]["lag_ci95"] is None


def test_joints_that_are_held_have_no_gain_and_are_named_once(bag, wave):
    truth = wave(np.random.default_rng(6), joints=6, duration=8.0)
    log = bag()
    for t_ns in truth.ticks_ns:
        command, response = truth.command(t_ns), truth.response(t_ns)
        command[1::2] = response[1::2] = 0.0
        log.write_both(t_ns, truth.names, command, response)
    result = log.analysed()
    assert [joint.gain.value is None for joint in result.joints] == [False, True] * 3
    assert all(joint.command_amplitude_rad == 0.0 for joint in result.joints[1::2])
    named = [text for text in (*result.warnings, *result.notes) if "joint02" in text]
    assert len(named) == 1
    assert "3 joints are held still" in named[0]
    np.testing.assert_allclose(gains(result)[::2].astype(float), truth.gain[::2], atol=1e-7)


def test_artefacts_are_dropped_flagged_and_reported(bag, wave):
    truth = wave(np.random.default_rng(7), joints=3, duration=8.0)
    log = bag()
    for tick, t_ns in enumerate(truth.ticks_ns):
        response = truth.response(t_ns)
        if 100 <= tick < 103:
            response[0] = np.nan
        log.write("/joint_commands", t_ns, truth.names, truth.command(t_ns))
        if not 300 <= tick < 380:
            log.write("/joint_states", t_ns, truth.names, response)
        if tick in (20, 21):
            log.write("/joint_states", t_ns, truth.names, response + 5.0)
    result = log.analysed()
    assert result.joints[0].flags == ("nan", "duplicate_stamps", "gaps")
    assert result.joints[1].flags == ("duplicate_stamps", "gaps")
    assert result.joints[1].coverage == pytest.approx(0.9, abs=0.02)
    np.testing.assert_allclose(lags(result), truth.lag, atol=1e-7)
    assert any("3 samples that are not numbers and 6 with a time" in t for t in result.warnings)


def test_dead_and_frozen_joints_are_left_out_and_named(bag, wave):
    rng = np.random.default_rng(11)
    truth = wave(rng, joints=12, duration=8.0)
    log = bag()
    for tick, t_ns in enumerate(truth.ticks_ns):
        response = truth.response(t_ns) + rng.normal(0, 1e-3, 12)
        response[2] = 0.1
        response[4] = 0.2 + rng.normal(0, 1e-3)
        if 300 <= tick < 400:
            response[6] = 0.1234
        log.write_both(t_ns, truth.names, truth.command(t_ns), response)
    result = log.analysed()
    lost = [joint.name for joint in result.joints if joint.lag_rad.value is None]
    assert lost == ["joint03", "joint05", "joint07"]
    assert all(joint.gain.value is None for joint in result.joints if joint.name in lost)
    assert [joint.flags for joint in result.joints if joint.flags] == [("frozen",), ("frozen",)]
    same = "joint03, joint07: position on /joint_states: values stay exactly the same"
    for beginning in (same, "joint05: no response"):
        assert any(text.startswith(beginning) for text in result.warnings)
    assert [(artefact.joint, artefact.flag, artefact.about) for artefact in result.artefacts] == [
        ("joint03", "frozen", "sensor or joint"),
        ("joint07", "frozen", "sensor or joint"),
    ]
    (span,) = result.artefacts[1].spans_s
    assert span == pytest.approx((3.0, 3.99), abs=1e-6)
    sound = np.delete(truth.gain, [2, 4, 6])
    spread = result.heterogeneity["gain_cv"]
    assert spread.value == pytest.approx(sound.std() / sound.mean(), abs=0.003)
    assert result.heterogeneity["boundary_contrast_lag"].value is None
    assert json.dumps(result.to_dict(), allow_nan=False)


def test_samples_without_effort_count_no_energy(bag, epoch_ns):
    log = bag()
    for tick in range(1000):
        q, effort = [0.4 * np.sin(5 * tick / 100)], [2.0 if tick < 600 else np.nan]
        log.write_both(epoch_ns + tick * 10**7, ["a"], q, q, [1.0], effort)
    result = log.analysed()
    (window,) = result.gait.windows
    assert result.joints[0].energy_net_j == pytest.approx(2.0 * (6.0 - window.start_s), abs=0.05)
    assert result.joints[0].coverage == pytest.approx(1.0)
    assert any("the power of a has gaps" in text for text in result.warnings)


def test_missing_commands_and_missing_responses(bag, wave):
    truth = wave(np.random.default_rng(8), joints=2)
    no_commands, no_responses, neither = bag("a.mcap"), bag("b.mcap"), bag("c.mcap")
    for t_ns in truth.ticks_ns:
        no_commands.write("/joint_states", t_ns, truth.names, truth.response(t_ns))
        no_responses.write("/joint_commands", t_ns, truth.names, truth.command(t_ns))
        neither.write("/arm/left", t_ns, truth.names, truth.response(t_ns))
        neither.write("/arm/right", t_ns, truth.names, truth.response(t_ns))
    result = no_commands.analysed()
    assert result.gait.frequency_hz.value == pytest.approx(0.97, abs=1e-7)
    assert result.joints[0].gain.value is None
    why = "no command logged: no commands on /joint_commands: gain and lag are null"
    assert why in result.warnings
    result = no_responses.analysed()
    assert result.gait.frequency_hz.value == pytest.approx(0.97, abs=1e-7)
    assert result.joints[0].flags == ("not_recorded",)
    assert result.joints[0].command_amplitude_rad == pytest.approx(truth.amplitude[0], abs=1e-7)
    with pytest.raises(
        MissingChannelError, match=r"it has /arm/left, /arm/right .choose with --command-topic"
    ):
        neither.analysed()
    named = Options(response_topic="/arm/left")
    assert analysed(neither.path, named).joints[0].samples > 600


def test_start_and_stop(bag, wave):
    truth = wave(np.random.default_rng(9), joints=2, duration=9.0)
    log = write_wave(bag(), truth, np.zeros((truth.ticks_ns.size, 2)), offsets=False)
    result = log.analysed(Options(start_s=2.0, stop_s=7.0))
    (window,) = result.gait.windows
    assert (window.stop_s, window.cycles) == (pytest.approx(7.0), 4)
    assert window.stop_s - window.start_s == pytest.approx(4 / 0.97)
    assert result.gait.fitted.start_s == pytest.approx(2.0)
    assert "--start 2.0 --stop 7.0" in result.provenance.command
    with pytest.raises(UsageError, match="nothing between --start and --stop"):
        analysed(log.path, Options(start_s=20.0))


def test_standing_still_at_the_ends_is_left_out(bag, wave):
    truth = wave(np.random.default_rng(10), joints=3, duration=12.0)
    log = bag()
    last = truth.ticks_ns.size - 1
    for tick in range(last + 1):
        inside_ns = truth.ticks_ns[min(max(tick, 300), last - 200)]
        command, response = truth.command(inside_ns), truth.response(inside_ns)
        log.write_both(truth.ticks_ns[tick], truth.names, command, response)
    result = log.analysed()
    fitted = result.gait.fitted
    assert (fitted.start_s, fitted.stop_s) == pytest.approx((3.0, 10.0), abs=0.02)
    np.testing.assert_allclose(lags(result), truth.lag, atol=1e-2)


def test_commands_and_responses_that_never_overlap(bag, wave):
    truth = wave(np.random.default_rng(12), joints=2)
    log = bag()
    for t_ns in truth.ticks_ns:
        log.write("/joint_commands", t_ns, truth.names, truth.command(t_ns))
        log.write("/joint_states", t_ns + 60 * 10**9, truth.names, truth.response(t_ns))
    with pytest.raises(DataError, match="don't overlap in time"):
        log.analysed()
