"""One bus of a recording: which source is the robot's, and how its frames are written."""

from types import SimpleNamespace

import numpy as np
import pytest

from support.recorders import polling
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.log.messages.frames import FD_FRAME_DTYPE, empty_frames
from undulog.capture.recorder import bus_recorder
from undulog.capture.recorder.bus_recorder import BusRecorder, decoded_source, robot_of
from undulog.capture.recorder.source_clock import SourceClock
from undulog.capture.sources.serial_port import SerialSource

NS = 1_000_000_000
EPOCH_NS = 1_700_000_000 * NS


def source(name, robot=None):
    return SimpleNamespace(name=name, robot=robot)


class Line(SerialSource):
    """A serial line that is not opened."""

    def __init__(self, name):
        self.name = name


def settings(robot=None, bus=None):
    return SimpleNamespace(robot=robot, bus=bus)


@pytest.fixture(scope="module")
def snake():
    return load_robot("snake25")


@pytest.fixture(scope="module")
def arm():
    return load_robot("so101")


# -- whose bus it is -------------------------------------------------------------------------------


def test_the_robot_is_that_of_the_settings_or_of_a_twin(snake, arm):
    assert robot_of(settings(), [source("a"), source("b")]) is None
    assert robot_of(settings(), [source("a"), source("twin", snake)]) is snake
    assert robot_of(settings(), [source("t", snake), source("u", snake)]) is snake
    assert robot_of(settings("so101"), [source("a")]).name == "so101"
    assert robot_of(settings("snake25"), [source("twin", snake)]).name == "snake25"
    with pytest.raises(UsageError, match="the sources bring different robots: snake25, so101"):
        robot_of(settings(), [source("t", snake), source("u", arm)])
    fault = "--robot so101, but the twin brings the robot snake25; leave --robot out"
    with pytest.raises(UsageError, match=fault):
        robot_of(settings("so101"), [source("twin", snake)])


def test_the_only_bus_is_the_robot_s(snake, arm):
    assert decoded_source(settings(), [source("a")], snake) == "a"
    assert decoded_source(settings(), [source("a")], None) is None
    assert decoded_source(settings(), [source("twin", snake)], snake) is None
    assert decoded_source(settings(), [source("a"), source("twin", snake)], snake) is None
    assert decoded_source(settings(), [source("a"), Line("line")], arm) == "line"
    assert decoded_source(settings(), [source("a"), Line("line")], snake) == "a"
    assert decoded_source(settings(), [], snake) is None


def test_a_bus_is_chosen_by_its_name(snake):
    sources = [source("a"), source("b")]
    for name in "ab":
        assert decoded_source(settings(bus=name), sources, snake) == name
    with pytest.raises(UsageError) as caught:
        decoded_source(settings(), sources, snake)
    assert str(caught.value) == (
        "which of a, b is the bus of snake25? Choose it by --bus NAME; the others are kept raw"
    )
    with pytest.raises(UsageError, match="--bus c: no such bus; there are: a, b"):
        decoded_source(settings(bus="c"), sources, snake)
    with pytest.raises(UsageError, match="--bus a needs a robot with a bus map"):
        decoded_source(settings(bus="a"), sources, None)
    assert decoded_source(settings(bus="a"), [source("a"), source("t", snake)], snake) == "a"


def test_a_robot_of_another_kind_of_bus_is_refused(snake, arm):
    with pytest.raises(UsageError, match="motors of snake25 are on a CAN bus, and no source is"):
        decoded_source(settings(), [Line("line")], snake)
    text = r"motors of so101 are on a serial line \(serial:PORT\?protocol=\.\.\.\), and no source"
    with pytest.raises(UsageError, match=text):
        decoded_source(settings(), [source("a")], arm)


# -- its frames ------------------------------------------------------------------------------------


@pytest.fixture
def stage(tmp_path, snake):
    """A session, a bus of it, and its clock, which the test moves."""
    stage = SimpleNamespace(path=tmp_path / "run.mcap", now_ns=EPOCH_NS)
    with SessionWriter(stage.path, session_id="s", epoch_ns=EPOCH_NS, robot=snake) as writer:
        stage.writer = writer
        stage.bus = BusRecorder("can0", writer, SourceClock(), snake, directions=True)
        stage.now = lambda: stage.now_ns
        yield stage


