"""Which joints follow otherwise than the others: level and power in closed form."""

import numpy as np
import pytest

from undulog.analysis.parts.tracking.compare import unlike
from undulog.analysis.parts.tracking.estimate import Tracking, Value

SCATTER = {"gain": 0.02, "lag": 0.004, "offset": np.radians(0.5)}


def joint(gain=1.0, lag_s=0.1, offset_rad=0.0, *, error=1e-4, **changes):
    def value(middle):
        half = 2.0 * error  # of 60 degrees of freedom
        return Value(middle, (middle - half, middle + half), 60.0)

    fields = {
        "command_rad": 0.0,
        "speed_rad_s": 0.5,
        "order": 0,
        "held": False,
        "explained": 0.99,
        "rms_rad": 0.01,
    }
    values = value(gain), value(lag_s), value(offset_rad)
    return Tracking(*values, **fields | changes)


def robot(rng, count):
    """Draw joints of one kind, which differ by a scatter that isn't known."""
    return {
        f"j{k}": joint(
            1 + SCATTER["gain"] * rng.standard_normal(),
            0.1 + SCATTER["lag"] * rng.standard_normal(),
            SCATTER["offset"] * rng.standard_normal(),
        )
        for k in range(count)
    }


@pytest.mark.parametrize("count", [4, 6, 12])
def test_of_joints_of_one_kind_one_robot_in_twenty_is_named_at_most(count):
    """300 robots at 5 %: at most 24 (99 % of a binomial distribution)."""
    rng = np.random.default_rng(count)
    robots = [robot(rng, count) for _ in range(300)]
    assert sum(bool(unlike(joints, [list(joints)])) for joints in robots) <= 24


@pytest.mark.parametrize(
    ("change", "quantity", "size"),
    [
        ({"gain": 0.75}, "gain", -0.25),
        ({"lag_s": 0.2}, "delay", 0.1),
        ({"offset_rad": np.radians(6)}, "offset", np.radians(6)),
    ],
)
def test_one_that_differs_is_named_with_its_size(change, quantity, size):
    joints = robot(np.random.default_rng(7), 8) | {"odd": joint(**change)}
    (difference,) = unlike(joints, [list(joints)])
    assert (difference.joint, difference.quantity, difference.rank) == ("odd", quantity, 1)
    assert difference.deviation == pytest.approx(size, rel=0.1)
    assert difference.ci95[0] < size < difference.ci95[1]


def test_two_that_differ_do_not_hide_each_other():
    joints = robot(np.random.default_rng(3), 10)
    joints |= {"first": joint(gain=0.6), "second": joint(gain=0.62)}
    assert [difference.joint for difference in unlike(joints, [list(joints)])] == [
        "first",
        "second",
    ]


def test_joints_of_two_groups_are_compared_within_each():
    rng = np.random.default_rng(4)
    slow = {f"s{k}": joint(lag_s=0.3 + 0.004 * rng.standard_normal()) for k in range(6)}
    joints = robot(rng, 6)
    assert unlike(joints | slow, [list(joints), list(slow)]) == ()


def test_what_is_within_the_margins_or_not_known_is_not_named():
    alike = {f"j{k}": joint(1.0 + 1e-5 * k, error=1e-6) for k in range(6)}
    near = joint(gain=1.01, lag_s=0.11, offset_rad=np.radians(0.9), error=1e-6)
    assert unlike(alike | {"near": near}, [[*alike, "near"]]) == ()
    silent = joint(gain=0.5, explained=0.4)
    unknown = Tracking(Value(0.5), Value(0.1), Value(0.0), 0.0, 0.5, 0, False, 0.99, 0.01)
    assert unlike(alike | {"s": silent, "u": unknown}, [[*alike, "s", "u"]]) == ()
    three = robot(np.random.default_rng(1), 3)
    assert unlike(three | {"odd": joint(gain=0.5)}, [["odd", "j0", "j1"]]) == ()


def test_a_lag_matters_by_the_angle_that_it_makes():
    rng = np.random.default_rng(5)
    for speed, count in ((1e-3, 0), (0.5, 1)):
        joints = {
            f"j{k}": joint(lag_s=0.1 + 1e-4 * rng.standard_normal(), speed_rad_s=speed)
            for k in range(6)
        }
        late = joint(lag_s=0.15, speed_rad_s=speed)
        assert len(unlike(joints | {"late": late}, [[*joints, "late"]])) == count
