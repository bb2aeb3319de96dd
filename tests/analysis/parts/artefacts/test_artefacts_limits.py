"""Servos at their limits: reported as such and when, and not taken for a fault of a sensor."""

import numpy as np
import pytest

from support import planted_artefacts, twin_chains
from undulog.analysis.signals.columns import read_columns
from undulog.capture import Session
from undulog.sim import load_scenario, record

STALL = 1.5
"""Of the planted sessions' servos [N m]."""

GAIN = 8.0
"""Kp of the twin's servos [1/rad]."""


def within(t_s, spans_s):
    """Return which times lie in one of the half-open intervals."""
    start_s, stop_s = np.reshape(spans_s, (-1, 2)).T[..., None] - 1e-6
    return ((t_s > start_s) & (t_s < stop_s)).any(axis=0)


@pytest.mark.parametrize("seed", range(5))
def test_torque_cut_at_the_stall_torque_is_a_limit(seed, tmp_path):
    """Asked for a third to twice more than the servo has, for some seconds."""
    snake = planted_artefacts.Snake(seed)
    j, (i, k) = snake.joint(), snake.span(6.0, 10.0)
    asked = snake.effort[i:k, j] * snake.rng.uniform(20.0, 30.0)
    beyond = np.abs(asked) > STALL
    snake.effort[i:k, j] = np.clip(asked, -STALL, STALL)
    (artefact,) = planted_artefacts.artefacts(snake.write(tmp_path / "run.mcap"))
    assert (artefact.joint, artefact.quantity) == (snake.robot.joint_names[j], "effort")
    assert (artefact.flag, artefact.note) == ("saturated", "torque")
    # By the sample: within two of each other, two stretches are one.
    flagged = within(snake.t[i:k], artefact.spans_s)
    assert np.mean(flagged == beyond) > 0.97
    assert not np.any(beyond & ~flagged)


@pytest.mark.nightly
def test_a_weak_twin_gives_its_full_voltage_when_the_servo_law_says(tmp_path):
    """duty = Kp (command - angle), at most 1; nothing else is wrong with the session."""
    (tmp_path / "chain.toml").write_text(twin_chains.chain(5))
    weak = {"gait": {"ramp_s": 1.0}, "servo": {"stall_torque": 0.1}}
    (tmp_path / "weak.toml").write_text(twin_chains.wave(duration_s=5.0, settle_s=2.0, **weak))
    path = tmp_path / "weak.mcap"
    record(load_scenario(tmp_path / "weak.toml"), path)
    artefacts = planted_artefacts.artefacts(path)
    assert {artefact.flag for artefact in artefacts} == {"saturated"}
    shown = {
        artefact.joint: artefact.spans_s for artefact in artefacts if artefact.quantity == "voltage"
    }
    with Session.open(path) as session:
        columns = read_columns(session, "/joint_commands", "/joint_states", lambda _: None)
        start_ns = session.start_ns
    assert sorted(shown) == ["joint01", "joint03", "joint05"]
    for name, spans_s in shown.items():
        command, angle = columns.command[name], columns.position[name]
        np.testing.assert_array_equal(command.t_ns, angle.t_ns)
        t_s = (angle.t_ns - start_ns) * 1e-9
        inside = within(t_s, spans_s)
        # A stretch ends at the sample after it, which the last one has not.
        part = np.abs(duty(t_s, command.values, angle.values))[:-1]
        assert np.mean(part > 0.999) > 0.1
        # Between samples the angle is known to a few thousandths of the duty.
        assert np.all(inside[:-1][part > 0.999])
        assert not np.any(inside[:-1][part < 0.985])


def duty(t_s, command, angle):
    """What the servo law gives, as a mean over the control period around each sample."""
    off_s = (t_s[1] - t_s[0]) * (np.arange(20) - 9.5) / 20
    held = np.stack([np.roll(command, 1) if off < 0 else command for off in off_s])
    held[:, 0] = command[0]
    moved = np.stack([np.interp(t_s + off, t_s, angle) for off in off_s])
    return np.clip(GAIN * (held - moved), -1.0, 1.0).mean(axis=0)
