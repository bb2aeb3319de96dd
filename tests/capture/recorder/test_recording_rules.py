"""A recording in simulated time: what it writes each second and at its end, and its errors then."""

import contextlib
import json
import socket
from itertools import pairwise

import pytest

from support.read_back import decoded_of, metadata_of
from support.simulated_clock import SimulatedClock
from undulog.capture import load_robot
from undulog.capture.common.errors import LogWriteError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.recorder import recording
from undulog.capture.recorder.recording import RunningRecording
from undulog.capture.recorder.settings import resolve
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import Polled, SourceCounts

NS = 1_000_000_000


class Source:
    """A source that gives a frame a poll, and calls ``acts`` at some of its polls."""

    clock, directions, robot, facts = ClockDomain.SIMULATED, False, None, {}
    connected, finished = True, False

    def __init__(self, name="can0", acts=None, robot=None):
        self.name, self.acts, self.robot = name, acts or {}, robot
        self.counts, self.polls = SourceCounts(), 0

    def start(self, context):
        self.context = context

    def poll(self):
        self.polls += 1
        self.acts.get(self.polls, int)()
        self.counts.frames += 1
        frames = empty_frames(1)
        frames["t_host_ns"] = frames["t_device_ns"] = self.context.now_ns()
        return Polled(frames=(frames,))

    def stop(self):
        pass


