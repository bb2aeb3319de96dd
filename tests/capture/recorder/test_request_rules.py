"""Requests at their limits, without a socket: times, lengths and letters of texts, replies."""

import re

import pytest

from support.read_back import decoded_of
from undulog.capture.common.errors import ControlError
from undulog.capture.log.write.writer import SessionWriter
from undulog.capture.recorder.control_requests import GAIT_NAMES, RequestHandler

EPOCH_NS = 1_700_000_000_000_000_000
HOUR_NS = 3600 * 10**9


class Actions:
    """A recorder that notes what is requested of it, and gives the text of a mark back."""

    def __init__(self):
        self.stops = 0

    def mark(self, text):
        return {"text": text}

    def split(self):
        return {"part": 7}

    def stop(self):
        self.stops += 1


class Stage:
    """A handler of a real session; what it writes to ``/rosout`` is in ``events``."""

    def __init__(self, path):
        self.path, self.actions, self.events, self.now_ns = path, Actions(), [], EPOCH_NS
        self.writer = SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS)
        self.handler = RequestHandler(
            self.actions, self.writer, lambda *event: self.events.append(event), lambda: self.now_ns
        )

    def ask(self, do, **keys):
        return self.handler({"do": do, **keys})

    def refused(self, do, **keys):
        """The text with which a request is refused."""
        with pytest.raises(ControlError) as caught:
            self.ask(do, **keys)
        return str(caught.value)

    def read(self):
        self.writer.close()
        return [content for *_, content in decoded_of(self.path)]


@pytest.fixture
def stage(tmp_path):
    stage = Stage(tmp_path / "run.mcap")
    yield stage
    stage.writer.close()


# -- gaits -----------------------------------------------------------------------------------------


def test_the_time_of_a_gait_is_within_an_hour_of_the_recorder_s(stage):
    for off_ns in (HOUR_NS, -HOUR_NS):
        assert stage.ask("gait", values={"a.b": 1}, t_ns=EPOCH_NS + off_ns) == {}
        far = EPOCH_NS + off_ns + (1 if off_ns > 0 else -1)
        off_s = "+3600" if off_ns > 0 else "-3600"
        assert stage.refused("gait", values={"a.b": 1}, t_ns=far) == (
            f"t_ns: found {far}, {off_s} s off this recorder's clock; valid: Unix time in ns"
        )
    times = [message.header.stamp.sec for message in stage.read()]
    assert times == [EPOCH_NS // 10**9 + 3600, EPOCH_NS // 10**9 - 3600]


def test_the_planes_have_five_values_each_and_further_names_two_words_at_least(stage):
    assert [name.partition(".")[2] for name in GAIT_NAMES] == [
        "A", "omega", "lag", "offset", "phase",
    ] * 2  # fmt: skip
    assert [name.partition(".")[0] for name in GAIT_NAMES] == ["horizontal"] * 5 + ["vertical"] * 5
    for name in (
        "joint03",
        "joint03.",
        ".A",
        "3.A",
        "a b.c",
        "a.é",
        "é.a",
        "horizontal.B",
        "a.b\n",
    ):
        assert stage.refused("gait", values={name: 1.0}).startswith("values: found ")
    names = ("a.b", "a-b_3.c-d.e_4", "Z.0", *reversed(GAIT_NAMES))
    stage.ask("gait", values={name: float(k) for k, name in enumerate(names)})
    (message,) = stage.read()
    assert list(message.name) == [*GAIT_NAMES, *names[:3]]
    assert list(message.position) == [float(k) for k in (*reversed(range(3, 13)), 0, 1, 2)]


def test_names_of_a_later_gait_are_those_of_the_first_in_any_order(stage):
    stage.ask("gait", values={"x.a": 1.0, "vertical.A": 2.0})
    stage.now_ns += 5
    stage.ask("gait", values={"vertical.A": 4.0, "x.a": 3.0})
    for values in ({"x.a": 1.0}, {"x.a": 1.0, "vertical.A": 2.0, "x.b": 3.0}):
        assert stage.refused("gait", values=values) == (
            f"values: found {', '.join(values)}; valid: vertical.A, x.a, the names that this "
            "session's gait began with"
        )
    assert [list(message.position) for message in stage.read()] == [[2.0, 1.0], [4.0, 3.0]]


@pytest.mark.parametrize("t_ns", [True, 1.5, "1"])
def test_a_time_is_a_whole_number(stage, t_ns):
    text = stage.refused("gait", values={"a.b": 1.0}, t_ns=t_ns)
    assert text.endswith("; valid: Unix time in ns, a whole number")
    assert stage.read() == []


# -- texts -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("x" * 4096, None),
        ("x" * 4097, "text of at most 4096 characters"),
        ("\ud7ff\ue000\U0010ffff\x01", None),
        ("a\ud800", "text of at most 4096 characters"),  # the first half of a pair, and the last
        (chr(0xDFFF), "text of at most 4096 characters"),
        ("a\0b", "text of at most 4096 characters"),
        ("", "text that is not empty"),
        (" \n", "text that is not empty"),
        (7, "text of at most 4096 characters"),
    ],
)
def test_which_texts_a_message_can_hold(stage, text, why):
    if why is None:
        assert stage.ask("note", text=text, level="error") == {}
        assert stage.ask("mode", text=text) == {}
        assert stage.events == [("error", "operator", text)]
        assert [message.data for message in stage.read()] == [text]
    else:
        assert stage.refused("note", text=text).endswith(f"; valid: {why}")
        assert stage.refused("mode", text=text).endswith(f"; valid: {why}")
        assert (stage.events, stage.read()) == ([], [])


