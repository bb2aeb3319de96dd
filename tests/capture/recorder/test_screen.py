"""A recording's screen, line by line, and what of it has which colour."""

import io
from dataclasses import replace

import pytest

from undulog.capture.recorder.screen import Terminal, event_line, plain_line, screen
from undulog.capture.recorder.source_clock import ClockEstimate
from undulog.capture.recorder.status import (
    EventLine,
    RecorderSnapshot,
    SourceSnapshot,
    TopicSnapshot,
)

EPOCH_NS, NS = 1_700_000_000_000_000_000, 1_000_000_000
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
    clock=ClockEstimate(True, 123, -23.42, 0.1, 0.00214, 0.0093, 1_000_000, 1),
)
IMU = SourceSnapshot("imu", "unix:/run/imu.sock", connected=False, frames=72, age_s=12.0)
STATES = TopicSnapshot("/joint_states", 73_725, 98.3, 0.01, 3, 34, 0.02, 0, ("a",), ("b",), 50)
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
        *(TopicSnapshot(f"/ir/{k:02d}", 20 * k, 20.0, 0.02, 0, 0, 0.1, 0) for k in range(4)),
        *(TopicSnapshot(f"/imu/{k}", k, None, 0.25) for k in range(3)),
        TopicSnapshot("/rosout", 3, 0.1, 5.0),
    ),
    events=(
        EventLine(EPOCH_NS + 1 * NS, "info", "recorder", "recording can0, imu"),
        EventLine(EPOCH_NS + 742 * NS, "error", "imu", "the connection is lost"),
    ),
    tick_p99_s=0.0021,
    tick_max_s=0.012,
)

WIDE = """\
recording /data/run.mcap  snake25                                                                                0:12:34
123 MB (+35.2 kB/s) | part 2 | 1,234,567 messages | 12.3 GB free, full in 4 d
 DEGRADED  so far, 5 reasons | tick p99 2.1 ms
  reason 0
  reason 1
  reason 2
  and 2 more

source      state             frames/s    lost  unread   load  drift/ppm  jitter/ms       frames  bus errors  reconnects
can0        on, lost 12           1787      12       3    24%      -23.4       2.14    1,348,123           2           0
imu         not connected          ...       -       0      -          -          -           72           0           0

topic               msgs/s   age/s   gaps  missing  jitter    lost    messages  joints
/joint_states         98.3     0.0      3       34      2%       0      73,725  1 frozen, 1 at limits, 50 NaN
/ir/ (4)              80.0     0.0      0        0     10%       0         120  -
/imu/0                 ...     0.2      -        -       -       -           0  -
/imu/1                 ...     0.2      -        -       -       -           1  -
/imu/2                 ...     0.2      -        -       -       -           2  -

latest events
0:00:01 info recorder: recording can0, imu
0:12:22 error imu: the connection is lost"""  # noqa: E501

NARROW = """\
recording /data/run.mcap  snake25                    0:12:34
123 MB (+35.2 kB/s) | part 2 | 1,234,567 messages | 12.3 GB…
 DEGRADED  so far, 5 reasons | tick p99 2.1 ms
  reason 0
  reason 1
  reason 2
  and 2 more

source     state             frames/s    lost  unread   load
can0       on, lost 12           1787      12       3    24%
imu        not connected          ...       -       0      -
"""

EVENTS = """

latest events
0:00:01 info recorder: recording can0, imu
0:12:22 error imu: the connection is lost"""

TOPICS = """
topic         msgs/s   age/s   gaps  missing  jitter    lost
/joint_st…      98.3     0.0      3       34      2%       0
/ir/ (4)        80.0     0.0      0        0     10%       0
/imu/0           ...     0.2      -        -       -       -
/imu/1           ...     0.2      -        -       -       -
/imu/2           ...     0.2      -        -       -       -""".splitlines()


def styled(text, style):
    """The pieces of a text with a style, without the spaces around them."""
    return [text.plain[s.start : s.end].strip() for s in text.spans if s.style == style]


