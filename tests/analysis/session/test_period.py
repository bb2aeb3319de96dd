"""Motions without commands whose rhythm wanders, at a period that the user states."""

import numpy as np
import pytest

from support.analysed import analysed
from support.written_topics import EPOCH_NS, write_topics
from undulog.analysis.signals.stretch import Options

NAMES = [f"j{k}" for k in range(8)]
LAG_RAD, AMPLITUDE_RAD, PERIOD_S = 0.7, 0.3, 1.25


def write(path, wander_rad, *, commanded=False):
    """Write a travelling wave whose phase wanders about that of a steady rhythm."""
    t = np.arange(0.0, 50.0, 0.02)
    wander = wander_rad * np.sin(2 * np.pi * 0.06 * t) + wander_rad * np.sin(2 * np.pi * 0.17 * t)
    phase = (2 * np.pi * t / PERIOD_S + wander)[:, None] - LAG_RAD * np.arange(len(NAMES))
    noise = 0.01 * np.random.default_rng(1).standard_normal(phase.shape)
    angles = AMPLITUDE_RAD * np.sin(phase)
    topics = {"/joint_states": (NAMES, "rad", angles + noise)}
    if commanded:
        topics["/joint_commands"] = (NAMES, "rad", angles)
    return write_topics(path, EPOCH_NS + np.rint(t * 1e9).astype(np.int64), topics)


def test_a_rhythm_that_wanders_is_measured_at_the_stated_period(tmp_path, command):
    path = write(tmp_path / "eel.mcap", 0.9)
    assert not analysed(path).free_motion.joints
    result = analysed(path, Options(period_s=PERIOD_S))
    assert result.gait.frequency_hz.value == pytest.approx(1 / PERIOD_S)
    (wave,) = result.free_motion.waves
    low, high = wave.wave_number.ci95
    assert low <= LAG_RAD <= high
    assert wave.direction == "first-to-last"
    # The mean of e^(i wander) over the wander: Bessel's J0 of each of both sines.
    shrunk = AMPLITUDE_RAD * 0.8075**2
    sizes = [joint.amplitude_rad.value for joint in result.free_motion.joints]
    assert sizes == pytest.approx([shrunk] * len(NAMES), rel=0.05)
    assert any("period of 1.25 s is stated, not found" in text for text in result.warnings)
    assert "--period 1.25" in result.provenance.command
    text = command("analyse", path, "--period", "1.25").out
    assert "is stated, not found" in text
    assert "--period -1" in command("analyse", path, "--period", "-1", code=2).err


def test_a_period_too_long_for_the_record_or_beside_commands_is_reported(tmp_path):
    result = analysed(write(tmp_path / "a.mcap", 0.0), Options(period_s=30.0))
    assert any("stated period of 30 s" in text for text in result.warnings)
    result = analysed(write(tmp_path / "b.mcap", 0.0, commanded=True), Options(period_s=3.0))
    assert any("--period is of motions without commands" in text for text in result.notes)
    assert result.gait.frequency_hz.value == pytest.approx(1 / PERIOD_S, rel=1e-3)


@pytest.mark.parametrize("ramp_s", [0.0, 8.0])
def test_a_soft_start_without_commands_is_left_out(tmp_path, ramp_s):
    t = np.arange(0.0, 40.0, 0.02)
    rise = np.minimum(t / ramp_s, 1.0) if ramp_s else np.ones(t.size)
    angles = AMPLITUDE_RAD * np.sin(
        (2 * np.pi * t / PERIOD_S)[:, None] - LAG_RAD * np.arange(len(NAMES))
    )
    noise = 0.002 * np.random.default_rng(2).standard_normal(angles.shape)
    topics = {"/joint_states": (NAMES, "rad", rise[:, None] * angles + noise)}
    path = write_topics(tmp_path / "a.mcap", EPOCH_NS + np.rint(t * 1e9).astype(np.int64), topics)
    result = analysed(path)
    named = [text for text in result.warnings if text.startswith("soft start: ")]
    assert len(named) == (ramp_s > 0)
    assert ramp_s - 0.5 <= result.gait.fitted.start_s <= ramp_s + PERIOD_S
    sizes = [joint.amplitude_rad.value for joint in result.free_motion.joints]
    assert sizes == pytest.approx([AMPLITUDE_RAD] * len(NAMES), rel=2e-3)
    whole = analysed(path, Options(start_s=0.0))
    assert not [text for text in whole.warnings if text.startswith("soft start: ")]
