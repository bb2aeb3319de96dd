"""Names in a log are untrusted: none reaches a terminal, a spreadsheet or a page as it is."""

import contextlib
import csv
import json
import math
import os
import pty
import re
import subprocess
import unicodedata
from html.parser import HTMLParser

import pytest
from mcap.writer import Writer
from rerun.chunk import RrdReader

import undulog
from support.paths import ROOT
from support.processes import UNDULOG
from support.written_sessions import joint_state
from undulog.capture.log.messages.cdr import encode
from undulog.capture.log.messages.definitions import message_type, schema_text

pytestmark = pytest.mark.slow

EPOCH_NS = 1_700_000_000_000_000_000
JOINT_STATE = "sensor_msgs/msg/JointState"
FORGED = "FORGED good: all joints follow"
TITLE = "\x1b]0;owned\x07"
CLIPBOARD = "\x1b]52;c;cm0gLXJmIC8=\x07"
CLEAR = "\x1b[2J\x1b[H"
NAMES = (
    f"j1{TITLE}",
    f"j2{CLIPBOARD}",
    f"j3{CLEAR}",
    f"j4\r{FORGED}",
    f"j5\n{FORGED}",
    f"j6\x9b31m\x85{FORGED}",
    f"j7\u2028{FORGED}\u202edrawkcab",
    "j8[/][bold red]**x**](javascript:alert(1))<script>alert(1)</script>|\n\n# FORGED",
    "=cmd|' /C calc'!A0",
    "../../j10/[0]:\\ ",
)
TOPICS = (f"/t1{TITLE}", f"/t2{CLIPBOARD}\n{FORGED}", "/t3\r\x1b[2K[/]<b>")


COMMANDS = (
    "log info A",
    "log check A",
    "log cut A -o cut.mcap --stop 5",
    "log merge A B -o merged.mcap",
    "log recover A -o whole.mcap",
    "log export A -o table.csv",
    "log export A -o frames.log",
    "analyse A",
    "analyse A B",
    "analyse A --command-topic N",
    "compare A B",
    "report A -o page.html",
    "view A --save a.rrd",
    "view A B --save ab.rrd",
    "sim run N",
    "record N -o x.mcap",
    "N",
    "log N",
    "--N",
)


def write_hostile(path, *, seconds=12.0, session_id=f"s{CLEAR}"):
    """Write the session: joints that follow their commands, with the names above.

    Args:
        path: The file.
        seconds: Its duration [s].
        session_id: Of its metadata.

    Returns:
        The file.
    """
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library=f"lib{TITLE}\n{FORGED}")
        facts = {"id": session_id, "robot": f"r{CLEAR}", "verdict": f"good{TITLE}\n{FORGED}"}
        writer.add_metadata("undulog", facts)
        writer.add_metadata(f"m{TITLE}\n{FORGED}", {f"k{CLEAR}": f"v{CLEAR}"})
        writer.add_attachment(1, 2, f"a{CLIPBOARD}\n{FORGED}", f"t{TITLE}", b"x")
        states = writer.register_schema(JOINT_STATE, "ros2msg", schema_text(JOINT_STATE).encode())
        other = writer.register_schema(f"x/msg/Y{TITLE}\n{FORGED}", f"e{CLEAR}", b"?")
        topics = ("/joint_commands", "/joint_states", *TOPICS[:2])
        unit = {"unit": f"rad{TITLE}\n{FORGED}"}
        pairs = zip(topics, ({}, {}, unit, unit), strict=True)
        channels = [writer.register_channel(t, "cdr", states, facts) for t, facts in pairs]
        odd = writer.register_channel(TOPICS[2], f"c{CLEAR}", other, unit)
        layout = message_type(JOINT_STATE)
        for tick in range(round(seconds * 50)):
            t_ns = EPOCH_NS + tick * 20_000_000
            for channel, lag in zip(channels, (0.0, 0.3, 0.3, 0.3), strict=True):
                phases = [2 * math.pi * tick / 50 - 0.5 * k - lag for k in range(len(NAMES))]
                message = joint_state(t_ns, list(NAMES), [0.4 * math.sin(x) for x in phases])
                message["header"]["frame_id"] = f"f{CLEAR}"
                writer.add_message(channel, t_ns, encode(layout, message), t_ns, tick)
            writer.add_message(odd, t_ns, b"?", t_ns, tick)
        writer.finish()
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("hostile")
    write_hostile(place / "a.mcap")
    write_hostile(place / "b.mcap", session_id="b")
    return place


def words(command):
    named = {"A": "a.mcap", "B": "b.mcap"}
    evil = f"n\x1b[2J\r{FORGED}\n{FORGED}"
    return [named.get(word, word.replace("N", evil)) for word in command.split()]