def without_fill(text):
    return "\n".join(line.rstrip() for line in text.splitlines())


def test_a_wide_screen():
    assert without_fill(screen(SNAPSHOT, 120).plain) == WIDE


@pytest.mark.parametrize(
    ("height", "shown"),
    [(None, 5), (23, 5), (22, 3), (21, 2), (20, 1), (19, 0), (18, 0), (5, 0)],
)
def test_a_screen_has_as_many_topics_as_there_is_room_for(height, shown):
    lines = screen(SNAPSHOT, 60, height).plain
    hidden = 5 - shown
    topics = TOPICS[: shown + 2] if shown else [""]
    more = [f"and {hidden} more"] if hidden else []
    expected = NARROW + "\n".join([*topics, *more]) + EVENTS
    assert without_fill(lines) == expected
    if height is not None and height >= 19:
        assert len(lines.splitlines()) < height


def test_without_topics_and_events_only_the_sources_are_left():
    bare = replace(SNAPSHOT, topics=(), events=())
    assert without_fill(screen(bare, 60, 30).plain) == NARROW.rstrip()


def test_colours_mark_faults_and_nothing_else():
    text = screen(SNAPSHOT, 120)
    assert styled(text, "bold yellow") == ["DEGRADED"]
    faults = ["on, lost 12", "12", "3", "2", "3", "34", "1 frozen, 1 at limits, 50 NaN"]
    assert styled(text, "yellow") == faults
    assert styled(text, "bold white on red") == ["not connected", "error"]
    muted = styled(text, "bright_black")
    assert muted == ["and 2 more", "-", *["-"] * 9]
    bold = styled(text, "bold")
    assert bold[0].startswith("recording")
    assert bold[1:4] == ["0:12:34", "source", "state"]
    assert bold[-2:] == ["joints", "latest events"]
    for verdict, style in (("good", "bold cyan"), ("bad", "bold white on red")):
        assert verdict.upper() in styled(screen(replace(SNAPSHOT, verdict=verdict), 80), style)


def test_of_many_events_the_last_four_are_shown_in_the_colours_of_their_levels():
    levels = ("error", "debug", "info", "warn", "fatal")
    events = tuple(EventLine(EPOCH_NS + k * NS, level, "x", "y") for k, level in enumerate(levels))
    text = screen(replace(SNAPSHOT, events=events, sources=(), topics=()), 80)
    assert text.plain.splitlines()[-5:] == [
        "latest events",
        *(f"0:00:0{k} {level} x: y" for k, level in enumerate(levels) if k),
    ]
    assert styled(text, "yellow") == ["warn"]
    assert styled(text, "bold white on red") == ["fatal"]


def test_a_long_event_and_a_long_reason_are_cut_to_the_width():
    long = "word " * 60
    event = EventLine(EPOCH_NS + NS, "warn", "can0", long)
    text = screen(replace(SNAPSHOT, events=(event,), reasons=(long,), topics=(), sources=()), 50)
    lines = text.plain.splitlines()
    assert lines[-1] == "0:00:01 warn can0: word word word word word word …"
    assert lines[3:5] == [
        "  word word word word word word word word word",
        "    word word word word word word word word word …",
    ]
    assert lines[2] == " DEGRADED  so far, 1 reason | tick p99 2.1 ms"


@pytest.mark.parametrize(("width", "room"), [(60, 30), (44, 14), (38, 8)])
def test_a_long_path_is_shortened_to_its_end(width, room):
    path = "/somewhere/a/long/way/to/the/file/run.mcap"
    line = screen(replace(SNAPSHOT, path=path, robot=None), width).plain.splitlines()[0]
    assert len(line) == width
    state, shown, time = line.split()
    assert (state, shown, time) == ("recording", "…" + path[1 - room :], "0:12:34")
    whole = replace(SNAPSHOT, path=path[:room])
    assert screen(whole, width).plain.split()[1] == path[:room]


