"""Which delays of the recorder's loop are pauses, to the nanosecond, and what is told of them."""

from types import SimpleNamespace

import pytest

from undulog.capture.recorder import pauses
from undulog.capture.recorder.pauses import Pause, PauseWatch

MS, NS = 1_000_000, 1_000_000_000
BEGIN_NS = 7 * NS
SIGNAL = "the recorder was stopped by a signal for"
NO_LOSS = "no frame is counted as lost"


class Loop:
    """A watch, and what it is told: the time, signals and suspensions so far."""

    def __init__(self, continued=3, suspended_ns=40 * NS):
        self.now_ns, self.continued, self.suspended_ns = BEGIN_NS, continued, suspended_ns
        self.watch = PauseWatch(self.now_ns, lambda: self.continued, lambda: self.suspended_ns)

    def look(self, after_ns, planned_ns=0, *, signals=0):
        self.now_ns += after_ns
        self.continued += signals
        self.watch.look(self.now_ns, planned_ns)

    def report(self, dropped=None, **options):
        return self.watch.report({"a": 0} if dropped is None else dropped, **options)

    def end(self, dropped=None):
        return self.report(dropped, ends=True)


# -- which delays are pauses -----------------------------------------------------------------------


@pytest.mark.parametrize("missing_ns", [0, 1])
def test_a_delay_of_5_ms_beside_a_signal_is_a_stop(missing_ns):
    loop = Loop()
    loop.look(20 * MS, 20 * MS)
    loop.look(25 * MS - missing_ns, 20 * MS, signals=1)
    texts = loop.end()
    if missing_ns:
        assert (texts, loop.watch.pauses) == ((), [])
    else:
        began_ns, ended_ns = BEGIN_NS + 20 * MS, BEGIN_NS + 45 * MS
        assert loop.watch.pauses == [Pause(began_ns, ended_ns, 0, by_signal=True)]
        assert texts == (f"{SIGNAL} 0.03 s; {NO_LOSS}",)  # 25 ms, of which 20 were planned


@pytest.mark.parametrize("missing_ns", [0, 1])
def test_half_a_second_without_a_signal_is_a_pause(missing_ns):
    loop = Loop()
    for _ in range(2):  # the longest one is
        loop.look(100 * MS)
    loop.look(500 * MS + 20 * MS - missing_ns, 20 * MS)
    loop.look(100 * MS)
    texts = loop.end()
    if missing_ns:
        assert (texts, loop.watch.pauses) == ((), [])
    else:
        began_ns, ended_ns = BEGIN_NS + 200 * MS, BEGIN_NS + 720 * MS
        assert loop.watch.pauses == [Pause(began_ns, ended_ns, 0, by_signal=False)]
        assert texts == (
            (
                "the recorder did not run for 0.52 s: a debugger, a frozen container, or other "
                f"programs held the processors; {NO_LOSS}"
            ),
        )


@pytest.mark.parametrize("missing_ns", [0, 1])
@pytest.mark.parametrize("delayed", [False, True])
def test_a_tenth_of_a_second_without_the_clock_is_a_suspension(missing_ns, delayed):
    loop = Loop()
    loop.look(20 * MS, 20 * MS)
    if delayed:
        loop.look(7 * MS)
        loop.look(9 * MS)
        loop.look(8 * MS)
    loop.suspended_ns += 100 * MS - missing_ns
    texts = loop.end()
    if missing_ns:
        assert (texts, loop.watch.pauses) == ((), [])
        return
    first_ns = BEGIN_NS + 20 * MS
    began_ns, ended_ns = (first_ns + 7 * MS, first_ns + 16 * MS) if delayed else (first_ns,) * 2
    assert loop.watch.pauses == [Pause(began_ns, ended_ns, 100 * MS, by_signal=False)]
    assert texts == (
        "the computer was suspended for 0.10 s; the session's clock stood meanwhile; " + NO_LOSS,
    )


def test_a_suspension_takes_the_signals_with_it_and_is_counted_once():
    loop = Loop()
    loop.look(60 * MS, signals=2)
    loop.suspended_ns += 3 * NS
    assert loop.report() == ()
    assert loop.watch.pauses == [Pause(BEGIN_NS, BEGIN_NS + 60 * MS, 3 * NS, by_signal=True)]
    loop.look(70 * MS)
    assert len(loop.end()) == 1
    assert len(loop.watch.pauses) == 1


