"""The recorder's loop to the nanosecond: when it decodes, when it ends, and what it waits for."""

from collections import Counter
from contextlib import nullcontext

import numpy as np
import pytest

from support.simulated_clock import SimulatedClock
from undulog.capture import SessionWriter
from undulog.capture.bus.decoding import FrameTally
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.recorder import loop
from undulog.capture.recorder.loop import Recorder
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import Polled, SourceContext, SourceCounts

NS, MS = 1_000_000_000, 1_000_000
TICK_NS = 20 * MS
NO_TALLY = FrameTally()


class Line:
    """A source whose frames come by the number of the poll.

    Attributes:
        polled_ns: The times at which it was asked, from the recording's start.
    """

    clock, robot, directions = ClockDomain.SIMULATED, None, False
    connected, finished = True, False

    def __init__(self, time, name="a", frames=lambda _: 0):
        self.time, self.name, self.frames = time, name, frames
        self.facts, self.counts, self.polled_ns, self.at_ns = {}, SourceCounts(), [], None
        self.behind_ns = lambda _: 0

    def start(self, context):
        self.now_ns, self.begun_ns = context.now_ns, self.time.now_ns

    def poll(self):
        count = self.frames(len(self.polled_ns))
        self.polled_ns.append(self.time.now_ns - self.begun_ns)
        self.counts.frames += count
        array = empty_frames(count)
        array["t_host_ns"] = array["t_device_ns"] = self.at_ns or self.now_ns()
        array["t_device_ns"] -= np.uint64(self.behind_ns(len(self.polled_ns)))
        return Polled(frames=(array,) if count else ())

    def stop(self):
        pass


class Ending(Line):
    """One that can be ended, and gives all that it has within ``left_ns``."""

    left_ns, ended_ns = 0, None

    def end(self):
        self.ended_ns = self.time.now_ns

    @property
    def finished(self):
        return self.ended_ns is not None and self.time.now_ns >= self.ended_ns + self.left_ns


class Bus:
    """A bus that notes its decoding: time left, and whether all is asked for; tick by tick."""

    def __init__(self, stage, tally=NO_TALLY):
        self.stage, self.tally, self.decodes = stage, tally, True
        self.backlog, self.behind, self.decoded, self.frames = 0, False, [], 0
        self.faults = []

    def add(self, frames):
        self.frames += len(frames)

    def write_raw(self, now_ns):
        pass

    def decode(self, now_ns, until_ns, *, rest):
        self.decoded.append((len(self.stage.done), until_ns - now_ns(), rest))

    def finish(self, now_ns):
        self.decoded.append("finish")

    def take_faults(self):
        faults, self.faults = self.faults, []
        return faults


class Stage:
    """A recorder in simulated time; ``done`` has the time of each tick's end."""

    def __init__(self, path, *sources, late=None):
        self.time = sources[0].time
        clock, self.done, self.events, self.late = SessionClock(self.time.clock), [], [], late or {}
        self.writer = SessionWriter(path, session_id="s", epoch_ns=clock.epoch_ns)
        self.recorder = Recorder(
            writer=self.writer, clock=clock, sources=sources, robot=None, decoded=None,
            context=SourceContext(clock.now_ns, self.writer), each_tick=(self._tick,),
        )  # fmt: skip
        self.recorder.on_event(lambda *event: self.events.append(event[1:]))

    each_tick = int

    def _tick(self):
        self.time.now_ns += self.late.get(len(self.done), 0)
        self.done.append(self.time.now_ns)
        self.each_tick()

    def bus(self, name="a", **options):
        bus = self.recorder.buses[name] = Bus(self, **options)
        return bus

    def run(self, duration_s=1.0):
        return self.recorder.run(StopRequest(), duration_s)


@pytest.fixture
def time():
    return SimulatedClock()


@pytest.fixture
def stage_of(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "_manual_collection", nullcontext)  # which takes most of the time
    made = []

    def make(*sources, **options):
        made.append(Stage(tmp_path / f"{len(made)}.mcap", *sources, **options))
        return made[-1]

    yield make
    for stage in made:
        stage.writer.close()


