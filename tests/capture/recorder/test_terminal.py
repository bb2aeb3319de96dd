"""What an operator sees, on real terminals and pipes, also on those that take nothing."""

import fcntl
import io
import os
import pty
import re
import select
import struct
import sys
import termios
import threading
from contextlib import closing, contextmanager, suppress
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from support.paths import ROOT
from support.processes import python, wait_for
from undulog.capture.log.health.bus_tally import measure_sources, read_statuses
from undulog.capture.log.messages.definitions import ERROR, OK, STALE, WARN
from undulog.capture.recorder.screen import Terminal, clock_time, plain_line, screen, time_left
from undulog.capture.recorder.source_clock import ClockEstimate
from undulog.capture.recorder.status import (
    EventLine,
    RecorderSnapshot,
    SourceSnapshot,
    TopicSnapshot,
    statuses,
)

EPOCH_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
CLOCK = ClockEstimate(True, 123, -23.42, 0.1, 0.00214, 0.0093, 1_000_000, 1)
CAN = SourceSnapshot(
    name="can0",
    address="can:socketcan:can0",
    connected=True,
    frames=1_348_123,
    rate_hz=1787.4,
    age_s=0.003,
    dropped=12,
    malformed=3,
    error_frames=2,
    load=(0.198, 0.241),
    clock=CLOCK,
)
IMU = SourceSnapshot("imu", "unix:/run/imu.sock", connected=False, frames=72, age_s=12.0)
STATES = TopicSnapshot(
    "/joint_states", 73_725, 98.3, 0.01, 3, 34, 0.02, 0, ("joint03",), ("joint07",), 50
)
SNAPSHOT = RecorderSnapshot(
    session_id="s",
    path="/data/run.mcap",
    robot="snake25",
    state="recording",
    now_ns=EPOCH_NS + 754 * NS,
    elapsed_s=754.2,
    messages=1_234_567,
    size=123_456_789,
    byte_rate=35_200.0,
    free=12_300_000_000,
    part=2,
    verdict="degraded",
    reasons=tuple(f"reason {k}" for k in range(5)),
    notes=(),
    sources=(CAN, IMU),
    topics=(
        STATES,
        *(TopicSnapshot(f"/ir/{k:02d}", 20 * k, 20.0, 0.02, 0, 0, 0.1, 0) for k in range(15)),
        TopicSnapshot("/rosout", 3, 0.1, 5.0),
    ),
    events=(
        EventLine(EPOCH_NS + 1 * NS, "info", "recorder", "recording can0, imu"),
        EventLine(EPOCH_NS + 742 * NS, "error", "imu", "the connection is lost"),
    ),
    tick_p99_s=0.0021,
    tick_max_s=0.012,
)


def rows(snapshot, width, height=None):
    return screen(snapshot, width, height).plain.split("\n")


def row(lines, first):
    (match,) = [line for line in lines if line.startswith(first)]
    return re.split(r"\s{2,}", match.strip())


# -- what is drawn -----------------------------------------------------------------------------


def test_the_answer_comes_first_and_everything_is_on_the_screen():
    lines = rows(SNAPSHOT, 120)
    assert lines[0].split() == ["recording", "/data/run.mcap", "snake25", "0:12:34"]
    assert "123 MB (+35.2 kB/s) | part 2 | 1,234,567 messages" in lines[1]
    assert "12.3 GB free, full in 4 d" in lines[1]  # 12.3e9 / 35.2e3 = 349,432 s
    assert lines[2].split()[:2] == ["DEGRADED", "so"]
    assert "and 2 more" in "\n".join(lines)
    assert row(lines, "can0") == (
        ["can0", "on, lost 12", "1787", "12", "3", "24%", "-23.4", "2.14", "1,348,123", "2", "0"]
    )
    assert row(lines, "imu")[1] == "not connected"
    states = "/joint_states|98.3|0.0|3|34|2%|0|73,725|1 frozen, 1 at limits, 50 NaN"
    assert row(lines, "/joint_states") == states.split("|")
    assert row(lines, "/ir/ (15)")[1] == "300"  # 15 sensors of one kind are one row
    assert not any(line.startswith("/rosout") for line in lines)
    assert lines[-1] == "0:12:22 error imu: the connection is lost"


