"""The recorder's loop and sources that fail, end, or report; events, clocks, counts of frames."""

import gc
import signal
from types import SimpleNamespace

import numpy as np
import pytest

from support.simulated_clock import SimulatedClock
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import LogWriteError, SourceError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.recorder.loop import Recorder
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import Polled, SourceContext, SourceCounts, SourceEvent

NS, MS = 1_000_000_000, 1_000_000


class Plain:
    """A source that gives one frame a poll, and does at some polls what the test says.

    Attributes:
        acts: Number of a poll to what is called then, whose result is given if there is one.
        calls: What was called, in order.
    """

    clock, directions = ClockDomain.SIMULATED, False
    connected, finished, robot = True, False, None

    def __init__(self, name, time, acts=None, device_ns=None):
        self.name, self.time, self.acts, self.device_ns = name, time, acts or {}, device_ns
        self.facts, self.counts, self.polls, self.calls = {}, SourceCounts(), 0, []

    def start(self, context):
        self.calls.append("start")
        self.now_ns, self.begun_ns = context.now_ns, context.now_ns()

    def poll(self):
        self.polls += 1
        act = self.acts.get(self.polls)
        if act is not None and (given := act()) is not None:
            return given
        frames = self.frame()
        self.counts.frames += 1
        return Polled(frames=(frames,))

    def frame(self, after_ns=0):
        frames = empty_frames(1)
        frames["t_host_ns"] = self.now_ns() + after_ns
        frames["t_device_ns"] = self.device_ns or frames["t_host_ns"]
        return frames

    def stop(self):
        self.calls.append("stop")


class Ending(Plain):
    """One that can be ended, and is empty then."""

    def end(self):
        self.calls.append("end")
        self.acts = dict.fromkeys(range(1, 1000), Polled)

    @property
    def finished(self):
        return "end" in self.calls


class Stage:
    """A recorder of some sources in simulated time, and the events of its session."""

    def __init__(self, path, time, sources, **options):
        self.path, self.time, self.reported = path, time, []
        options = {"robot": None, "decoded": None} | options
        self.clock = SessionClock(time.clock)
        self.writer = SessionWriter(path, session_id="s", epoch_ns=self.clock.epoch_ns)
        self.recorder = Recorder(
            writer=self.writer,
            clock=self.clock,
            sources=sources,
            context=SourceContext(self.clock.now_ns, self.writer),
            **options,
        )
        self.recorder.on_event(lambda *event: self.reported.append(event))

    def run(self, duration_s=1.0, stop=None):
        ending = self.recorder.run(stop or StopRequest(), duration_s)
        self.writer.close()
        return ending

    def events(self):
        """Level, name and text of all events in the file, but those of begin and end."""
        levels = {20: "info", 30: "warn", 40: "error"}
        with Session(self.path) as session:
            texts = [(levels[m.level], m.name, m.msg) for _, m in session.messages("/rosout")]
        assert texts == [event[1:] for event in self.reported]
        return [event for event in texts if event[1] != "recorder"]


@pytest.fixture
def time():
    return SimulatedClock()


@pytest.fixture
def stage_of(tmp_path, time):
    """Makes a stage of some sources."""
    made = []

    def make(*sources, **options):
        path = tmp_path / f"run{len(made)}.mcap"
        made.append(Stage(path, time, sources, **options))
        return made[-1]

    yield make
    for stage in made:
        stage.writer.close()


def frames_of(path, name):
    with Session(path) as session:
        return session.frames(f"/can/{name}")


def fail(*_):
    raise ZeroDivisionError


# -- beginning and end -----------------------------------------------------------------------------


def test_sources_that_listen_are_started_last_and_all_are_stopped(stage_of, time):
    order = []
    sources = [Ending("a", time), Plain("b", time), Ending("c", time), Plain("d", time)]
    for source in sources:
        source.start = lambda context, source=source: (
            order.append(source.name), type(source).start(source, context),
        )  # fmt: skip
    stage = stage_of(*sources)
    assert stage.run().reason == "1 s are over"
    assert order == ["b", "d", "a", "c"]
    assert [source.calls for source in sources] == [
        ["start", "end", "stop"], ["start", "stop"], ["start", "end", "stop"], ["start", "stop"],
    ]  # fmt: skip
    assert stage.reported[0][1:] == ("info", "recorder", "recording a, b, c, d")
    assert stage.reported[-1][1:] == ("info", "recorder", "ends: 1 s are over")
    assert stage.events() == []