@pytest.mark.parametrize(
    ("counts", "reasons"),
    [(0, "nothing found so far"), (1, "so far, 1 reason"), (2, "so far, 2 reasons"),
     (3, "so far, 3 reasons"), (4, "so far, 4 reasons")],
)  # fmt: skip
def test_three_reasons_are_shown_and_the_others_counted(counts, reasons):
    shown = replace(SNAPSHOT, reasons=tuple("abcd"[:counts]), backlog=counts)
    lines = screen(shown, 100).plain.splitlines()
    backlog = f" | {counts} frames to decode" if counts else ""
    assert lines[2] == f" DEGRADED  {reasons} | tick p99 2.1 ms{backlog}"
    rest = ["  and 1 more"] if counts == 4 else []
    assert lines[3 : lines.index("")] == [*(f"  {c}" for c in "abcd"[: min(counts, 3)]), *rest]


@pytest.mark.parametrize(
    ("rate_hz", "text"), [(None, "..."), (0.0, "0.0"), (99.94, "99.9"), (99.95, "100"),
                          (1234.4, "1234")],
)  # fmt: skip
def test_rates_have_three_digits(rate_hz, text):
    source = replace(CAN, rate_hz=rate_hz)
    lines = screen(replace(SNAPSHOT, sources=(source,)), 80).plain.splitlines()
    (line,) = [line for line in lines if line.startswith("can0")]
    assert line.removeprefix("can0").split()[3] == text


# -- lines -----------------------------------------------------------------------------------------


def test_a_line_has_all_that_is_on_the_screen_in_short():
    assert plain_line(SNAPSHOT) == (
        "0:12:34 degraded; 1,234,567 messages, 123 MB; can0 connected, lost 12, 1787 frames/s; "
        "imu not connected; 12.3 GB free, full in 4 d; reason 0 (and 4 more)"
    )
    short = replace(SNAPSHOT, reasons=("a\nb",), free=None, sources=())
    assert plain_line(short) == "0:12:34 degraded; 1,234,567 messages, 123 MB; a\\nb"
    assert plain_line(replace(short, reasons=(), free=5_000, byte_rate=None)).endswith(
        "123 MB; 5 kB free"
    )
    assert event_line(EventLine(0, "warn", "can0", "a\x1b[1mb")).startswith("warn: can0: a")
    assert "\x1b" not in event_line(EventLine(0, "warn", "can0", "a\x1b[1mb"))


def printed(snapshots):
    """What a terminal writes to a stream that is no screen, for snapshots one after the other."""
    stream, rest = io.StringIO(), [*snapshots, None]
    terminal = Terminal(stream)
    terminal._next = lambda: rest.pop(0)
    terminal._print(stream)
    return stream.getvalue().splitlines()


def test_lines_come_every_ten_seconds():
    times_s = [0.0, 1.0, 9.9, 10.0, 15.0, 21.0, 29.9, 30.9, 31.0]
    quiet = replace(SNAPSHOT, events=())
    lines = printed([replace(quiet, elapsed_s=time_s) for time_s in times_s])
    assert [line.split()[0] for line in lines] == ["0:00:00", "0:00:10", "0:00:21", "0:00:31"]
    assert lines[1] == plain_line(replace(quiet, elapsed_s=10.0))


def test_each_trouble_is_printed_once_and_in_order():
    events = tuple(
        EventLine(EPOCH_NS + k, level, "x", f"{k}")
        for k, level in enumerate(("warn", "info", "error", "debug", "fatal", "warn"))
    )
    cuts = ((0, 1), (0, 3), (0, 3), (1, 4), (2, 5), (5, 6), (5, 6))
    lines = printed([replace(SNAPSHOT, events=events[a:b], elapsed_s=-1.0) for a, b in cuts])
    assert lines == ["warn: x: 0", "error: x: 2", "fatal: x: 4", "warn: x: 5"]