class Stage:
    """Recordings in one folder and time, and the snapshots that they show."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.time, self.shown = folder, SimulatedClock(), []
        nothing = contextlib.nullcontext  # a collection takes most of the time
        monkeypatch.setattr("undulog.capture.recorder.loop._manual_collection", nothing)
        monkeypatch.setattr(recording, "SessionClock", lambda: SessionClock(self.time.clock))
        monkeypatch.setattr(recording, "FreeSpace", lambda _: Free())
        monkeypatch.setattr(recording, "open_sources", lambda _: self.sources)

    def recording(self, *sources, **given):
        self.sources, name = sources, given.pop("name", "run")
        words = {"sources": tuple(f"{s.name}=unix:/x/{s.name}" for s in sources)}
        words |= {"output": self.folder / f"{name}.mcap", "floor": 0}
        words |= {"socket": self.folder / f"{name}.sock"}
        return RunningRecording(resolve(words | given, {}), StopRequest())


class Free:
    """Free space without end."""

    def __call__(self):
        return 10**12

    def close(self):
        pass


@pytest.fixture
def stage(tmp_path, monkeypatch):
    return Stage(tmp_path, monkeypatch)


# -- each second -----------------------------------------------------------------------------------


def test_the_state_is_on_diagnostics_each_second_and_at_the_end(stage):
    source = Source()
    stage.recording(source, duration=3.0).run()
    messages = [message for *_, message in decoded_of(stage.folder / "run.mcap", ["/diagnostics"])]
    elapsed = []
    for message in messages:
        names = [status.name for status in message.status]
        assert names[:3] == ["recorder", "session", "source can0"]
        elapsed.append(float(message.status[0].values[0].value))
    assert [int(seconds) for seconds in elapsed] == [0, 1, 2, 3]
    last = {value.key: value.value for value in messages[-1].status[2].values}
    assert int(last["frames"]) == source.counts.frames


def test_the_last_eight_events_are_shown(stage):
    made = stage.recording(Source(), duration=2.0)
    for number in range(12):
        made.warn("x", f"{number}")
    made.run(stage.shown.append)
    events = [(event.level, event.name, event.text) for event in stage.shown[-1].events]
    assert events == [*(("warn", "x", f"{k}") for k in range(5, 12)),
                      ("info", "recorder", "recording can0")]  # fmt: skip


def test_who_watches_is_known_within_a_second(stage):
    made = stage.recording(Source(), duration=2.0)
    watched = []
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as relay:
        relay.bind(str(made.live_socket))
        made.run(lambda _: watched.append(made._recorder.watched))
        assert len(relay.recv(1 << 16)) > 100
    assert watched == [True] * 2
    assert made.live_socket.suffix == ".live"


def test_parts_begin_each_so_many_seconds(stage):
    report = stage.recording(Source(), duration=1.5, split_time="1.2s").run()
    assert [path.name for path in report.files] == ["run.mcap", "run_0002.mcap"]
    begun = [min(t_ns for _, t_ns, _ in decoded_of(path)) for path in report.files]
    steps_s = [(b - a) / NS for a, b in pairwise(begun)]
    assert steps_s == pytest.approx([1.2], abs=0.021)
    sink = stage.recording(Source(), name="b", split_size="3MB", duration=0.1)
    assert (sink._storage._split_size, sink._storage._split_ns) == (3_000_000, None)
    sink.run()


# -- the end ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("failed", "reason", "error", "text"),
    [
        (False, "1 s are over", "no room", "{}: no room"),
        (True, "an error", "no room", "an error; {}: no room"),
        (True, "no room", "no room", "{}: no room"),
    ],
)
def test_an_error_at_the_end_is_the_reason_beside_that_of_a_failed_end(
    stage, failed, reason, error, text
):
    made = stage.recording(Source())
    path, close = stage.folder / "run.mcap", made._writer.close

    def closing():
        close()
        raise LogWriteError(path, error)

    made._writer.close = closing

    def end():
        made._recorder.ending = recording.Ending(reason, failed=failed, requested=True)

    made._sources[0].acts = {5: end}
    ending = made.run().ending
    assert (ending.reason, ending.failed, ending.requested) == (text.format(path), True, True)


def test_a_good_end_has_the_verdict_of_the_health_and_the_times_of_the_ticks(stage):
    made = stage.recording(Source(), duration=1.0)
    tally = made._recorder.ticks
    for _ in range(1000):
        tally.add(7_000_000)
    tally.add(123_456_789)
    report = made.run()
    times = tally.result()
    assert times.max_s == pytest.approx(0.123456789)
    expected = {"ticks": "1052", "tick_max_s": "0.123", "ticks_left_out": "0"}
    assert report.recorder.items() >= (expected | {"ended": "1 s are over"}).items()
    for key, time_s in (("tick_p50_s", times.p50_s), ("tick_p99_s", times.p99_s)):
        assert report.recorder[key] == f"{time_s:.3g}"
    health = metadata_of(stage.folder / "run.mcap")["undulog.health"]
    assert (health["verdict"], json.loads(health["reasons"])) == (
        report.verdict, list(report.reasons),
    )  # fmt: skip
    text = report.as_json()
    assert (text["failed"], text["rescued"], text["files"]) == (False, [], [str(report.files[0])])
    assert (text["ended"], text["size_bytes"]) == ("1 s are over", report.size)


def test_a_full_disk_has_no_last_state(stage):
    """And a full one alone: an end that failed for another reason has it."""
    for number, short in enumerate((False, True)):
        made = stage.recording(Source(), name=f"{number}")

        def end(made=made, short=short):
            made._recorder.ending = recording.Ending("an error", failed=True)
            if short:
                made._storage._disk._shortage = LogWriteError(stage.folder, "full")

        made._sources[0].acts = {45: end}
        made._storage._last_words = 1 << 20
        with contextlib.suppress(LogWriteError):
            made.run()
        messages = decoded_of(stage.folder / f"{number}.mcap", ["/diagnostics"])
        assert len(list(messages)) == (1 if short else 2)


@pytest.mark.parametrize("duration", [None, 0.1])
def test_beside_a_bus_a_twin_ends_with_the_recording(stage, duration):
    twin, bus = Source("twin", robot=load_robot("snake25")), Source()
    made = stage.recording(twin, bus, duration=duration)
    bus.acts = {} if duration else {8: made.stop}
    ending = made.run().ending
    assert ending.reason == ("it was stopped" if duration is None else "0.1 s are over")
    facts = {"fast": "false"} if duration is None else {"fast": "false", "duration_s": "0.1"}
    assert twin.context.facts == facts


def test_a_clock_is_noted_of_each_source_that_has_one(stage):
    class Silent(Source):
        def poll(self):
            return Polled()

    stage.recording(Silent("a"), Source("b"), Silent("c"), Source("d"), duration=0.1).run()
    noted = metadata_of(stage.folder / "run.mcap")["undulog.clock"]
    assert {key.partition(".")[0] for key in noted} == {"b", "d"}
    assert noted["b.samples"] == noted["d.samples"]