@pytest.fixture
def run(folder, capsys, monkeypatch):
    """Runs a command in this process, in the folder; returns its output and its errors."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("TERM", "xterm")

    def run(command, *more):
        undulog.run([*words(command), *more])
        return capsys.readouterr()

    return run


def forced(command):
    return ("--force",) if " -o " in command or "--save" in command else ()


def environment():
    return os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm"}


def raw(text):
    return {c for c in text if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")} - {"\n"}


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_prints_a_control_character_or_a_forged_line(run, command):
    for text in run(command, *(() if "N" in command else forced(command))):
        assert raw(text) == set()
        assert not re.search(rf"(?m)^(# )?{FORGED[:6]}", text)


@pytest.mark.parametrize("command", [x for x in COMMANDS if "N" not in x and "frames" not in x])
def test_json_is_one_value_and_keeps_the_names(run, command):
    out, _ = run(command, "--json", *forced(command))
    assert raw(out) == set()
    value = json.loads(out)
    if command == "analyse A":
        assert [joint["name"] for joint in value["joints"]] == list(NAMES)
    if command == "log info A":
        assert set(value["attachments"]) == {f"a\x1b]52;c;cm0gLXJmIC8=\x07\n{FORGED}"}


@pytest.mark.parametrize(
    "command",
    [
        "analyse A",
        pytest.param("compare A B", marks=pytest.mark.nightly),
        "log export A -o pty.csv",
    ],
)
def test_a_terminal_gets_styles_and_progress_only(folder, command):
    (folder / "pty.csv").unlink(missing_ok=True)
    ours, theirs = pty.openpty()
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    line = (*UNDULOG, *words(command))
    with subprocess.Popen(line, cwd=folder, env=environment(), **streams) as process:
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # Linux: the last one to hold the other end has left
            while part := os.read(ours, 65536):
                shown += part
    os.close(ours)
    assert process.returncode == 0
    # SGR, erase and move within the line of the progress bar, show and hide the cursor
    left = re.sub(r"\x1b\[(?:\d*(;\d+)*m|2K|1A|\?25[lh])", "", shown.decode())
    left = left.replace("\r\n", "\n").replace("\r", "")
    assert raw(left) == set()
    assert "\x1b[2J" not in shown.decode()
    assert b"\x1b]" not in shown


def test_spreadsheets_find_no_formula_and_names_come_back(folder, run):
    run("log export A -o names.csv")
    with (folder / "names.csv").open(newline="", encoding="utf-8") as stream:
        head, *rows = list(csv.reader(stream))
    texts = [*head, *(row[1] for row in rows), *(row[2] for row in rows)]
    assert not [text for text in texts if text[:1] in "=+-@\t\r\n"]
    assert {row[2].removeprefix("'") for row in rows} == set(NAMES)
    assert all(abs(float(row[3] or row[4])) <= 0.4 for row in rows)


def test_entities_and_documents_of_rerun_are_as_meant(folder, run):
    run("view A --save c.rrd")
    paths = {chunk.entity_path for chunk in RrdReader(folder / "c.rrd").stream().to_chunks()}
    assert not [path for path in paths if raw(path)]
    assert not {path.split("/")[1] for path in paths} & {"j10", "t1", ".."}


class _Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.seen = []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))


@pytest.mark.parametrize(
    "command", ["report A -o p.html", "report A B -o q.html", "compare A B -o r.html"]
)
def test_pages_have_no_markup_from_names(folder, run, command):
    run(command)
    text = (folder / command.split()[-1]).read_text()
    tags = _Tags()
    tags.feed(text)
    assert raw(text) <= {"\t"}
    assert "alert(1)" in text
    assert not [attr for tag, attrs in tags.seen for attr in attrs if attr.startswith("on")]
    assert not [a for _, a in tags.seen if "javascript:" in (a.get("href") or "")]
    assert text.count("<script>alert") == 0


def test_notebooks_show_names_as_text(folder, opened):
    from undulog.analysis.session.analyse import analyse_session

    shown = analyse_session(opened(folder / "a.mcap"))._repr_html_()
    assert "<script" not in shown
    assert "&lt;script&gt;" in shown
    assert raw(shown) == set()


def test_markdown_shows_names_as_text():
    from undulog.replay.draw.drawing import code, escaped

    assert escaped("[x](http://y)<b>*a*\n# h") == r"\[x\]\(http://y\)\<b\>\*a\*\\n\# h"
    assert code("a|b\n") == r"`a\|b\n`"
    assert code("a`<b>") == r"a\`\<b\>"