def test_what_is_not_known_is_a_dash_and_what_is_to_come_dots():
    new = SourceSnapshot("new", "unix:/x", connected=True, frames=None)
    clockless = replace(CAN, name="plain", clock=replace(CLOCK, own_clock=False), load=None)
    soon = replace(CAN, name="soon", clock=replace(CLOCK, drift_ppm=None), rate_hz=99.94)
    lines = rows(replace(SNAPSHOT, sources=(new, clockless, soon), topics=()), 120)
    assert row(lines, "new") == ["new", "connected", "-", "-", "0", "-", "-", "-", "-", "0", "0"]
    assert row(lines, "plain")[5:8] == ["-", "-", "-"]
    assert row(lines, "soon")[2] == "99.9"
    assert row(lines, "soon")[6:8] == ["...", "2.14"]
    fresh = TopicSnapshot("/imu", 5, None, 0.25, jitter=0.0)
    lines = rows(replace(SNAPSHOT, sources=(), topics=(fresh,)), 120)
    assert row(lines, "/imu") == ["/imu", "...", "0.2", "-", "-", "0%", "-", "5", "-"]


def test_events_have_their_time_since_the_start():
    early = EventLine(EPOCH_NS - 900 * NS, "warn", "a", "long before")
    later = EventLine(SNAPSHOT.now_ns + 5 * NS, "fatal", "b", "still to come")
    lines = rows(replace(SNAPSHOT, events=(early, later)), 100)
    assert lines[-2:] == ["0:00:00 warn a: long before", "0:12:34 fatal b: still to come"]


def test_the_headline_leaves_out_what_there_is_not():
    bare = replace(SNAPSHOT, robot=None, part=None, free=None, byte_rate=None, reasons=("one",))
    lines = rows(replace(bare, tick_p99_s=None, backlog=7), 100)
    assert lines[0].split() == ["recording", "/data/run.mcap", "0:12:34"]
    assert lines[1] == "123 MB | 1,234,567 messages"
    assert lines[2].startswith(" DEGRADED  so far, 1 reason | 7 frames to decode")
    assert lines[3].startswith("  one")
    assert "tick" not in lines[2]
    assert " reasons | tick p99 2.1 ms" in rows(SNAPSHOT, 100)[2]
    assert plain_line(bare).endswith("imu not connected; one")


def test_a_good_recording_says_so_in_words():
    good = replace(SNAPSHOT, verdict="good", reasons=(), events=(), topics=(), sources=())
    assert "GOOD" in rows(good, 80)[2]
    assert "nothing found so far" in rows(good, 80)[2]


texts = st.text(max_size=200)


@given(st.integers(40, 200), st.integers(8, 60), texts, texts, texts)
def test_no_screen_is_wider_than_the_terminal_whatever_names_say(width, height, reason, path, text):
    snapshot = replace(
        SNAPSHOT,
        path=path,
        reasons=(reason, "the second"),
        events=(EventLine(EPOCH_NS, "warn", path, text),),
        sources=(replace(CAN, name=text), IMU),
    )
    lines = rows(snapshot, width, height)
    assert max(map(cell_len, lines)) <= width
    assert all(line.isprintable() for line in lines)
    console = Console(file=io.StringIO(), width=width, force_terminal=True)
    console.print(screen(snapshot, width, height))


def test_a_small_screen_counts_the_topics_that_it_leaves_out():
    many = tuple(TopicSnapshot(f"/topic_{k}", 1, 1.0, 0.0) for k in range(40))
    lines = rows(replace(SNAPSHOT, topics=many), 80, 24)
    assert len(lines) <= 24
    shown = sum(line.startswith("/topic_") for line in lines)
    assert f"and {40 - shown} more" in lines


@pytest.mark.parametrize(
    ("time_s", "clock", "left"),
    [
        (0.4, "0:00:00", "0 s"),
        (59.9, "0:00:59", "59 s"),
        (60.0, "0:01:00", "1 min"),
        (3599.0, "0:59:59", "59 min"),
        (3600.0, "1:00:00", "1 h 0 min"),
        (12_000.0, "3:20:00", "3 h 20 min"),
        (35_999.0, "9:59:59", "9 h 59 min"),
        (36_000.0, "10:00:00", "10 h"),
        (100_000.0, "27:46:40", "27 h"),
        (172_799.0, "47:59:59", "47 h"),
        (172_800.0, "48:00:00", "2 d"),
        (400_000.0, "111:06:40", "4 d"),
    ],
)
def test_times_are_shown_in_units_that_matter(time_s, clock, left):
    assert (clock_time(time_s), time_left(time_s)) == (clock, left)


# -- where it is drawn -------------------------------------------------------------------------


