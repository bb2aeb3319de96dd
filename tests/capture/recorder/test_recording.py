"""A whole recording in simulated time: its status, its ends, and what its report says."""

import os
import platform
import shutil
from types import SimpleNamespace

import pytest

from support.processes import wait_for
from support.read_back import metadata_of
from support.simulated_clock import SimulatedClock
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import LogWriteError, SourceError, UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.recorder import recording
from undulog.capture.recorder.recording import RunningRecording
from undulog.capture.recorder.settings import resolve
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.model import ClockDomain
from undulog.capture.sources.contract import Polled, SourceCounts

NS = 1_000_000_000
FREE = 10_000_000_000


class Source:
    """A source that gives a frame a poll, and calls ``acts`` at some of its polls."""

    clock, directions, robot = ClockDomain.SIMULATED, False, None
    connected, finished = True, False

    def __init__(self, name="can0", acts=None, facts=None):
        self.name, self.acts, self.facts = name, acts or {}, facts or {}
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
    """What recordings of one test share: a clock, the free space, and what a service hears."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.time, self.free, self.notes = folder, SimulatedClock(), FREE, []
        self.output = folder / "run.mcap"
        monkeypatch.setattr(recording, "SessionClock", lambda: SessionClock(self.time.clock))
        monkeypatch.setattr(recording, "FreeSpace", self._free_space)
        monkeypatch.setattr(recording, "open_sources", lambda _: self.sources)
        self.made = []

    def _free_space(self, _):
        def free():
            return self.free

        free.close = lambda: self.notes.append("free space closed")
        return free

    def recording(self, *sources, **given):
        """Make a recording of some sources."""
        self.sources = sources
        words = {"sources": tuple(f"{s.name}=unix:/x/{s.name}" for s in sources)}
        words |= {"output": self.output, "floor": 0, "socket": self.folder / "c.sock"}
        notifier = SimpleNamespace(
            ready=lambda text: self.notes.append(f"ready: {text}"),
            stopping=lambda: self.notes.append("stopping"),
            status=self.notes.append,
            alive=lambda: None,
        )
        settings = resolve(words | given, {})
        self.made.append(RunningRecording(settings, StopRequest(), notifier=notifier))
        return self.made[-1]


@pytest.fixture
def stage(tmp_path, monkeypatch):
    return Stage(tmp_path, monkeypatch)


def events(path):
    with Session(path) as session:
        return [(message.name, message.msg) for _, message in session.messages("/rosout")]


# -- the status ------------------------------------------------------------------------------------


def test_the_status_has_the_state_of_each_second(stage):
    seen = []
    source = Source(acts={130: lambda: seen.append(made.status())})
    made = stage.recording(source, duration=4.0)
    shown = []
    assert made.status()["elapsed_s"] == 0.0
    report = made.run(shown.append)
    (status,) = seen
    assert (status["output"], status["state"]) == (str(stage.output), "recording")
    assert [snapshot.elapsed_s for snapshot in shown] == [0.5, 1.5, 2.5, 3.5]
    assert status["elapsed_s"] == 2.5
    assert (status["free"], status["part"], status["robot"]) == (FREE, 1, None)
    assert (status["trouble"], status["backlog"]) == (None, shown[2].backlog)
    assert status["bytes"] == shown[2].size
    (can0,) = status["sources"]
    assert (can0["name"], can0["address"]) == ("can0", "can0=unix:/x/can0")
    assert shown[-1].events[-1].text == "recording can0"
    assert shown[-1].messages > shown[0].messages > 20
    assert (report.duration_s, report.messages) == (
        pytest.approx(4.06, abs=0.05), report.messages,
    )  # fmt: skip
    assert stage.notes[0] == f"ready: recording {stage.output}"
    assert stage.notes[-2:] == ["stopping", "free space closed"]
    assert len(stage.notes) == 4 + 3
    assert stage.notes[1].startswith("0:00:00 ")


def test_the_rate_of_bytes_is_that_of_the_last_ten_seconds(stage):
    shown, sizes = [], iter([0, *[1000 * k * k for k in range(1, 100)]])
    made = stage.recording(Source(), duration=20.0)
    storage = made._storage
    made._storage = SimpleNamespace(
        **{name: getattr(storage, name) for name in
           ("tick", "part_path", "part", "unsynced", "must_end", "shortage", "files", "rescued")},
        messages=7,
        size=0,
    )  # fmt: skip
    look = made._look

    def looked():
        made._storage.size = next(sizes)
        shown.append(snapshot := look())
        return snapshot

    made._recorder._each_second._tasks = tuple(
        looked if task == look else task for task in made._recorder._each_second._tasks
    )
    made.run()
    rates = [snapshot.byte_rate for snapshot in shown[:20]]
    assert rates[0] is None
    for k, rate in enumerate(rates[1:], 1):
        first = max(0, k - 9)
        assert rate == pytest.approx(1000 * (k * k - first * first) / (k - first), rel=1e-3)


# -- the ends --------------------------------------------------------------------------------------


def test_what_was_recorded_is_reported(stage):
    source = Source(facts={"bitrate": "500000"})
    given = {"operator": "Ada", "notes": "wet sand", "metadata": {"site": "lab"}}
    made = stage.recording(source, duration=2.0, **given)
    made.warn("x", "beware")
    report = made.run()
    assert (report.files, report.robot, report.rescued) == ((stage.output,), None, ())
    assert (report.ending.reason, report.ending.failed) == ("2 s are over", False)
    assert report.size == stage.output.stat().st_size
    assert report.sources["can0"]["frames"] == source.counts.frames
    records = metadata_of(stage.output)
    assert records["undulog"]["session_id"] == report.session_id
    assert records["undulog"]["source.can0"] == "can0=unix:/x/can0"
    assert records["undulog"]["source.can0.bitrate"] == "500000"
    assert records["undulog"]["python"] == platform.python_version()
    system = platform.uname()
    assert records["undulog"]["kernel"] == f"{system.system} {system.release} {system.machine}"
    assert records["undulog"]["host"] == system.node
    assert [records["undulog"][key] for key in ("operator", "notes", "site")] == [
        "Ada", "wet sand", "lab",
    ]  # fmt: skip
    assert records["undulog.recorder"] == {key: str(text) for key, text in report.recorder.items()}
    assert records["undulog.recorder"]["ended"] == "2 s are over"
    assert records["undulog.recorder"]["pauses"] == "0"
    assert records["undulog.recorder"]["paused_s"] == "0.000"
    assert int(records["undulog.recorder"]["ticks"]) == 101
    assert records["undulog.clock"]["can0.samples"]
    assert ("x", "beware") in events(stage.output)


def test_pauses_are_counted_and_their_times_added(stage):
    source = Source()
    made = stage.recording(source, duration=10.0)
    source.acts = {50: lambda: stage.time.pass_s(2.0), 150: lambda: stage.time.pass_s(1.5)}
    facts = made.run().recorder
    assert facts["pauses"] == "2"
    assert float(facts["paused_s"]) == pytest.approx(2.0 + 1.5, abs=2 * 0.02)


def test_a_stop_is_a_good_end(stage):
    source = Source()
    made = stage.recording(source)
    source.acts = {30: made.stop}
    report = made.run()
    ending = report.ending
    assert (ending.reason, ending.failed, ending.requested) == ("it was stopped", False, True)


def test_too_little_space_ends_the_recording(stage):
    def shrink():
        stage.free = 99_999_999

    made = stage.recording(Source(acts={120: shrink}), floor="100MB")
    ending = made.run().ending
    assert ending.failed
    assert ending.reason == (
        "only 100 MB are left on the disk, less than the floor of 100 MB; nothing later is recorded"
    )
    stage.free, stage.output = 100_000_000, stage.folder / "b.mcap"
    report = stage.recording(Source(), floor="100MB", duration=3.0).run()
    assert not report.ending.failed
    stage.free, stage.output = 99_999_999, stage.folder / "c.mcap"
    with pytest.raises(LogWriteError, match="only 100 MB are free there, less than the floor of 1"):
        stage.recording(Source(), floor="100MB")
    assert not list(stage.folder.glob("c.mcap*"))


def test_a_source_that_can_never_work_leaves_no_file(stage):
    source = Source()

    def start(context):
        raise SourceError("can0", "never")

    source.start = start
    with pytest.raises(SourceError, match="never"):
        stage.recording(source).run()
    assert list(stage.folder.iterdir()) == []
    assert stage.notes[-2:] == ["stopping", "free space closed"]


def test_a_source_that_was_never_connected_and_one_given_up_are_faults(stage):
    never, bad = Source("never"), Source("bad", {5: lambda: 1 / 0})
    never.connected, never.poll = False, Polled
    report = stage.recording(Source(), never, bad, duration=1.0).run()
    assert report.ending.failed
    assert report.ending.reason == (
        "1 s are over; source never was never connected: no attempt to connect has ended; "
        "given up before, see /rosout: bad"
    )
    fault = "source never was never connected: no attempt to connect has ended"
    assert ("recorder", fault) in events(stage.output)


def test_a_full_log_is_the_reason_of_the_end(stage):
    def full():
        made._storage._refused = LogWriteError(stage.output, "the disk is full")

    made = stage.recording(Source(acts={30: full}))
    ending = made.run().ending
    assert ending.failed
    assert ending.reason.startswith(f"{stage.output}: the disk is full")


def test_a_task_that_fails_is_given_up_and_the_recording_goes_on(stage):
    made = stage.recording(Source(), duration=3.0)
    made._optional_tasks[recording._HEALTH] = lambda: 1 / 0
    report = made.run()
    assert not report.ending.failed
    text = (
        f"the {recording._HEALTH} is given up: it failed with ZeroDivisionError('division by zero')"
    )
    assert events(stage.output).count(("recorder", text)) == 1
    with Session(stage.output) as session:
        assert session.verdict == "degraded"


def test_faults_of_the_control_socket_and_of_parts_are_events(stage):
    made = stage.recording(Source(), duration=3.0)
    made._control._faults.append("a request failed")
    tick, reported = made._storage.tick, iter([[("error", "no next part")]])
    made._storage.tick = lambda: next(reported, tick())
    made.run()
    texts = [text for name, text in events(stage.output) if name == "recorder"]
    assert "a request failed" in texts
    assert "no next part" in texts


# -- deleted and moved -----------------------------------------------------------------------------


def test_a_file_that_was_moved_ends_the_recording_and_is_named(stage):
    moved = stage.folder / "moved"
    moved.mkdir()
    part = stage.folder / "run.mcap.part"
    made = stage.recording(Source(acts={60: lambda: shutil.move(part, moved / part.name)}))
    report = made.run()
    how = f"was moved to {moved / part.name} while it was being written"
    assert report.ending.failed
    assert report.ending.reason == (
        f"{stage.output}: {how}; all that was accepted is in {moved / 'run.mcap'}"
    )
    assert report.files == (moved / "run.mcap",)


def test_a_file_that_was_deleted_is_rescued_and_the_lost_parts_are_named(stage):
    stage.output = stage.folder / "here" / "run.mcap"
    stage.output.parent.mkdir()

    def delete():
        wait_for(lambda: 1 in made._storage._disk.placed, "the first part")
        shutil.rmtree(stage.output.parent)

    source = Source()
    made = stage.recording(source)
    source.acts = {60: made.split, 120: delete}
    report = made.run()
    second = stage.output.with_name("run_0002.mcap")
    (rescued,) = report.rescued
    assert rescued.parent == stage.folder
    # The disk's thread may look between the deletion of the file and that of its folder.
    assert report.ending.reason.replace(f"its folder, {stage.output.parent}, ", "") == (
        f"{second}: was deleted while it was being written; "
        f"what was accepted since is in {rescued}; run.mcap went with the folder"
    )
    assert report.size == rescued.stat().st_size


# -- rings, parts, twins ---------------------------------------------------------------------------


def test_a_part_begins_when_asked_for_and_a_mark_is_an_event(stage):
    splits = []
    made = stage.recording(
        Source(acts={30: lambda: splits.append((made.mark("x"), made.split()))}), duration=2.0
    )
    report = made.run()
    second = stage.folder / "run_0002.mcap"
    assert splits == [({}, {"part": 2, "file": str(second)})]
    assert report.files == (stage.output, second)
    assert report.size == sum(path.stat().st_size for path in report.files)


def test_a_ring_has_marks_and_no_parts(stage):
    done = []

    def ask():
        done.append(made.mark("slipped"))
        with pytest.raises(UsageError, match="a ring has no parts; 'undulog record mark' writes"):
            made.split()

    made = stage.recording(Source(acts={100: ask}), duration=3.0, ring=1.0)
    report = made.run()
    path = stage.folder / "run_mark0001.mcap"
    assert [mark["file"] for mark in done] == [str(path)]
    assert report.files == (path,)
    with Session(path) as session:
        assert 0.9 < session.duration_s <= 2.1


def test_sources_of_a_bus_have_no_fast_time(stage):
    with pytest.raises(UsageError, match="--fast is for a twin alone; a bus has its own time"):
        stage.recording(Source(), fast=True)
    assert list(stage.folder.iterdir()) == []


@pytest.mark.parametrize("fast", [False, True])
def test_a_twin_gets_the_duration_and_ends_by_itself(stage, fast):
    twin = Source(acts={200: lambda: setattr(twin, "finished", True)})
    twin.robot = load_robot("snake25")
    report = stage.recording(twin, duration=1.5, fast=fast).run()
    assert (report.ending.reason, report.robot) == ("all sources have ended", "snake25")
    assert twin.context.facts == {"fast": str(fast).lower(), "duration_s": "1.5"}
    assert twin.polls >= 200


def test_a_second_recorder_of_one_name_has_another_socket(stage, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(stage.folder / "r"))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    (stage.folder / "r").mkdir()
    (stage.folder / "b").mkdir()
    first = stage.recording(Source(), socket=None, duration=0.2)
    stage.output = stage.folder / "b" / "run.mcap"
    second = stage.recording(Source(), socket=None, duration=0.2)
    assert first._control.path == stage.folder / "r" / "undulog" / "run.sock"
    assert second._control.path.parent == first._control.path.parent
    assert second._control.path != first._control.path
    assert second.live_socket == second._control.path.with_suffix(".live")
    second.run()
    first.run()
    assert not os.listdir(stage.folder / "r" / "undulog")  # noqa: PTH208