def test_a_mark_may_be_empty_and_a_level_is_info_by_default(stage):
    assert stage.ask("mark") == {"text": ""}
    assert stage.ask("mark", text=" ", level="warn") == {"text": " "}
    assert stage.ask("mark", text="x") == {"text": "x"}
    stage.ask("note", text="y")
    assert stage.events == [
        ("info", "operator", "mark"), ("warn", "operator", "mark:  "),
        ("info", "operator", "mark: x"), ("info", "operator", "y"),
    ]  # fmt: skip
    for level in ("debug", "fatal", "", 20, None):
        assert stage.refused("note", text="x", level=level).startswith("level: found ")


def test_who_waits_for_the_end_gets_no_reply_before_it(stage):
    assert stage.ask("stop", wait=True) is None
    assert stage.ask("stop", wait=False) == stage.ask("stop") == {}
    assert stage.actions.stops == 3
    for wait in (1, "yes", None):
        assert "valid: true or false" in stage.refused("stop", wait=wait)
    assert stage.actions.stops == 3


def test_each_request_has_its_own_keys(stage):
    keys = {"text": "x", "level": "info", "wait": False, "values": {"a.b": 1}, "t_ns": EPOCH_NS}
    keys_of = {
        "status": set(), "split": set(), "mark": {"text", "level"}, "note": {"text", "level"},
        "stop": {"wait"}, "gait": {"values", "t_ns"}, "mode": {"text"},
    }  # fmt: skip
    for do, needed in keys_of.items():
        for key in keys.keys() - needed:
            given = {name: keys[name] for name in needed} | {key: keys[key]}
            assert stage.refused(do, **given).startswith(f"{key}: found ")
    assert stage.ask("split") == {"part": 7}
    assert (stage.events, stage.actions.stops) == ([], 0)


@pytest.mark.parametrize("length", [78, 79, 400])
def test_what_was_found_is_shown_with_80_letters_at_most(stage, length):
    text = stage.refused("note", text="x", level="y" * length)
    (shown,) = re.findall("^level: found (.*); valid: ", text)
    whole = '"' + "y" * length + '"'
    assert shown == (whole if length == 78 else whole[:77] + "...")