@contextmanager
def terminal():
    """A real terminal of 100 x 30: the end of whoever looks at it, and the stream."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    with os.fdopen(theirs, "w") as stream, os.fdopen(ours, "rb"):
        yield ours, stream


def read_until(number, expected):
    output = b""

    def is_there():
        nonlocal output
        if select.select([number], [], [], 0)[0]:
            output += os.read(number, 1 << 16)
        return expected.encode() in output

    wait_for(is_there, expected)
    return output.decode()


@pytest.fixture
def usual_size(monkeypatch):
    """What a terminal that the tests run in doesn't change."""
    for name, value in (("TERM", "xterm-256color"), ("COLUMNS", "100"), ("LINES", "30")):
        monkeypatch.setenv(name, value)


@pytest.mark.usefixtures("usual_size")
def test_a_terminal_gets_a_screen_that_is_cleared_at_the_end():
    with terminal() as (ours, stream):
        shown = Terminal(stream)
        shown.show(SNAPSHOT)
        assert "DEGRADED" in read_until(ours, "the connection is lost")
        shown.show(replace(SNAPSHOT, elapsed_s=755.3))
        assert "0:12:35" in read_until(ours, "the connection is lost")
        assert shown.close()
        stream.write("the report\n")
        stream.flush()
        left = read_until(ours, "the report").rpartition("the connection is lost")[2]
        assert left.count("\x1b[2K") == len(rows(SNAPSHOT, 100))  # each line is erased


@pytest.mark.usefixtures("usual_size")
def test_a_terminal_is_drawn_on_by_one_thread_in_all_its_lines_but_the_last():
    streams, before = (sys.stdout, sys.stderr), set(threading.enumerate())
    many = tuple(TopicSnapshot(f"/topic_{k}", 1, 1.0, 0.0) for k in range(40))
    crowded = replace(SNAPSHOT, topics=many)
    with terminal() as (ours, stream):
        shown = Terminal(stream)
        shown.show(crowded)
        drawn = read_until(ours, "the connection is lost")
        (thread,) = set(threading.enumerate()) - before
        assert (thread.name, thread.daemon) == ("terminal", True)
        assert (sys.stdout, sys.stderr) == streams
        assert shown.close()
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", drawn).replace("\r", "")
    assert text.strip().split("\n") == [line.rstrip() for line in rows(crowded, 100, 29)]


@pytest.mark.slow
def test_a_terminal_that_takes_nothing_does_not_stop_the_recording(monkeypatch):
    """As after Ctrl-S: nobody reads, the kernel's buffer is full, a write waits for ever."""
    monkeypatch.setenv("TERM", "xterm-256color")
    with terminal() as (ours, stream):
        refused = 0

        def is_full():  # the kernel moves what was written on, and has room again
            nonlocal refused
            with suppress(BlockingIOError):
                while os.write(stream.fileno(), b"earlier output\n"):
                    refused = 0
            refused += 1
            return refused > 50

        os.set_blocking(stream.fileno(), False)
        wait_for(is_full, "a full terminal")
        os.set_blocking(stream.fileno(), True)
        shown = Terminal(stream)
        for second in range(200):
            shown.show(replace(SNAPSHOT, elapsed_s=float(second)))
        assert not shown.close()
        read_until(ours, "0:03:19")  # Ctrl-Q: it goes on with the latest state

        def is_closed():
            if select.select([ours], [], [], 0)[0]:
                os.read(ours, 1 << 16)
            return shown.close()

        wait_for(is_closed, "the end")


@pytest.mark.slow
def test_a_process_whose_terminal_is_stuck_can_end():
    program = (
        "import sys, time\n"
        "from tests_snapshot import SNAPSHOT, Terminal\n"
        "shown = Terminal(sys.stderr)\n"
        "for k in range(100):\n"
        "    shown.show(SNAPSHOT)\n"
        "    time.sleep(0.002)\n"
        "print(shown.close())\n"
    )
    source = "import importlib.util, sys\nspec = importlib.util.spec_from_file_location("
    source += f"'tests_snapshot', {__file__!r})\nmodule = importlib.util.module_from_spec(spec)\n"
    source += "sys.modules['tests_snapshot'] = module\nspec.loader.exec_module(module)\n"
    with terminal() as (_, stream):
        environment = os.environ | {"TERM": "xterm-256color", "PYTHONPATH": f"{ROOT}/tests"}
        done = python(source + program, stderr=stream, env=environment)
    assert (done.returncode, done.stdout) == (0, "False\n")