def frames_at(count, first=0):
    frames, _ = polling(-(-count // 50))
    frames = frames[:count]
    frames["t_host_ns"] = EPOCH_NS + np.arange(first, first + count)
    return frames


def messages_of(path, topic):
    with Session(path) as session:
        return session.channels[topic].count if topic in session.channels else 0


def test_raw_frames_are_written_4096_in_a_message(stage):
    stage.bus.write_raw(stage.now)
    for count in (4096, 4097, 0, 5000):
        if count:
            stage.bus.add(frames_at(count)[: count // 2])
            stage.bus.add(frames_at(count)[count // 2 :])
        stage.bus.write_raw(stage.now)
    assert stage.bus.backlog == 4096 + 4097 + 5000
    stage.writer.close()
    assert messages_of(stage.path, "/can/can0") == 1 + 2 + 2


def test_frames_that_are_only_kept_come_behind_those_that_wait(stage):
    stage.bus.add(frames_at(3))
    stage.bus.keep(frames_at(2, first=3), stage.now)
    assert stage.bus.backlog == 3
    assert stage.bus.decodes
    stage.bus.finish(stage.now)
    stage.writer.close()
    with Session(stage.path) as session:
        kept = session.frames("/can/can0")
    assert kept["t_host_ns"].tolist() == [EPOCH_NS + k for k in range(5)]


def test_frames_of_both_kinds_are_decoded_in_the_order_of_the_bus(stage, monkeypatch):
    decoded = []
    monkeypatch.setattr(bus_recorder, "_FEWEST", 1)
    fd = np.zeros(2, FD_FRAME_DTYPE)
    fd["t_host_ns"] = EPOCH_NS + np.array([1, 3])
    fd["t_device_ns"] = [11, 12]
    classic = empty_frames(3)
    classic["t_host_ns"] = EPOCH_NS + np.array([0, 1, 5])
    classic["t_device_ns"] = [10, 10, 13]
    stage.bus._decoder = SimpleNamespace(
        decode=lambda frames: decoded.append(frames["t_device_ns"].tolist()) or 1 / 0
    )
    for frames in (fd, classic):
        stage.bus.add(frames)
    stage.bus.write_raw(stage.now)
    assert stage.bus.backlog == 5
    stage.bus.finish(stage.now)
    assert decoded[0] == [10, 10, 11, 12, 13]
    stage.writer.close()
    assert (messages_of(stage.path, "/can/can0"), messages_of(stage.path, "/canfd/can0")) in {
        (1, 1), (1, 0),
    }  # fmt: skip


def test_without_a_robot_frames_are_raw_only(stage):
    bus = BusRecorder("b", stage.writer, SourceClock(), None, directions=False)
    assert not bus.decodes
    bus.add(frames_at(600))
    bus.write_raw(stage.now)
    assert (bus.backlog, bus.behind) == (600, True)
    bus.finish(stage.now)
    assert (bus.backlog, bus.behind, bus.take_faults()) == (0, False, [])


# -- slices ----------------------------------------------------------------------------------------


@pytest.fixture
def work(monkeypatch):
    """Processor time of the next slices [ns]; all later ones take the last."""
    work = SimpleNamespace(costs=[8_000_000], now_ns=0, calls=0)

    def thread_time_ns():
        work.calls += 1
        if work.calls % 2 == 0:
            work.now_ns += work.costs[0] if len(work.costs) == 1 else work.costs.pop(0)
        return work.now_ns

    monkeypatch.setattr(bus_recorder, "time", SimpleNamespace(thread_time_ns=thread_time_ns))
    return work


def decoded_sizes(stage, count, until_ns=1 << 63, **options):
    """The sizes of the slices in which frames are decoded."""
    sizes, decode = [], stage.bus._decoder.decode

    def noted(frames):
        sizes.append(len(frames))
        return decode(frames)

    stage.bus._decoder = SimpleNamespace(decode=noted)
    if count:
        stage.bus.add(frames_at(count))
        stage.bus.write_raw(stage.now)
    stage.bus.decode(stage.now, until_ns, **options)
    stage.bus._decoder = SimpleNamespace(decode=decode)
    return sizes


def test_slices_have_256_frames_until_their_cost_is_known(stage, work):
    assert decoded_sizes(stage, 1000) == [256, 256, 256, 232]
    assert stage.bus.backlog == 0


def test_cheap_slices_grow_to_1024_frames_and_dear_ones_shrink_to_256(stage, work):
    work.costs = [6_000_000, 5_999_999, 1, 1, 12_000_000, 12_000_001, 12_000_001, 12_000_001, 7]
    sizes = decoded_sizes(stage, 256 * 2 + 512 + 1024 * 3 + 512 + 256 * 2 + 9)
    assert sizes == [256, 256, 512, 1024, 1024, 1024, 512, 256, 256, 9]


def test_frames_of_an_incomplete_slice_wait_unless_all_are_asked_for(stage, work):
    assert decoded_sizes(stage, 300, rest=False) == [256]
    assert (stage.bus.backlog, stage.bus.behind) == (44, False)
    assert decoded_sizes(stage, 212, rest=False) == [256]
    assert decoded_sizes(stage, 1) == [1]


def test_no_slice_is_begun_that_would_last_too_long(stage, work):
    stage.now_ns = EPOCH_NS
    assert decoded_sizes(stage, 2000, until_ns=EPOCH_NS + 8_000_000) == [256]
    assert stage.bus.behind
    assert decoded_sizes(stage, 0, until_ns=EPOCH_NS + 8_000_001)[:2] == [256, 256]


def test_after_the_time_nothing_is_decoded_and_no_message_written(stage, work):
    assert decoded_sizes(stage, 600, until_ns=EPOCH_NS) == []
    assert decoded_sizes(stage, 0, until_ns=EPOCH_NS + 1) == [256]
    written = len(stage.bus._messages)
    stage.bus.decode(stage.now, EPOCH_NS)
    assert len(stage.bus._messages) == written


# -- failures --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [1, 3])
def test_a_frame_that_can_not_be_decoded_is_found_by_eighths(stage, work, bad):
    sizes, decode = [], stage.bus._decoder.decode

    def failing(frames):
        sizes.append(len(frames))
        if (frames["t_host_ns"] % 100 == 7).any():
            raise ZeroDivisionError
        return decode(frames)

    frames = frames_at(256)
    frames["t_host_ns"] = EPOCH_NS + 100 * np.arange(256)
    frames["t_device_ns"] = frames["t_host_ns"]
    for k in range(bad):
        frames["t_host_ns"][70 + k] += 7
        frames["t_device_ns"][70 + k] += 7
    stage.bus._decoder = SimpleNamespace(decode=failing)
    stage.bus.add(frames)
    stage.bus.finish(stage.now)
    (fault,) = stage.bus.take_faults()
    assert fault == (
        f"decoding failed with ZeroDivisionError() and goes on; {bad} frames are kept raw only"
    )
    assert stage.bus.take_faults() == []
    assert sizes[:5] == [256, 32, 32, 32, 4]
    assert sizes.count(1) == {1: 4, 3: 8}[bad]


def test_after_16_failures_in_a_row_the_rest_of_a_slice_is_given_up(stage, work):
    tried = []

    def failing(frames):
        tried.append(len(frames))
        raise ZeroDivisionError

    stage.bus._decoder = SimpleNamespace(decode=failing)
    stage.bus.add(frames_at(256))
    stage.bus.finish(stage.now)
    (fault,) = stage.bus.take_faults()
    assert "; 256 frames are kept raw only" in fault
    assert tried.count(1) == 16


def test_a_log_that_is_full_ends_the_decoding(stage, work):
    def full(_):
        raise LogWriteError(stage.path, "full")

    stage.bus._topics = SimpleNamespace(add=full)
    stage.bus.add(frames_at(10))
    stage.bus.write_raw(stage.now)
    with pytest.raises(LogWriteError, match="full"):
        stage.bus.decode(stage.now, 1 << 63)


class Messages:
    """Some messages of a topic, of which some can't be written."""

    topic = "/t"

    def __init__(self, numbers, written, error=ZeroDivisionError):
        self.numbers, self.written, self.error = numbers, written, error

    def __len__(self):
        return len(self.numbers)

    def part(self, some):
        return Messages(self.numbers[some], self.written, self.error)

    def write(self, log_ns):
        assert len(log_ns) == len(self)
        if 3 in self.numbers:
            raise self.error(*(() if self.error is ZeroDivisionError else ("a", "full")))
        self.written += self.numbers


def test_a_message_that_can_not_be_written_costs_itself_alone(stage):
    written = []
    stage.bus._messages.append(Messages([1, 2, 3, 4], written))
    stage.bus.decode(stage.now, 1 << 63)
    assert written == [1, 2, 4]
    (fault,) = stage.bus.take_faults()
    assert fault.startswith("decoding failed with ZeroDivisionError() on /t and goes on; 0 frames")
    stage.bus._messages.append(Messages([3], written, LogWriteError))
    with pytest.raises(LogWriteError, match="full"):
        stage.bus.decode(stage.now, 1 << 63)


def test_a_mistake_at_the_end_is_reported(stage, monkeypatch):
    stage.bus._topics = SimpleNamespace(finish=lambda: 1 / 0)
    stage.bus.finish(stage.now)
    (fault,) = stage.bus.take_faults()
    assert "ZeroDivisionError" in fault


def test_a_clock_that_fails_leaves_the_times_of_arrival(stage):
    clock = SimpleNamespace(restarts=0)

    def restart():
        clock.restarts += 1

    stage.bus._clock = SimpleNamespace(add=lambda *_: 1 / 0, restart=restart)
    seen = []
    stage.bus._decoder = SimpleNamespace(decode=lambda frames: seen.append(frames.copy()) or 1 / 0)
    frames = frames_at(1)
    stage.bus.add(frames)
    stage.bus.finish(stage.now)
    assert clock.restarts == 1
    assert seen[0]["t_host_ns"].tolist() == frames["t_host_ns"].tolist()
    assert len(stage.bus.take_faults()) == 1