# -- decoding --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("watched", "every"), [(False, 10), (True, 2)])
def test_a_bus_decodes_for_4_ms_in_its_turn_or_when_it_is_behind(stage_of, time, watched, every):
    stage = stage_of(Ending(time), Ending(time, "b"))
    stage.recorder.watched = watched
    first, second = stage.bus(), stage.bus("b")
    stage.each_tick = lambda: setattr(second, "behind", len(stage.done) in {4, 24, 25})
    stage.run(0.6)
    ticks = [k for k in range(31) if k % every == 1 or k in {4, 24, 25}]
    expected = [(k, 4 * MS, k % every == 1) for k in ticks]
    assert first.decoded == second.decoded == [*expected, "finish"]


@pytest.mark.parametrize(
    ("frames", "backlog", "waits"),
    [(999, 0, False), (1000, 0, True), (1000, 1_999_999, True), (1000, 2_000_000, False)],
)
def test_in_a_burst_decoding_waits_until_too_much_does(stage_of, time, frames, backlog, waits):
    source = Ending(time, frames=lambda k: frames if k < 30 else 0)
    stage = stage_of(source)
    bus = stage.bus()
    bus.backlog, bus.behind = backlog, True
    stage.run(1.0)
    assert bus.decoded[0][0] == (30 if waits else 0)


# -- ticks -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("late_ns", "left_out"), [(1020 * MS, 0), (1020 * MS + 1, 50)])
def test_ticks_of_more_than_a_second_are_left_out(stage_of, time, late_ns, left_out):
    source = Ending(time)
    stage = stage_of(source, late={5: late_ns})
    stage.run(2.0)
    assert stage.recorder.overruns == left_out
    at_ns = source.polled_ns[6]
    assert at_ns == 100 * MS + late_ns
    if left_out:  # the ticks go on from then
        assert [t_ns - at_ns for t_ns in source.polled_ns[7:9]] == [TICK_NS, 2 * TICK_NS]
    else:
        assert source.polled_ns[6:60] == [at_ns] * 51 + [1140 * MS, 1160 * MS, 1180 * MS]


@pytest.mark.parametrize(("frames", "pause_ns"), [(1000, MS), (999, TICK_NS)])
def test_after_a_burst_the_next_tick_follows_a_millisecond_after_its_end(
    stage_of, time, frames, pause_ns
):
    source = Ending(time, frames=lambda k: frames if k == 3 else 0)
    stage = stage_of(source, late={3: 7 * MS})
    stage.run(0.2)
    after_ns = 60 * MS + (7 * MS + MS if frames == 1000 else TICK_NS)
    assert source.polled_ns[4] == after_ns
    assert source.polled_ns[5] == after_ns + TICK_NS


@pytest.mark.parametrize(("duration_s", "ticks"), [(0.1, 6), (0.1 + 1e-9, 7), (0.0, 1)])
def test_the_last_tick_is_the_first_at_or_after_the_duration(stage_of, time, duration_s, ticks):
    stage = stage_of(Ending(time))
    assert stage.run(duration_s).reason == f"{duration_s:g} s are over"
    assert len(stage.done) == ticks


# -- what is received at the end -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "bursts", "polls"),
    [(1000, (), 3), (1000, (0,), 4), (1000, (1, 3, 5), 9), (1000, (0, 2), 6), (999, (0, 2), 3)],
)
def test_a_connection_is_emptied_until_three_ticks_bring_no_burst(
    stage_of, time, frames, bursts, polls
):
    """The poll that ended the recording is the first; a later one that drains follows."""
    source = Line(time, frames=lambda k: frames if k - 1 in bursts else 0)
    stage = stage_of(source)
    source.robot = None
    source.connected = False  # nothing to wait for after that
    stage.run(0.0)
    steps = [b - a for a, b in zip(source.polled_ns, source.polled_ns[1:], strict=False)]
    assert steps[1:] == [TICK_NS] * (polls - 1) + [0]


@pytest.mark.parametrize(("pause_s", "polls"), [(0.0, 250), (7.0, 249)])
def test_a_connection_without_end_is_received_for_5_s_of_running_time(
    stage_of, time, pause_s, polls
):
    """A pause counts as two ticks at most."""
    source = Line(time, frames=lambda _: 1000)
    source.connected = False
    stage = stage_of(source)
    time.late_s = [0.0] * 20 + [pause_s]
    stage.run(0.0)
    assert len(source.polled_ns) == 1 + polls + 1


@pytest.mark.parametrize("kinds", [(Ending, Ending), (Ending, Line), (Line, Ending)])
def test_only_connections_are_emptied(stage_of, time, kinds):
    sources = [kind(time, name) for kind, name in zip(kinds, "ab", strict=True)]
    stage = stage_of(*sources)
    stage.run(0.0)
    (ended_ns, *_) = [source.ended_ns for source in sources if isinstance(source, Ending)]
    waited_ns = 0 if kinds == (Ending, Ending) else 3 * TICK_NS
    assert ended_ns - stage.done[0] == TICK_NS + waited_ns