def test_a_pipe_gets_a_line_every_ten_seconds_and_each_trouble_once():
    number, other = os.pipe()
    with os.fdopen(other, "w") as stream:
        shown = Terminal(stream)
        output = ""
        for second in range(25):
            late = EventLine(EPOCH_NS + 13 * NS, "warn", "can0", "a late one")
            events = (*SNAPSHOT.events, late) if second >= 13 else SNAPSHOT.events
            shown.show(replace(SNAPSHOT, elapsed_s=float(second), events=events))
            if second in (0, 10, 13, 20):  # these are waited for; others may be skipped
                output += read_until(number, "late one" if second == 13 else f"0:00:{second:02d} ")
        assert shown.close()
    with os.fdopen(number) as rest:
        output += rest.read()
    lines = output.splitlines()
    times = [line.split()[0] for line in lines if line[0].isdigit()]
    assert times == ["0:00:00", "0:00:10", "0:00:20"]
    assert lines.count("error: imu: the connection is lost") == 1
    assert lines.count("warn: can0: a late one") == 1
    assert not any(line.startswith("info") for line in lines)


def test_a_terminal_that_has_gone_is_no_trouble():
    number, other = os.pipe()
    os.close(number)
    with os.fdopen(other, "w") as stream:
        shown = Terminal(stream)
        shown.show(SNAPSHOT)
        shown.show(SNAPSHOT)
        assert shown.close()
    text = io.StringIO()
    quiet = Terminal(text, quiet=True)
    quiet.show(SNAPSHOT)
    assert quiet.close()
    assert text.getvalue() == ""


def test_a_recording_that_waits_for_commands_is_shown_as_such():
    waiting = replace(SNAPSHOT, state="waiting for commands", verdict="good", reasons=())
    shown = screen(waiting, 80).plain.splitlines()
    assert shown[0].startswith("waiting for commands /data/run.mcap  snake25")
    assert shown[2].startswith(" GOOD  nothing found so far, waiting for commands")
    assert plain_line(waiting).startswith("0:12:34 good, waiting for commands; ")
    assert "waiting" not in screen(SNAPSHOT, 80).plain + plain_line(SNAPSHOT)


def test_the_line_says_what_matters():
    line = plain_line(SNAPSHOT)
    assert line.startswith("0:12:34 degraded; 1,234,567 messages, 123 MB; can0 connected, lost 12")
    assert line.endswith("reason 0 (and 4 more)")


# -- the same as diagnostics -------------------------------------------------------------------


def test_the_statuses_say_what_the_screen_says():
    by_name = {status.name: status for status in statuses(SNAPSHOT)}
    names = "recorder, session, source can0, source imu, topics ir, topics joints"
    assert list(by_name) == names.split(", ")
    assert (by_name["recorder"].level, by_name["session"].level) == (OK, WARN)
    assert by_name["session"].values["reason.2"] == "reason 1"
    assert (by_name["source can0"].level, by_name["source imu"].level) == (WARN, ERROR)
    assert by_name["source can0"].values["clock_drift_ppm"] == "-23.420"
    assert by_name["topics ir"].values["topics"] == "15"
    assert "frozen: joint07" in by_name["topics joints"].message


def test_a_silent_source_is_stale_and_a_full_disk_an_error():
    snapshot = replace(SNAPSHOT, sources=(replace(CAN, age_s=3.0, dropped=0),), free=1_000_000)
    by_name = {status.name: status for status in statuses(snapshot)}
    assert (by_name["source can0"].level, by_name["source can0"].message) == (
        STALE,
        "silent for 3 s",
    )
    recorder = by_name["recorder"]
    assert (recorder.level, recorder.message) == (ERROR, "the disk is full in 28 s")


def test_what_is_written_is_what_a_check_reads(tmp_path):
    """Statuses to a file and back, the counts of the sources included."""
    from undulog.capture import SessionWriter
    from undulog.capture.log.columns.topics import Topics
    from undulog.capture.log.file.log_file import LogFile
    from undulog.capture.log.messages.definitions import message_type

    path = tmp_path / "s.mcap"

    def written(snapshot):
        with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, force=True) as writer:
            writer.diagnostics().write(EPOCH_NS, statuses(snapshot))
        with closing(LogFile(path)) as log_file:
            _, message, kind = Topics(log_file, print).first("/diagnostics")
        return kind, message

    kind, message = written(SNAPSHOT)
    assert kind.name == message_type("diagnostic_msgs/msg/DiagnosticArray").name
    assert read_statuses(kind, message) == statuses(SNAPSHOT)
    assert measure_sources(kind, message, message) == ()  # one moment, long after the start
    kind, message = written(replace(SNAPSHOT, elapsed_s=1.0))
    can, imu = measure_sources(kind, message, message)
    assert (can.frames, can.dropped, can.malformed, can.clock_resets) == (1_348_123, 12, 3, 1)
    assert (imu.frames, imu.dropped) == (72, None)
