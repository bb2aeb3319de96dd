"""Rounds of joints that are sampled in turn."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from undulog.capture.bus.rounds import LONGEST_ROUND_NS, RoundGatherer

SAMPLES = st.lists(
    st.tuples(st.integers(0, 4), st.integers(-1_000_000, 60_000_000)), min_size=1, max_size=60
)


def gather(joint, t_ns, values, cuts=()):
    """All rounds of some samples, given in one or several calls."""
    gatherer = RoundGatherer(5, 1)
    parts = np.split(np.arange(len(joint)), cuts)
    rounds = [gatherer.add(t_ns[part], joint[part], values[part]) for part in parts]
    return [*rounds, gatherer.finish()]


def joined(rounds):
    names = ("stamp_ns", "last_ns", "offset_s", "values")
    return [np.concatenate([getattr(r, name) for r in rounds]) for name in names]


@given(samples=SAMPLES, data=st.data())
def test_every_sample_keeps_its_value_and_its_time(samples, data):
    joint = np.array([j for j, _ in samples])
    t_ns = np.cumsum([step for _, step in samples]) + 1_700_000_000_000_000_000
    values = np.arange(len(samples), dtype=np.float64)[:, None]
    cut = data.draw(st.integers(0, len(samples)))
    stamp_ns, last_ns, offset_s, gathered = joined(gather(joint, t_ns, values, [cut]))
    rows, joints = np.nonzero(~np.isnan(offset_s))
    np.testing.assert_array_equal(np.isnan(offset_s), np.isnan(gathered[..., 0]))
    times = {
        (int(j), int(gathered[r, j, 0])): int(stamp_ns[r] + round(offset_s[r, j] * 1e9))
        for r, j in zip(rows, joints, strict=True)
    }
    assert times == {(int(j), i): int(t) for i, (j, t) in enumerate(zip(joint, t_ns, strict=True))}
    assert (np.nanmax(np.abs(offset_s)) * 1e9).round() <= LONGEST_ROUND_NS
    for r, latest in enumerate(last_ns):
        assert latest == stamp_ns[r] + round(np.nanmax(offset_s[r]) * 1e9)
    whole = joined(gather(joint, t_ns, values))
    for part, other in zip((stamp_ns, last_ns, offset_s, gathered), whole, strict=True):
        np.testing.assert_array_equal(part, other)


def test_a_missing_servo_leaves_a_gap_and_not_a_shift():
    joint = np.array([0, 1, 2, 0, 2, 0, 1, 2])
    t_ns = np.array([0, 1, 2, 10, 12, 20, 21, 22]) * 1_000_000
    stamp_ns, _, offset_s, values = joined(gather(joint, t_ns, joint[:, None] * 1.0))
    assert stamp_ns.tolist() == [0, 10_000_000, 20_000_000]
    assert np.isnan(values[1, 1, 0])
    np.testing.assert_allclose(offset_s[:, 2], 0.002, rtol=0, atol=1e-12)


def test_nothing_gives_nothing():
    rounds = gather(np.empty(0, int), np.empty(0, int), np.empty((0, 1)))
    assert [len(array) for array in joined(rounds)] == [0] * 4
