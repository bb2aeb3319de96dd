"""The recorder's loop on a clock that the test moves: late ticks, stops and bursts are inputs.

The source is a plug-in; the session is a real file, read back by mcap's reader.
"""

from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.simulated_clock import SimulatedClock
from undulog.capture import Session, SessionWriter
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.recorder.loop import Recorder
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import Polled, SourceContext, SourceCounts

NS, MS = 1_000_000_000, 1_000_000
TICK_NS = 20 * MS


class Line:
    """A source whose frames are the test's: ``frames(k)`` at its poll k, stamped with that time.

    Attributes:
        polled_ns: The times at which it was asked, from the recording's start.
    """

    name, clock, robot, directions = "line", ClockDomain.SIMULATED, None, False
    connected, finished = True, False

    def __init__(self, time, frames=lambda _: 0):
        self.time, self.frames = time, frames
        self.facts, self.counts, self.polled_ns = {}, SourceCounts(), []

    def start(self, context):
        self.now_ns, self.begun_ns = context.now_ns, self.time.now_ns

    def poll(self):
        count = self.frames(len(self.polled_ns))
        self.polled_ns.append(self.time.now_ns - self.begun_ns)
        self.counts.frames += count
        array = empty_frames(count)
        array["t_host_ns"] = array["t_device_ns"] = self.now_ns()
        return Polled(frames=(array,) if count else ())

    def stop(self):
        pass


class Leaving(Line):
    """One that can end at an instant."""

    left = 0

    def end(self):
        self.frames, self.ended_at = lambda _: 0, len(self.polled_ns)

    @property
    def finished(self):
        return hasattr(self, "ended_at") and len(self.polled_ns) > self.ended_at + self.left


@contextmanager
def recorder_of(path, time, line, **tasks):
    clock = SessionClock(time.clock)
    with SessionWriter(path, session_id="s", epoch_ns=clock.epoch_ns) as writer:
        context = SourceContext(clock.now_ns, writer)
        yield Recorder(
            writer=writer,
            clock=clock,
            sources=[line],
            context=context,
            robot=None,
            decoded=None,
            **tasks,
        )


def recorded(path):
    """The number of frames in a session."""
    with Session(path) as session:
        return len(session.frames("/can/line"))


def late_at(time, delays_s):
    """A task of each tick that takes long in some of them."""
    count = iter(range(1 << 40))
    return lambda: time.pass_s(delays_s.get(next(count), 0.0))


def test_sources_are_asked_each_20_ms(tmp_path):
    time = SimulatedClock()
    line = Leaving(time, lambda _: 3)
    with recorder_of(tmp_path / "run.mcap", time, line) as recorder:
        ending = recorder.run(StopRequest(), 1.0)
    assert (ending.reason, ending.failed) == ("1 s are over", False)
    assert line.polled_ns[:51] == [k * TICK_NS for k in range(51)]
    assert recorder.overruns == 0
    assert recorded(tmp_path / "run.mcap") == line.counts.frames


def test_a_late_tick_is_followed_at_once_until_the_ticks_are_on_time_again(tmp_path):
    time = SimulatedClock()
    line = Leaving(time)
    late = late_at(time, {10: 0.07})
    with recorder_of(tmp_path / "run.mcap", time, line, each_tick=[late]) as recorder:
        recorder.run(StopRequest(), 1.0)
    ticks_ms = [at_ns / MS for at_ns in line.polled_ns]
    assert ticks_ms[9:16] == [180, 200, 270, 270, 270, 280, 300]
    assert (recorder.overruns, recorder.pauses) == (0, ())
    assert recorder.ticks.result().max_s == pytest.approx(0.07)


def test_ticks_of_a_long_stop_are_left_out_and_counted(tmp_path):
    time = SimulatedClock()
    line = Leaving(time)
    late = late_at(time, {10: 3.0})
    with recorder_of(tmp_path / "run.mcap", time, line, each_tick=[late]) as recorder:
        recorder.run(StopRequest(), 5.0)
    assert len(line.polled_ns) + recorder.overruns == pytest.approx(5.0 / 0.02, abs=6)
    assert recorder.overruns == (3000 - 20) // 20
    (pause,) = recorder.pauses
    assert pause.ended_ns - pause.began_ns == 3 * NS
    with Session(tmp_path / "run.mcap") as session:
        texts = [event.msg for _, event in session.messages("/rosout")]
    assert sum("did not run for 3.00 s" in text for text in texts) == 1