@pytest.mark.parametrize("error", [SourceError("b", "can't work"), ZeroDivisionError("oh")])
def test_a_source_that_fails_to_start_ends_the_others(stage_of, time, error):
    sources = [Plain("a", time), Plain("b", time)]

    def failing(_):
        raise error

    sources[1].start = failing
    with pytest.raises(SourceError) as caught:
        stage_of(*sources).run()
    fault = "can't work"
    if not isinstance(error, SourceError):
        fault = "its kind of source failed to start: ZeroDivisionError('oh')"
    assert str(caught.value) == f"b: {fault}"
    assert [source.calls[-1] for source in sources] == ["stop", "stop"]


def test_the_garbage_collector_is_as_before(stage_of, time):
    seen = []
    source = Plain("a", time, {5: lambda: seen.append((gc.isenabled(), gc.get_freeze_count() > 0))})
    stage_of(source).run()
    assert seen == [(False, True)]
    assert gc.isenabled()


def test_a_signal_and_the_end_of_all_sources_are_reasons(stage_of, time):
    stop = StopRequest()
    source = Plain("a", time, {10: lambda: setattr(stop, "signal", signal.SIGTERM)})
    ending = stage_of(source).run(None, stop)
    assert (ending.reason, ending.failed, ending.requested) == (
        "SIGTERM was received",
        False,
        False,
    )
    source = Plain("a", time, {10: lambda: setattr(source, "finished", True)})
    again = stage_of(source).run(None)
    assert (again.reason, again.failed) == ("all sources have ended", False)


# -- failures --------------------------------------------------------------------------------------


def test_a_source_that_fails_is_given_up_alone(stage_of, time):
    wrong = Polled(frames=(np.zeros(1),))
    sources = [
        Plain("good", time),
        Plain("raises", time, {5: fail}),
        Plain("wrong", time, {7: lambda: wrong}),
    ]
    stage = stage_of(*sources)
    ending = stage.run()
    assert (ending.reason, ending.failed) == ("1 s are over", False)
    assert stage.recorder.given_up == ["raises", "wrong"]
    why = "this source is given up: it failed with"
    assert stage.events() == [
        ("error", "raises", f"{why} ZeroDivisionError()"),
        ("error", "wrong", f"{why} TypeError('poll() gave frames of the type float64')"),
    ]
    assert [len(frames_of(stage.path, s.name)) for s in sources] == [
        sources[0].counts.frames - 1, 4, 6,
    ]  # fmt: skip
    assert [source.polls for source in sources[1:]] == [5, 7]
    assert sources[1].calls == ["start", "stop", "stop"]


def test_when_all_sources_have_failed_the_recording_has(stage_of, time):
    stage = stage_of(Plain("a", time, {5: fail}), Plain("b", time, {3: fail}))
    ending = stage.run(None)
    assert (ending.reason, ending.failed) == ("all sources have ended", True)
    assert stage.reported[-1][1:] == ("error", "recorder", "ends: all sources have ended")


def test_failures_to_end_and_to_stop_are_reported(stage_of, time):
    source, other = Ending("a", time), Plain("b", time)
    source.end = source.stop = fail
    stage = stage_of(source, other)
    assert not stage.run().failed
    texts = [text for *_, text in stage.reported if "can't be" in text]
    assert texts == [
        "this source can't be ended: ZeroDivisionError()",
        "this source can't be released: ZeroDivisionError()",
    ]
    assert other.calls == ["start", "stop"]


def test_a_full_log_ends_the_recording_and_stops_the_sources(stage_of, time, tmp_path):
    def full():
        raise LogWriteError(tmp_path, "full")

    sources = [Plain("a", time, {5: full}), Plain("b", time)]
    with pytest.raises(LogWriteError, match="full"):
        stage_of(*sources).run()
    assert [source.calls for source in sources] == [["start", "stop"]] * 2


# -- what is written -------------------------------------------------------------------------------