def test_an_ended_source_is_waited_for_until_half_a_second_without_a_frame(stage_of, time):
    """Each frame begins the half second anew."""
    source = Ending(time)
    source.left_ns = 60 * NS
    stage = stage_of(source)
    source.frames = lambda _: int(
        source.ended_ns is not None and time.now_ns - source.ended_ns in (200 * MS, 699 * MS)
    )
    stage.run(0.1)
    after_ns = source.begun_ns + source.polled_ns[-1] - source.ended_ns
    assert after_ns == pytest.approx((699 + 500) * MS, abs=MS)
    assert source.counts.frames == 2


@pytest.mark.parametrize("missing_ns", [0, 1])
def test_a_frame_of_the_instant_of_the_end_is_kept_and_a_later_one_proves_that_all_came(
    stage_of, time, missing_ns
):
    source = Line(time)
    stage = stage_of(source)
    bus, drain = stage.bus(), stage.recorder._drain

    def draining(pauses):
        source.at_ns = source.now_ns() + 1 - missing_ns
        source.frames, source.begun = (lambda _: 3), len(source.polled_ns)
        drain(pauses)

    stage.recorder._drain = draining
    stage.run(0.1)
    polls = len(source.polled_ns) - source.begun
    if missing_ns:
        assert bus.frames == 3 * polls > 100
    else:
        assert (bus.frames, polls) == (0, 1)


# -- what is told ----------------------------------------------------------------------------------


def test_the_clocks_of_all_sources_that_have_one_are_written(stage_of, time):
    names = ("quiet", "a", "silent", "b")
    sources = [Ending(time, name, lambda _, n=name: int(n in "ab")) for name in names]
    stage = stage_of(*sources)
    stage.run(1.0)
    assert set(stage.recorder._clock_channels) == {"a", "b"}


def test_jumps_of_a_device_s_clock_are_told_while_recording_and_at_the_end(stage_of, time):
    source = Ending(time, frames=lambda _: 1)
    source.behind_ns = lambda polls: (9000 - 1000 * (polls > 5) - 1000 * (polls > 15)) * NS
    stage = stage_of(source)
    counts = []
    stage.each_tick = lambda: counts.append(len(stage.events))
    stage.run(0.3)
    text = "the device's clock jumped ahead by 1000.000 s and is measured anew"
    assert [event for event in stage.events if event[1] == "a"] == [("warn", "a", text)] * 2
    assert counts == [1] * 11 + [2] * 5


@pytest.mark.parametrize(("count", "more"), [(1, ""), (8, ""), (9, " and 1 more"),
                                             (30, " and 22 more")])  # fmt: skip
def test_unknown_and_short_frames_are_listed_eight_at_a_time_beside_raw_buses(
    stage_of, time, count, more
):
    sources = [Ending(time, name) for name in ("raw", "a")]
    stage = stage_of(*sources)
    raw = stage.bus("raw")
    raw.decodes, raw.faults = False, ["oh"]
    names = [f"{k:03X}" for k in range(count)]
    bus = stage.bus("a", tally=FrameTally(unknown=Counter(names), short=Counter(["x.y"])))
    bus.faults = ["ah", "eh"]
    stage.recorder._log_unknown_frames()
    listed = ", ".join(names[:8])
    assert stage.events == [
        ("error", "raw", "oh"), ("error", "a", "ah"), ("error", "a", "eh"),
        ("info", "a", f"identifiers that are in no database: {listed}{more}"),
        ("warn", "a", "frames too short for: x.y"),
    ]  # fmt: skip
    bus.tally.unknown["7FF"] += 1
    for _ in range(2):  # each once
        stage.recorder._log_unknown_frames()
    assert stage.events[5:] == [("info", "a", "identifiers that are in no database: 7FF")]


def test_at_the_end_the_counts_of_frames_are_told_by_their_weight(stage_of, time):
    stage = stage_of(Ending(time))
    stage.bus(tally=FrameTally(errors=3, remote=2))
    stage.run(0.1)
    assert stage.events[-3:] == [
        ("warn", "a", "3 error frames"),
        ("info", "a", "2 remote frames, which carry no data"),
        ("info", "recorder", "ends: 0.1 s are over"),
    ]