@settings(max_examples=4, deadline=None, suppress_health_check=list(HealthCheck))
@given(late_s=st.lists(st.floats(0.0, 3.0), max_size=30), seed=st.integers(0, 2**32))
def test_whatever_is_late_each_frame_is_kept_once_and_no_tick_is_early(
    tmp_path_factory, late_s, seed
):
    time = SimulatedClock()
    time.late_s = list(late_s)
    rng = np.random.default_rng(seed)
    line = Leaving(time, lambda _: int(rng.integers(0, 1000)))
    path = tmp_path_factory.mktemp("late") / "run.mcap"
    with recorder_of(path, time, line) as recorder:
        recorder.run(StopRequest(), 1.0)
    assert recorded(path) == line.counts.frames
    for k, at_ns in enumerate(line.polled_ns):
        assert k * TICK_NS <= at_ns  # none is before its time


def test_in_a_burst_the_next_tick_follows_after_a_millisecond(tmp_path):
    time = SimulatedClock()
    line = Leaving(time, lambda k: 1000 if 5 <= k < 9 else 999)
    with recorder_of(tmp_path / "run.mcap", time, line) as recorder:
        recorder.run(StopRequest(), 0.3)
    ticks_ms = [at_ns / MS for at_ns in line.polled_ns]
    assert ticks_ms[4:12] == [80, 100, 101, 102, 103, 104, 124, 144]
    assert recorded(tmp_path / "run.mcap") == line.counts.frames


def test_what_is_due_once_a_second_is_done_so_beside_late_ticks(tmp_path):
    time = SimulatedClock()
    done = []
    late = late_at(time, dict.fromkeys(range(0, 3000, 40), 0.3))
    line = Leaving(time)
    with recorder_of(
        tmp_path / "run.mcap",
        time,
        line,
        each_tick=[late],
        each_second=[lambda: done.append(time.now_ns)],
    ) as recorder:
        recorder.run(StopRequest(), 60.0)
    assert len(done) in {59, 60}
    assert max(np.diff(done)) <= 1.35 * NS


@pytest.mark.parametrize("paused_s", [0.0, 10.0])
def test_the_end_waits_half_a_second_of_running_time_for_what_is_on_its_way(tmp_path, paused_s):
    time = SimulatedClock()
    line = Line(time)
    with recorder_of(tmp_path / "run.mcap", time, line) as recorder:
        original = recorder._drain

        def drain(pauses):
            line.began = len(line.polled_ns)
            time.late_s = [0.0] * 100 + [paused_s]
            original(pauses)

        recorder._drain = drain
        recorder.run(StopRequest(), 0.5)
    steps_ns = np.diff(line.polled_ns[line.began :])
    assert np.minimum(steps_ns, TICK_NS).sum() == pytest.approx(0.5 * NS, abs=2 * MS)
    assert steps_ns.max() == pytest.approx(paused_s * NS + MS, abs=1)


def test_the_end_waits_for_a_source_that_takes_no_more_until_it_has_given_all(tmp_path):
    time = SimulatedClock()
    line = Leaving(time, lambda _: 10)
    line.left = 30
    with recorder_of(tmp_path / "run.mcap", time, line) as recorder:
        recorder.run(StopRequest(), 0.5)
    assert len(line.polled_ns) == line.ended_at + 31
    assert line.polled_ns[-1] - line.polled_ns[-2] == MS


@pytest.mark.parametrize(("burst", "most_s", "refused"), [(4, 0.3, 0), (1 << 40, 5.1, 1000)])
def test_what_a_connection_still_brings_is_received_for_5_s_at_most(
    tmp_path, burst, most_s, refused
):
    time = SimulatedClock()
    line = Line(time, lambda k: 1000 if k < burst else 0)
    with recorder_of(tmp_path / "run.mcap", time, line) as recorder:
        recorder.run(StopRequest(), 0.0)
    assert line.polled_ns[-1] <= (most_s + 0.5) * NS
    # A frame from after the end proves that all earlier ones have come.
    assert recorded(tmp_path / "run.mcap") == line.counts.frames - refused