def test_events_of_sources_have_their_times(stage_of, time):
    t_ns = 1_700_000_000_123_456_789
    event = SourceEvent(t_ns, "warn", "lost the line")
    source = Plain("a", time, {5: lambda: Polled(events=(event,))})
    stage = stage_of(source)
    stage.recorder.log_event("info", "x", "now")
    stage.run()
    assert stage.events() == [("info", "x", "now"), ("warn", "a", "lost the line")]
    assert (t_ns, "warn", "a", "lost the line") in stage.reported
    assert stage.reported[0][0] == stage.clock.epoch_ns


def test_the_clock_of_a_source_is_written_each_second(stage_of, time):
    source = Plain("a", time)
    quiet = Plain("quiet", time, dict.fromkeys(range(1, 10_000), Polled))
    stage = stage_of(source, quiet)
    stage.run(10.0)
    with Session(stage.path) as session:
        assert session.channels["/clock/a"].count in {11, 12}
        assert "/clock/quiet" not in session.channels


def test_a_device_time_that_fits_no_message_is_reported_once(stage_of, time):
    for device_ns, fits in ((2**31 * NS, False), (2**31 * NS - 1, True)):
        source = Plain("a", time, device_ns=device_ns)
        stage = stage_of(source)
        stage.run(5.0)
        text = f"the device's time, {device_ns} ns, doesn't fit /clock/a"
        assert stage.events() == ([] if fits else [("warn", "a", text)])


def test_frames_from_after_the_end_are_left_out(stage_of, time):
    """One of them proves that all earlier ones have come."""
    source = Plain("a", time)
    stage = stage_of(source)
    late = []
    original = stage.recorder._drain

    def drain(pauses):
        both = np.concatenate([source.frame(), source.frame(5 * MS)])
        late.append(both)
        source.acts = {source.polls + 1: lambda: Polled(frames=(both,))}
        original(pauses)

    stage.recorder._drain = drain
    stage.run()
    kept = frames_of(stage.path, "a")
    assert kept["t_host_ns"][-1] == late[0]["t_host_ns"][0]
    assert late[0]["t_host_ns"][1] not in kept["t_host_ns"]


def test_the_robot_s_frames_are_decoded_every_tenth_tick_or_every_second_when_watched(
    stage_of, time
):
    for watched, every in ((False, 10), (True, 2)):
        source = Plain("a", time)
        stage = stage_of(source, robot=load_robot("snake25"), decoded="a")
        stage.recorder.watched = watched
        backlogs = []
        stage.recorder._each_tick = (lambda b=backlogs, s=stage: b.append(s.recorder.backlog),)
        stage.run()
        empty = [k for k, backlog in enumerate(backlogs) if backlog == 0]
        assert empty == list(range(1, len(backlogs), every))
        assert stage.recorder.backlog == 0


def test_unknown_identifiers_are_reported_once_eight_at_most_with_a_name(stage_of, time):
    def unknown(*ids):
        def give():
            frames = empty_frames(len(ids))
            frames["t_host_ns"] = frames["t_device_ns"] = source.now_ns()
            frames["id_flags"], frames["dlc"] = ids, 8
            return Polled(frames=(frames,))

        return give

    acts = dict.fromkeys(range(1, 1000), Polled)
    acts |= {3: unknown(0x7A0), 5: unknown(0x7A0), 70: unknown(*range(0x7A0, 0x7AB))}
    source = Plain("a", time, acts)
    stage = stage_of(source, robot=load_robot("snake25"), decoded="a")
    stage.run(5.0)
    what = "identifiers that are in no database: "
    lines = [text for level, _, text in stage.events() if text.startswith(what)]
    listed = ", ".join(f"{k:03X}" for k in range(0x7A1, 0x7A9))
    assert lines == [f"{what}7A0", f"{what}{listed} and 2 more"]


@pytest.mark.parametrize("robot", [None, SimpleNamespace(name="r")])
def test_the_end_waits_for_a_late_frame_but_not_for_a_twin_s(stage_of, time, robot):
    source = Plain("a", time)
    source.robot = robot
    stage = stage_of(source)
    stage.run(0.5)
    end_s = (time.now_ns - 5 * NS) / NS
    assert end_s == pytest.approx(0.52 if robot else 0.581, abs=1e-6)
    asked = stage.recorder.priority.text == "not asked for"
    assert asked is (robot is not None)