def test_as_many_of_the_longest_delays_as_there_were_signals_are_stops_in_their_order():
    loop = Loop()
    for delay_ms in (30, 80, 6, 50, 90):
        loop.look(delay_ms * MS)
    loop.continued += 3
    texts = loop.end()
    assert [pause.ended_ns - pause.began_ns for pause in loop.watch.pauses] == [
        80 * MS, 50 * MS, 90 * MS,
    ]  # fmt: skip
    assert [text.split(";")[0] for text in texts] == [
        f"{SIGNAL} 0.{k} s" for k in ("08", "05", "09")
    ]


def test_a_stop_beside_a_long_delay_leaves_the_delay_unsaid():
    loop = Loop()
    loop.look(900 * MS)
    loop.look(600 * MS)
    loop.continued += 1
    loop.end()
    assert [pause.ended_ns - pause.began_ns for pause in loop.watch.pauses] == [900 * MS]


@pytest.mark.parametrize(
    ("signals", "delays", "stops"),
    [
        ((1, 0), (0, 1), 1),  # the signal was counted before its delay
        ((2, 0), (1, 2), 2),  # one of two was
        ((1, 0, 0), (0, 0, 1), 0),  # that signal was another one's: it ended no delay
        ((1, 1, 0), (0, 0, 2), 1),  # of the two only the second may still have its delay
        ((1, 1), (0, 2), 2),
        ((0, 1), (1, 0), 0),  # a delay before the signal is not of it
    ],
)
def test_a_signal_may_be_counted_one_report_before_its_delay(signals, delays, stops):
    loop = Loop()
    for new, late in zip(signals, delays, strict=True):
        for _ in range(late):
            loop.look(40 * MS)
        loop.continued += new
        loop.report()
    assert len(loop.watch.pauses) == stops
    assert all(pause.by_signal for pause in loop.watch.pauses)


# -- when and how they are told --------------------------------------------------------------------


def test_pauses_are_told_half_a_second_after_the_last_one():
    loop = Loop()
    loop.look(50 * MS, signals=1)
    assert loop.report() == ()
    loop.look(300 * MS, 300 * MS)
    assert loop.report() == ()
    loop.look(60 * MS, signals=1)
    assert loop.report({"a": 2}) == ()
    loop.look(500 * MS - 1, 500 * MS)
    assert loop.report({"a": 3}) == ()
    loop.look(1, 1)
    lost = "frames lost meanwhile: a 4"
    assert loop.report({"a": 4}) == (f"{SIGNAL} 0.05 s; {lost}", f"{SIGNAL} 0.06 s; {lost}")
    assert loop.report({"a": 9}) == loop.end({"a": 9}) == ()


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ({"a": 0}, {"a": 1}, "frames lost meanwhile: a 1"),
        ({"a": 5, "b": 7}, {"a": 5, "b": 9}, "frames lost meanwhile: b 2"),
        ({"a": 5, "b": 7}, {"a": 6, "b": 9}, "frames lost meanwhile: a 1, b 2"),
        ({"a": 5}, {"a": 4}, NO_LOSS),
        ({}, {"a": 3}, "frames lost meanwhile: a 3"),
        ({"a": None}, {"a": 3}, "frames lost meanwhile: a 3"),
        ({"a": 3}, {"a": None}, f"{NO_LOSS} (a counts none)"),
        ({"a": 3}, {"a": None, "b": 1, "c": None}, "frames lost meanwhile: b 1 (a, c counts none)"),
    ],
)
def test_losses_are_those_since_the_last_report_without_a_pause(before, after, text):
    loop = Loop()
    loop.report({"a": 99})
    loop.report(before)
    loop.look(50 * MS, signals=1)
    assert loop.end(after) == (f"{SIGNAL} 0.05 s; {text}",)
    loop.look(50 * MS, signals=1)  # and then since that one
    (again,) = loop.end(after)
    assert "lost meanwhile" not in again


def test_the_time_of_suspension_is_what_the_monotonic_clock_lacks(monkeypatch):
    clock = SimpleNamespace(
        CLOCK_BOOTTIME=7, clock_gettime_ns=lambda clock: 90 * clock, monotonic_ns=lambda: 600
    )
    monkeypatch.setattr(pauses, "time", clock)
    assert pauses.suspended_ns() == 30
