"""Events without flooding, trying again without hammering, and what error frames mean."""

import numpy as np

from undulog.capture.log.messages.frames import ERROR_FLAG, empty_frames
from undulog.capture.sources.events import BUS_OFF, RESTARTED, BusWatch, EventLog, Tally
from undulog.capture.sources.link import Backoff

S = 1_000_000_000


class Clock:
    """A session's clock that stands still until it is set."""

    def __init__(self):
        self.t_ns = 10**18

    def __call__(self):
        return self.t_ns


def test_one_text_is_logged_once_a_second_with_its_count():
    clock = Clock()
    events = EventLog(clock)
    logged = []
    for _ in range(2500):  # one each millisecond
        events.log_event("warn", "malformed line")
        logged += events.take()
        clock.t_ns += S // 1000
    logged += events.flush()
    counts = ("", *(f" ({count} times)" for count in (1000, 1000, 499)))
    assert [event.text for event in logged] == [f"malformed line{count}" for count in counts]
    assert [(event.t_ns - 10**18) // 10**6 for event in logged] == [0, 1000, 2000, 2500]
    assert {event.level for event in logged} == {"warn"}
    assert events.flush() == ()


def test_different_texts_do_not_hide_each_other():
    events = EventLog(Clock())
    for text in ("a", "b", "a"):
        events.log_event("info", text)
    assert [event.text for event in events.take()] == ["a", "b"]
    assert [event.text for event in events.flush()] == ["a"]


def test_after_a_quiet_second_the_next_is_logged_at_once():
    clock = Clock()
    events = EventLog(clock)
    events.log_event("info", "a")
    events.take()
    clock.t_ns += 2 * S
    assert events.take() == ()
    events.log_event("info", "a", 3)
    assert [event.text for event in events.take()] == ["a (3 times)"]


def test_pauses_double_up_to_five_seconds_and_begin_anew_after_a_steady_connection():
    backoff, now = Backoff(), 10**18
    assert backoff.due(now)
    pauses = []
    for _ in range(9):
        backoff.failed(now)
        start = now
        while not backoff.due(now):
            now += S // 1000
        pauses.append((now - start) / S)
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]
    backoff.opened(now)
    backoff.failed(now + S // 2)  # broke down at once: not steady
    assert not backoff.due(now + S // 2 + 4 * S)
    now += 10 * S
    backoff.opened(now)
    backoff.failed(now + S)
    assert backoff.due(now + S + S // 10)


def errors(*classes):
    frames = empty_frames(len(classes))
    frames["id_flags"] = np.array(classes) | ERROR_FLAG
    return frames


def test_bus_off_and_back_are_events():
    watch, tally = BusWatch(), Tally(Clock())
    left, ordinary = errors(BUS_OFF), empty_frames(3)  # with ordinary frames it must be back
    for frames in (errors(BUS_OFF, BUS_OFF), errors(RESTARTED), left, ordinary, ordinary):
        watch.look(frames, tally)
    both = ["bus-off: the controller left the bus", "the controller is back on the bus"]
    assert [event.text for event in tally.events.flush()] == both * 2
    assert tally.counts.error_frames == 4


def test_error_classes_are_spelt_out():
    watch, tally = BusWatch(), Tally(Clock())
    frames = errors(0x4 | 0x8, 0)
    frames["data"][0, 1] = 0x01 | 0x08
    watch.look(frames, tally)
    classes = "controller problem, protocol violation"
    details = "receive buffer overflow, transmission warning level"
    expected = [f"error frame: {classes}, {details}", "error frame: no class given"]
    assert [event.text for event in tally.events.take()] == expected
