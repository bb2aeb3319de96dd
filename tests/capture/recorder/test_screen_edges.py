"""A recording's screen at every width, its rows and colours, and streams that are no terminal."""

import io
import random
from dataclasses import replace

import pytest
from rich.cells import cell_len

from undulog.capture.recorder.screen import Terminal, plain_line, screen
from undulog.capture.recorder.status import (
    EventLine,
    RecorderSnapshot,
    SourceSnapshot,
    TopicSnapshot,
)

NS = 1_000_000_000
BARE = RecorderSnapshot(
    session_id="s", path="/data/run.mcap", robot=None, state="recording", now_ns=100 * NS,
    elapsed_s=100.0, messages=1, size=5, byte_rate=None, free=None, part=None, verdict="degraded",
    reasons=(), notes=(), sources=(), topics=(), events=(),
)  # fmt: skip


def lines(width, height=None, **changes):
    return screen(replace(BARE, **changes), width, height).plain.split("\n")


def cut_to(text, width):
    """A text of plain letters in so many cells."""
    return text if len(text) <= width else text[: width - 1] + "…"


# -- widths ----------------------------------------------------------------------------------------


def test_each_line_has_the_room_that_the_screen_gives_it():
    facts = "5 B | part 12 | 1 messages | 7.34 GB free"
    verdict = " DEGRADED  so far, 1 reason | tick p99 700.0 ms | 345 frames to decode"
    text = "the connection was lost, and has not come back since then"
    given = {
        "events": (EventLine(95 * NS, "error", "can0", text),), "backlog": 345, "part": 12,
        "free": 7_340_000_000, "reasons": ("ab " * 200,), "tick_p99_s": 0.7,
    }  # fmt: skip
    path = BARE.path
    for width in (*range(30, 50), *range(50, 90, 3)):
        shown_lines, room = lines(width, **given), max(width - 30, 8)
        shown = path if len(path) <= room else "…" + path[1 - room :]
        assert (
            shown_lines[0] == cut_to(f"recording {shown}", width - 8).ljust(width - 8) + " 0:01:40"
        )
        assert shown_lines[1] == cut_to(facts, width)
        assert shown_lines[2] == cut_to(verdict, width)
        assert shown_lines[3] == "  " + " ".join(["ab"] * ((width - 3) // 3))
        assert shown_lines[4] == "    " + " ".join(["ab"] * ((width - 5) // 3)) + " …"
        assert shown_lines[-1] == cut_to(f"0:01:35 error can0: {text}", width)


def test_a_path_is_shown_as_far_as_it_fits_from_its_end():
    """In cells, of which some letters take two; eight at least."""
    rng = random.Random(2)
    for _ in range(100):
        path = "/" + "".join(rng.choices("abc/日本", k=rng.randrange(60)))
        room = rng.randrange(6, 60)
        shown = lines(room + 30, path=path)[0].split()[1]
        room = max(room, 8)
        if cell_len(path) <= room:
            assert shown == path
            continue
        ends = [path[k:] for k in range(1, len(path) + 1) if cell_len(path[k:]) < room]
        assert shown == "…" + ends[0]


# -- rows ------------------------------------------------------------------------------------------


def rows(*topics):
    """The first words of the rows of some topics."""
    shown_lines = lines(100, topics=tuple(TopicSnapshot(name, 1, 10.0, 0.0) for name in topics))
    return [line.split("  ")[0] for line in shown_lines[shown_lines.index("", 5) + 2 :]]


def test_topics_without_a_rhythm_are_left_out_and_the_others_keep_their_order():
    assert rows("/rosout", "/imu", "/diagnostics", "/odom", "/rosout") == ["/imu", "/odom"]


def test_sensors_of_one_kind_are_one_row_from_four_on_and_joints_never():
    joints = ["/joint_states", "/joint_commands", "/joint_power/a", "/joint_power/b", "/joint_a",
              "/joint_power/c", "/joint_power/d"]  # fmt: skip
    three, four = [f"/ir/{k}" for k in range(3)], [f"/touch/{k}/x" for k in range(4)]
    first_words = rows(*joints, *four[:2], "/imu", *three, *four[2:])
    assert first_words == [*joints, "/touch/ (4)", "/imu", *three]


@pytest.mark.parametrize(
    ("source", "style"),
    [
        ({}, ""),
        ({"finished": True}, ""),
        ({"age_s": 3.0}, "yellow"),
        ({"dropped": 3}, "yellow"),
        ({"connected": False}, "bold white on red"),
    ],
)
def test_the_state_of_a_source_has_the_colour_of_its_level(source, style):
    given = SourceSnapshot(**{"name": "can0", "address": "x", "connected": True} | source)
    text = screen(replace(BARE, sources=(given,)), 100)
    (line,) = [line for line in text.split() if line.plain.startswith("can0")]
    at = line.plain.index(line.plain.split()[1])
    assert [str(span.style) for span in line.spans if span.start == at and span.style] == (
        [style] if style else []
    )


def test_waiting_and_rates_are_in_the_line():
    source = SourceSnapshot("a", "x", connected=True, rate_hz=12.5)
    waiting = replace(BARE, state="waiting for commands", verdict="good", sources=(source,))
    assert plain_line(waiting) == (
        "0:01:40 good, waiting for commands; 1 messages, 5 B; a connected, 12 frames/s"
    )
    for count, more in ((1, ""), (2, " (and 1 more)"), (3, " (and 2 more)")):
        assert plain_line(replace(BARE, reasons=("x",) * count)) == (
            f"0:01:40 degraded; 1 messages, 5 B; x{more}"
        )


# -- streams ---------------------------------------------------------------------------------------


def test_a_text_in_memory_gets_the_latest_state_before_the_end():
    stream = io.StringIO()
    shown = Terminal(stream)
    event = EventLine(5 * NS, "fatal", "x", "y")
    shown.show(replace(BARE, events=(event,)))
    assert shown.close()
    assert stream.getvalue() == f"fatal: x: y\n{plain_line(BARE)}\n"


def test_a_terminal_that_was_never_drawn_on_is_closed_at_once():
    stream = io.StringIO()
    assert Terminal(stream).close()
    quiet = Terminal(stream, quiet=True)
    quiet.show(BARE)
    assert (quiet.close(), quiet._thread, stream.getvalue()) == (True, None, "")
