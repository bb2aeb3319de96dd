"""Times in which the recorder's process does not run, on a clock that the test moves.

Whole recorders that are stopped and continued are in ``test_record_pauses.py``.
"""

import threading

from hypothesis import given
from hypothesis import strategies as st

from undulog.capture.common.process import join_running
from undulog.capture.recorder.pauses import PauseWatch

MS = 1_000_000
TICK_NS = 20 * MS
NO_LOSS = {"can0": 0}


class Loop:
    """A recorder's loop on a simulated clock: ticks of 20 ms, and what delays them."""

    def __init__(self):
        self.now_ns, self.continued, self.suspended_ns = 5_000_000_000, 0, 0
        self.dropped = dict(NO_LOSS)
        self.texts = []
        self.watch = PauseWatch(self.now_ns, lambda: self.continued, lambda: self.suspended_ns)

    def tick(self, late_ns=0, *, signal=False):
        self.now_ns += TICK_NS + late_ns
        self.continued += signal
        self.watch.look(self.now_ns, TICK_NS)
        self.texts += self.watch.report(self.dropped)

    def settle(self):
        for _ in range(30):
            self.tick()


@given(st.lists(st.integers(0, 400 * MS), max_size=40))
def test_late_ticks_alone_are_no_pause(delays_ns):
    loop = Loop()
    for late_ns in delays_ns:
        loop.tick(late_ns)
    loop.settle()
    assert not loop.watch.pauses
    assert not loop.texts


@given(st.integers(10 * MS, 20_000 * MS))
def test_a_stop_by_a_signal_is_one_pause_of_its_length(stop_ns):
    loop = Loop()
    loop.settle()
    loop.tick(stop_ns, signal=True)
    loop.settle()
    (pause,) = loop.watch.pauses
    assert 0 <= pause.ended_ns - pause.began_ns - stop_ns <= TICK_NS
    assert pause.by_signal
    assert len(loop.texts) == 1
    assert "stopped by a signal" in loop.texts[0]
    assert "no frame is counted as lost" in loop.texts[0]


def test_two_stops_one_after_the_other_are_two_pauses():
    loop = Loop()
    loop.tick(50 * MS, signal=True)
    loop.tick(50 * MS, signal=True)
    loop.settle()
    assert len(loop.watch.pauses) == len(loop.texts) == 2


def test_two_stops_within_one_tick_are_two_pauses():
    loop = Loop()
    loop.tick()
    for stop_ns, planned_ns in ((50 * MS, TICK_NS), (70 * MS, 0)):
        loop.now_ns += planned_ns + stop_ns
        loop.continued += 1
        loop.watch.look(loop.now_ns, planned_ns)
    loop.texts += loop.watch.report(NO_LOSS)
    loop.settle()
    first, second = loop.watch.pauses
    assert first.ended_ns == second.began_ns == second.ended_ns - 70 * MS
    assert len(loop.texts) == 2


def test_a_stop_between_a_look_and_its_report_is_a_pause():
    loop = Loop()
    loop.tick()
    loop.watch.look(loop.now_ns)
    loop.continued += 1  # stopped here, for 50 ms
    loop.watch.report(NO_LOSS)
    loop.tick(50 * MS)
    loop.settle()
    assert len(loop.watch.pauses) == len(loop.texts) == 1


def test_what_was_lost_is_counted_until_the_sources_have_settled():
    loop = Loop()
    loop.tick()
    loop.dropped = {"can0": 3}  # before it
    loop.tick()
    loop.tick(1000 * MS, signal=True)
    loop.dropped = {"can0": 3, "can1": None}
    loop.tick()
    loop.dropped = {"can0": 15, "can1": None}  # known a tick later
    loop.settle()
    (text,) = loop.texts
    assert "frames lost meanwhile: can0 12" in text
    assert "can1 counts none" in text


def test_without_a_signal_only_a_long_delay_is_a_pause():
    loop = Loop()
    loop.tick(2000 * MS)
    loop.settle()
    (pause,) = loop.watch.pauses
    assert not pause.by_signal
    assert "did not run for 2.0" in loop.texts[0]


def test_a_suspended_computer_is_a_pause_though_the_clock_stood():
    loop = Loop()
    loop.suspended_ns = 7_500 * MS
    loop.tick()
    loop.settle()
    assert "suspended for 7.50 s" in loop.texts[0]


def test_a_signal_without_a_stop_is_no_pause():
    loop = Loop()
    loop.tick(signal=True)
    loop.settle()
    assert not loop.watch.pauses


def test_the_last_pause_is_reported_at_the_end():
    loop = Loop()
    loop.tick(50 * MS, signal=True)
    assert not loop.texts
    assert len(loop.watch.report(NO_LOSS, ends=True)) == 1
    assert not loop.watch.report(NO_LOSS, ends=True)


def test_a_thread_that_does_not_end_is_not_waited_for_longer_than_the_limit():
    release = threading.Event()
    thread = threading.Thread(target=release.wait)
    thread.start()
    assert not join_running(thread, 0.05)
    release.set()
    assert join_running(thread, 60.0)
