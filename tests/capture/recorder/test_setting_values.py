"""Values of a recording's settings, one by one: what is taken, and what is refused how."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from undulog.capture.common.errors import DataError, SettingsError
from undulog.capture.recorder import settings as module
from undulog.capture.recorder.settings import PARSERS, resolve

NEEDED = {"sources": ("can:virtual:a",), "output": "run.mcap"}
FACTS = "names with strings, e.g. place=tank; a name has letters, digits, _, - and ."
SOURCES = "one or more different source addresses, e.g. can:socketcan:can0"


def refused(name, value):
    """What a setting would take instead of a value."""
    with pytest.raises(DataError) as caught:
        PARSERS[name](value)
    return str(caught.value)


# -- parsers ---------------------------------------------------------------------------------------


def test_flags_are_spelt_in_four_ways():
    for words, expected in ((("true", "1", "YES", "On", True), True),
                          (("false", "0", "No", "oFF", False), False)):  # fmt: skip
        assert [PARSERS["live"](word) for word in words] == [expected] * 5
    for odd in ("", "2", "truefalse", 1, 0, None, ["true"]):
        assert refused("live", odd) == "true or false"


def test_texts_of_one_line_and_of_several():
    assert PARSERS["notes"]("a\nb ") == "a\nb "
    assert PARSERS["notes"]("") == ""
    assert PARSERS["operator"](" ann ") == " ann "
    for odd in (1, None, True, ["a"]):
        assert refused("notes", odd) == refused("operator", odd) == "a string"
    for odd in ("", " \t", "a\nb", "\n"):
        assert refused("operator", odd) == "a string, not empty, on one line"


def test_paths():
    for name in ("socket", "output"):
        assert PARSERS[name]("a/b.mcap") == PARSERS[name](Path("a/b.mcap")) == Path("a/b.mcap")
        for odd in ("", "a\0b.mcap", 1, None, b"a.mcap"):
            assert refused(name, odd) == "a path"
    assert PARSERS["output"]("A.MCAP") == Path("A.MCAP")
    for odd in ("a", "a.mcap.part", "mcap", Path("a.json")):
        assert refused("output", odd) == "a file that ends in .mcap"


def test_sources_are_different_addresses():
    assert PARSERS["sources"](["a:1", "b:2"]) == PARSERS["sources"]("a:1 'b:2'") == ("a:1", "b:2")
    assert PARSERS["sources"](("a:1",)) == ("a:1",)
    for odd in ((), [], "", ("a:1", "a:1"), ("a:1", "b")):
        assert refused("sources", odd) == SOURCES
    for odd in (7, None, ["a:1", 2], {"a": 1}):
        assert refused("sources", odd) == "an array of strings"
    assert refused("sources", "'a:1") == "words with every quote closed"


def test_facts_are_a_table_or_words():
    assert PARSERS["metadata"]({"a.B-1_c": ""}) == {"a.B-1_c": ""}
    assert PARSERS["metadata"]("a=1 'b=x = y' c=") == {"a": "1", "b": "x = y", "c": ""}
    assert PARSERS["metadata"](()) == PARSERS["metadata"]({}) == {}
    for odd in (("a",), ("a=1", "b"), {"a": 1}, {1: "a"}, {"1a": "x"}, {"": "x"}, {"a b": "x"},
                {"a\n": "x"}, ("é=1",), ("=1",)):  # fmt: skip
        assert refused("metadata", odd) == FACTS
    assert refused("metadata", ("a=1", "b=2", "a=3")) == "each name once"
    facts = PARSERS["metadata"]({"a": "1"})
    with pytest.raises(TypeError):
        facts["a"] = "2"


@pytest.mark.parametrize(
    ("name", "least", "below", "valid"),
    [
        ("duration", "1ms", "999us", "a duration of at least 1ms"),
        ("split_time", "1s", "999.999ms", "a duration of at least 1s"),
        ("ring", 1, 0.999, "a duration of at least 1s"),
        ("split_size", "1MB", 999_999, "a size of at least 1MB"),
    ],
)
def test_amounts_have_a_least_value(name, least, below, valid):
    assert PARSERS[name](least) == {"duration": 0.001, "split_size": 1_000_000}.get(name, 1.0)
    assert refused(name, below) == valid


# -- together --------------------------------------------------------------------------------------


def faults_of(cli, environ=None, file=None):
    with pytest.raises(SettingsError) as caught:
        resolve(cli, environ or {}, file)
    return [(fault.key, fault.actual, fault.valid) for fault in caught.value.faults]


def test_what_is_missing_is_said_and_what_a_ring_excludes():
    missing = [
        ("sources", "nothing", "at least one, e.g. can:socketcan:can0"),
        ("output", "nothing", "a file, e.g. --output run.mcap"),
    ]
    assert faults_of({}) == missing
    assert faults_of({"sources": (), "output": None}) == missing
    assert faults_of({"output": "a.mcap"}) == missing[:1]
    assert faults_of({"sources": ("a:1",)}) == missing[1:]
    left_out = "leave it out: a ring writes only what is marked"
    parts = {"split_time": "10s", "split_size": "1GB"}
    assert faults_of(NEEDED | {"ring": "5s"} | parts) == [
        ("--split-size", '"1GB"', left_out), ("--split-time", '"10s"', left_out),
    ]  # fmt: skip
    environ = {"UNDULOG_RECORD_SPLIT_TIME": "10s"}
    assert faults_of(NEEDED | {"ring": "5s"}, environ) == [
        ("UNDULOG_RECORD_SPLIT_TIME", '"10s"', left_out)
    ]
    assert resolve(NEEDED | parts, {}).split_time_s == 10.0
    assert resolve(NEEDED | {"ring": "5s"}, {}).ring_s == 5.0


def test_faults_of_a_file_and_of_the_environment_have_their_place(tmp_path):
    file = tmp_path / "x.toml"
    for text, expected in (
        (b"[record]\nlive = 3", [(f"{file}: record.live", "3", "true or false")]),
        (b"record = 5", [(f"{file}: record", "5", "a table")]),
        (b"[records]\n[record]", [(f"{file}: records", "an unknown key", "one table, [record]")]),
        (b"a = '\xff'", [(f"{file}: byte 5", "not UTF-8", "TOML is UTF-8 text")]),
    ):
        file.write_bytes(text)
        assert faults_of(NEEDED, {}, file) == expected
    file.write_bytes(b"[record")
    ((key, _, valid),) = faults_of(NEEDED, {}, file)
    assert (key, valid) == (f"{file}: syntax", "TOML 1.0")
    environ = {"UNDULOG_RECORD_LIVE": "2", "UNDULOG_RECORD_": "x", "OTHER": "y"}
    (unknown, live) = faults_of(NEEDED, environ)
    assert unknown[:2] == ("UNDULOG_RECORD_", "an unknown variable")
    assert live == ("UNDULOG_RECORD_LIVE", '"2"', "true or false")


def test_a_wrong_value_that_another_layer_overrides_is_a_fault_all_the_same(tmp_path):
    file = tmp_path / "x.toml"
    file.write_text('[record]\nlive = "maybe"\n')
    assert faults_of(NEEDED | {"live": True}, {"UNDULOG_RECORD_LIVE": "yes"}, file) == [
        (f"{file}: record.live", '"maybe"', "true or false")
    ]
    file.write_text("[record]\nlive = true\n")
    settings = resolve(NEEDED, {"UNDULOG_RECORD_SETTINGS": "/none"}, file)
    assert (settings.live, settings.origin["live"]) == (True, str(file))
    assert settings.origin["sources"] == "command line"


def test_the_time_in_the_output_is_that_of_the_whole_second(monkeypatch):
    for now_ns, expected in (
        (0, "19700101T000000Z"), (999_999_999, "19700101T000000Z"),
        (1_769_903_940_999_999_999, "20260131T235900Z"), (10**9, "19700101T000001Z"),
    ):  # fmt: skip
        settings = resolve(NEEDED | {"output": "{time}/a-{time}.mcap"}, {}, now_ns=now_ns)
        assert settings.output == Path(f"{expected}/a-{expected}.mcap")
    monkeypatch.setattr(module, "time", SimpleNamespace(time_ns=lambda: 86_400 * 10**9))
    now = resolve(NEEDED | {"output": "{time}.mcap"}, {}).output
    assert now == Path("19700102T000000Z.mcap")


def test_only_a_robot_that_a_file_names_is_looked_for_beside_it(tmp_path):
    (tmp_path / "mine.toml").write_text("")
    (tmp_path / "folder").mkdir()
    file = tmp_path / "x.toml"
    for name, is_file in (("mine.toml", True), ("none.toml", False), ("folder", False)):
        file.write_text(f'[record]\nrobot = "{name}"\n')
        expected = str(tmp_path / name) if is_file else name
        assert resolve(NEEDED, {}, file).robot == expected
        assert resolve(NEEDED, {"UNDULOG_RECORD_ROBOT": name}, file).robot == name
