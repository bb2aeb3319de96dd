"""Changes of one joint in signals in closed form: small ones, late ones, few joints."""

import numpy as np
import pytest

from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples

T = np.arange(0.0, 100.0, 0.03)
DEGREE = np.pi / 180


def joints(count, *, offset=0.0, gain=0.0, late_s=0.0, from_s=78.0):
    """Return joints of a slow gait, of which the first changes at a time."""
    rng, after, recorded = np.random.default_rng(1), from_s <= T, []
    for k in range(count):
        changed = after if k == 0 else np.zeros(T.size, bool)
        angle = 2 * np.pi * 0.27 * (T - 0.08 - late_s * changed) - 0.7 * k
        position = 0.3 * (1 + gain * changed) * np.sin(angle) + offset * changed
        command = Samples(T, 0.3 * np.sin(2 * np.pi * 0.27 * T - 0.7 * k))
        noise = 0.004 * rng.normal(size=T.size)
        recorded.append(RecordedJoint(f"j{k}", command, Samples(T, position + noise)))
    return recorded


@pytest.mark.parametrize(
    ("quantity", "size", "change"),
    [
        ("offset", DEGREE, {"offset": DEGREE}),
        ("gain", -0.03, {"gain": -0.03}),
        ("lag", 0.03, {"late_s": 0.03}),
    ],
)
@pytest.mark.parametrize("count", [1, 2])
def test_a_small_change_late_in_a_gait_of_few_joints_has_its_size_and_time(
    quantity, size, change, count
):
    (stated,) = judge(joints(count, **change)).changes
    assert (stated.joint, stated.quantity) == ("j0", quantity)
    assert abs(stated.change - size) <= stated.half_width < abs(size)
    assert stated.onset_s[0] - 0.1 <= 78.0 <= stated.onset_s[1] + 0.1
    assert stated.until_s is None


@pytest.mark.parametrize("count", [1, 2])
def test_few_joints_of_a_gait_without_a_change_have_none(count):
    assert judge(joints(count)).changes == ()


@pytest.mark.parametrize("half", ["first", "second"])
def test_a_vibration_of_one_half_of_ordinary_work_is_a_line(half):
    """A line that comes or goes is beside its own noise: of the whole record no test finds it."""
    recorded = joints(3)
    rng = np.random.default_rng(9)
    work = []
    for k, joint in enumerate(recorded):
        places = np.repeat(rng.uniform(-0.6, 0.6, 34), 100)[: T.size]
        command = np.convolve(places, np.ones(40) / 40, mode="same")
        position = np.interp(T - 0.1, T, command) + 0.002 * rng.normal(size=T.size)
        if k == 1:
            shakes = T < 50 if half == "first" else T >= 50
            position += 0.05 * np.sin(2 * np.pi * 7.3 * T) * shakes
        work.append(RecordedJoint(joint.name, Samples(T, command), Samples(T, position)))
    (line,) = judge(work).extra
    assert line.joint == "j1"
    assert line.frequency_hz == pytest.approx(7.3, abs=0.05)
    assert line.amplitude_rad == pytest.approx(0.05, rel=0.1)
