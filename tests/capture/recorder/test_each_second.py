"""What is due once a second is done once a second, however often one asks."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from undulog.capture.recorder.status import EachSecond

NS = 1_000_000_000


@pytest.mark.slow
@given(st.lists(st.integers(1_000_000, 200_000_000), min_size=200, max_size=400))
def test_once_a_second_and_one_at_a_time(steps):
    done = [[], [], []]
    now_ns = 5 * NS
    times = []
    schedule = EachSecond([lambda k=k: done[k].append(now_ns) for k in range(3)], now_ns)
    begun_ns = now_ns
    for step in steps:
        now_ns += step
        before = sum(map(len, done))
        schedule.run(now_ns)
        assert sum(map(len, done)) - before <= 1
        times.append(now_ns)
    seconds = (now_ns - begun_ns) / NS
    for calls in done:
        assert abs(len(calls) - seconds) <= 2
    if done[2]:
        assert done[0][0] <= done[1][0] <= done[2][0]


def test_a_long_stop_is_not_made_up_for():
    done = []
    schedule = EachSecond([lambda: done.append(1)], 0)
    for now_ns in range(100 * NS, 103 * NS, NS // 10):
        schedule.run(now_ns)
    assert len(done) == 3
