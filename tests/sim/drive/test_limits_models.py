"""Clamp and spacing against plain models, joint by joint and nanosecond by nanosecond."""

import math
import random
from fractions import Fraction

import numpy as np
import pytest

from undulog.capture.robot.model import OnFault
from undulog.sim.drive.limits import Clamp, EndingRamp, GateLimits, Ramp, Spacing
from undulog.sim.drive.outcome import JointStatus

NS = 1_000_000_000
RATE, LOWER, UPPER = [4.0, 2.0, 1.0, 3.0], [-0.5, 0.1, -1.0, -0.7], [0.5, 0.6, -0.2, 0.7]
REASONS = ("by_position", "by_rate", "unconfirmed", "not_finite")


def limits(**more):
    names, nothing = ("a", "b", "c", "d"), np.full(4, np.nan)
    values = dict(zip(("lower", "upper", "rate"), map(np.array, (LOWER, UPPER, RATE)), strict=True))
    values |= {"ramp_rate": np.array([0.5, 0.25, 0.4, 1.0]), "tracking_error": np.full(4, 0.3)}
    values |= dict.fromkeys(("current", "temperature", "voltage"), nothing)
    values |= {"reply_timeout_s": 0.25, "late_s": 0.2, "fault_after_s": 0.3}
    return GateLimits(names, **(values | {"on_fault": OnFault.RAMP_DOWN} | more))


def within(value, lower, upper):
    return min(max(value, lower), upper)


def test_a_clamp_is_that_of_a_plain_one_joint_by_joint():
    chance, period_s = random.Random(3), 0.01
    for _ in range(20):
        pose = [chance.uniform(-1.2, 1.2) for _ in RATE]
        clamp = Clamp(limits(), np.array(pose), period_s)
        last, cuts = list(map(within, pose, LOWER, UPPER)), dict.fromkeys(REASONS, 0)
        assert clamp.last.tolist() == last
        for _ in range(25):
            wild = [0.0, 0.004, 0.02, -0.03, 9.0, -9.0, math.nan, math.inf, -math.inf]
            wishes = [angle + chance.choice(wild) for angle in last]
            spread = [(chance.uniform(0, 0.05), chance.uniform(-0.01, 0.05)) for _ in last]
            bounds = [(angle - a, angle + b) for angle, (a, b) in zip(last, spread, strict=True)]
            bounded = chance.random() < 0.7
            given = tuple(np.array(bounds).T) if bounded else None
            clamped = clamp.apply(np.array(wishes), given)
            for k, rate in enumerate(RATE):
                finite, before = math.isfinite(wishes[k]), last[k]
                inside = within(wishes[k] if finite else before, LOWER[k], UPPER[k])
                reached = within(inside, before - rate * period_s, before + rate * period_s)
                least, most = bounds[k] if bounded else (-math.inf, math.inf)
                last[k] = within(reached, min(least, before), max(most, before))
                changes = (
                    finite and abs(inside - wishes[k]) > 1e-12, abs(inside - reached) > 1e-12,
                    abs(reached - last[k]) > 1e-12, not finite,
                )  # fmt: skip
                assert clamped.command[k] == clamp.last[k] == last[k]
                for reason, changed in zip(REASONS, changes, strict=True):
                    assert getattr(clamped, reason)[k] == changed, (reason, k)
                    cuts[reason] += changed
            assert clamp.cuts == cuts
        assert min(cuts.values()) > 0


def test_frames_wait_for_as_long_as_the_slowest_joint_needs():
    chance = random.Random(5)
    rate = np.array(RATE)
    for _ in range(20):
        now_ns = NS * 10**9
        spacing, last, sent_ns = Spacing(rate, lambda: now_ns), None, None  # noqa: B023
        waits, longest = 0, Fraction(0)
        for _ in range(20):
            now_ns += chance.choice([0, 1, 3_000_000, 9_999_999, 10_000_000, 25_000_000])
            command, count = (
                [chance.randrange(-20, 20) * 2**-10 for _ in RATE],
                chance.choice([3, 3, 2]),
            )
            earliest_ns = spacing.earliest_ns(np.array(command), count).tolist()
            if last is None:
                expected = [0] * count
            else:
                needs = (
                    Fraction(abs(a - b)) / int(r)
                    for a, b, r in zip(command, last, RATE, strict=True)
                )
                need_ns = math.ceil(float(max(needs)) * NS)
                before = sent_ns if len(sent_ns) == count else [max(sent_ns)] * count
                expected = [at_ns + need_ns for at_ns in before]
                if max(expected) > now_ns:
                    waits, longest = waits + 1, max(longest, Fraction(max(expected) - now_ns, NS))
            assert earliest_ns == expected
            assert (spacing.waits, spacing.longest_s) == (waits, pytest.approx(float(longest)))
            if chance.random() < 0.8:
                last = command
                sent_ns = [max(now_ns, at_ns) + k for k, at_ns in enumerate(earliest_ns)]
                spacing.sent(np.array(command), np.array(sent_ns))
        assert waits > 0


@pytest.mark.parametrize("how", list(OnFault))
def test_an_ending_is_a_ramp_from_where_each_joint_is_to_its_rest(how):
    chance, given = random.Random(7), limits(on_fault=how)
    for _ in range(40):
        last = [chance.uniform(a, b) for a, b in zip(LOWER, UPPER, strict=True)]
        away = [chance.choice([0.0, 0.29, -0.29, 0.31, -0.31, math.nan, 5.0]) for _ in last]
        angle = np.add(last, away)
        nothing = np.full(4, np.nan)
        status = JointStatus(angle, nothing, nothing, nothing, np.zeros(4))
        ending = EndingRamp(given, np.array(last), status)
        starts = [
            within(angle[k] if abs(away[k]) > 0.3 else last[k], LOWER[k], UPPER[k])
            for k in range(4)
        ]
        hold = how is OnFault.HOLD
        rests = starts if hold else [within(0.0, LOWER[k], UPPER[k]) for k in range(4)]
        ways = [abs(rests[k] - starts[k]) / given.ramp_rate[k] for k in range(4)]
        back_s = max(abs(starts[k] - last[k]) / RATE[k] for k in range(4))
        assert ending.duration_s == pytest.approx(back_s + 1.5 * max(ways) + 0.2)
        for share in (0.0, 0.25, 0.5, 0.9, 1.0, 3.0):
            x = min(share, 1.0)
            smooth = 3 * x**2 - 2 * x**3
            expected = [a + smooth * (b - a) for a, b in zip(starts, rests, strict=True)]
            angles = ending.at(share * 1.5 * max(ways))
            np.testing.assert_allclose(angles, expected, rtol=0, atol=1e-12)


def test_a_ramp_is_steepest_in_its_middle_where_the_slowest_joint_has_its_rate():
    start, target, rate = np.array([0.1, -0.3]), np.array([0.5, 0.3]), np.array([0.4, 0.5])
    ramp = Ramp(start, target, rate)
    middle, step_s = ramp.duration_s / 2, 1e-5
    slope = (ramp.at(middle + step_s) - ramp.at(middle - step_s)) / (2 * step_s)
    np.testing.assert_allclose(slope, [0.4 * 0.5 / 0.6, 0.5], rtol=1e-6)
    start[:] = target[:] = 9.0  # what was given may change
    np.testing.assert_allclose(ramp.at(0.0), [0.1, -0.3])
    np.testing.assert_allclose(ramp.at(1e3), [0.5, 0.3])
