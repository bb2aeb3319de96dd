"""Settings of a recording: exact amounts, layers in order, every fault at once."""

import itertools
import json
import math
import re
import shutil
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.paths import DOCS
from support.processes import run
from undulog.capture.common.amounts import (
    DURATION_UNITS,
    SIZE_UNITS,
    format_size,
    parse_duration_ns,
    parse_size,
)
from undulog.capture.common.errors import DataError, InputFileError, SettingsError
from undulog.capture.recorder.settings import DEFAULT_FLOOR, ENVIRONMENT_PREFIX, PARSERS, resolve

MANUAL = DOCS / "how-to/recording.md"
NEEDED = {"sources": ("can:virtual:a",), "output": "run.mcap"}


# -- amounts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["0", "7", "500kB", "500MB", "1.5GB", "2TB", "1KiB", "512MiB", "1.25GiB", "3TiB"]
)
def test_sizes_are_those_of_numfmt(text):
    """Against coreutils, which spells the same with K, M, G, T and Ki, Mi, Gi, Ti."""
    foreign = text.removesuffix("B").replace("k", "K")
    system = "iec-i" if foreign.endswith("i") else "si"
    assert parse_size(text) == int(run("numfmt", f"--from={system}", foreign).stdout)


@pytest.mark.parametrize("text", ["30s", "10min", "1h30min", "2d 3h", "1.5h", "20ms", "1min 2.5s"])
def test_durations_are_those_of_systemd(text):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on the path")
    done = run("systemd-analyze", "timespan", text)
    microseconds = int(done.stdout.split("s: ", 1)[1].split()[0])
    assert parse_duration_ns(text) == 1000 * microseconds


@given(st.integers(0, 10**6), st.integers(0, 999), st.sampled_from(sorted(SIZE_UNITS)))
def test_a_size_is_exact_or_refused(whole, thousandths, unit):
    exact = (whole + Fraction(thousandths, 1000)) * SIZE_UNITS[unit]
    text = f"{whole}.{thousandths:03d}{unit}"
    if exact.denominator == 1 and exact <= 2**62:
        assert parse_size(text) == parse_size(f" {whole}.{thousandths:03d} {unit} ") == exact
    else:
        with pytest.raises(DataError):
            parse_size(text)


@given(st.dictionaries(st.sampled_from(sorted(DURATION_UNITS)), st.integers(0, 10**4), min_size=1))
def test_a_duration_is_the_sum_of_its_parts_in_falling_order(parts):
    order = sorted(parts, key=DURATION_UNITS.__getitem__, reverse=True)
    text = "".join(f"{parts[unit]}{unit}" for unit in order)
    assert parse_duration_ns(text) == sum(n * DURATION_UNITS[unit] for unit, n in parts.items())
    if len(order) > 1:
        with pytest.raises(DataError, match="longest first"):
            parse_duration_ns("".join(f"{parts[unit]}{unit}" for unit in reversed(order)))


@given(st.floats(0, 1e6).map(lambda x: round(x, 6)))
def test_a_bare_number_is_seconds(seconds):
    if "e" not in repr(seconds):
        assert parse_duration_ns(seconds) == round(Fraction(repr(seconds)) * 10**9)


NO_DURATIONS = ("1h, 2s", math.nan, math.inf, None, "")


@pytest.mark.parametrize(
    ("parse", "value", "hint"),
    [
        (parse_size, "500mb", "did you mean MB"),
        (parse_size, "1gib", "did you mean GiB"),
        (parse_size, "10s", "a size in B, kB"),
        (parse_size, "0.5B", "whole number of bytes"),
        *((parse_size, x, "a size such as") for x in (-1, "-5MB", True, 10**40, "9" * 100)),
        (parse_size, "1e9", "a size"),
        (parse_size, "99999999TB", "2^62"),
        (parse_duration_ns, "10m", "did you mean min"),
        (parse_duration_ns, "10Min", "did you mean min"),
        (parse_duration_ns, "5MB", "a time in d, h, min"),
        (parse_duration_ns, "1h 1h", "each unit once"),
        (parse_duration_ns, "0.5ns", "whole number of nanoseconds"),
        *((parse_duration_ns, x, "a duration such as") for x in NO_DURATIONS),
    ],
)
def test_what_is_no_amount_is_refused_with_what_would_be(parse, value, hint):
    with pytest.raises(DataError, match=re.escape(hint)):
        parse(value)


@given(st.integers(0, 9 * 10**14))
def test_a_size_as_shown_reads_back_within_its_digits(size):
    assert parse_size(format_size(size)) == pytest.approx(size, rel=5.1e-3)


# -- layers --------------------------------------------------------------------------------------

GOOD = {  # three different values a setting: for the file, the environment, the command line
    "sources": (["a:1"], "b:1 'c:2 3'", ("d:1",)),
    "robot": ("snake25", "snake13", "arcsnake-joint"),
    "bus": ("can0", "rear", "front"),
    "output": ("a.mcap", "b.mcap", Path("c.mcap")),
    "force": (True, "no", True),
    "duration": ("1h30min", "90", 2.5),
    "split_size": ("1GiB", "500MB", 1_000_000),
    "split_time": ("10min", "60", "2min"),
    "ring": ("30s", "31", "1min"),
    "floor": (0, "2GB", "1KiB"),
    "socket": ("/a.sock", "/b.sock", Path("/c.sock")),
    "live": (True, "off", True),
    "operator": ("ann", "bob", "cid"),
    "notes": ("", "wet sand", "dry\nsand"),
    "metadata": ({"place": "a"}, "place=b 'x=1 = 2'", ("place=c",)),
    "fast": (True, "0", True),
    "quiet": (True, "False", True),
}


def toml(table):
    """TOML text of a flat table: its strings and arrays are spelt as in JSON."""

    def text(value):
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{key} = {text(entry)}" for key, entry in value.items()) + " }"
        return json.dumps(value)

    return "[record]\n" + "".join(f"{key} = {text(value)}\n" for key, value in table.items())


@pytest.mark.parametrize("name", sorted(GOOD))
@pytest.mark.parametrize("present", list(itertools.product([False, True], repeat=3)))
def test_the_command_line_beats_the_environment_beats_the_file(tmp_path, name, present):
    in_file, in_environment, in_command = GOOD[name]
    if name in NEEDED and not any(present):
        return
    file = tmp_path / "snake.toml"
    file.write_text(toml({name: in_file} if present[0] else {}))
    environ = {f"UNDULOG_RECORD_{name.upper()}": in_environment} if present[1] else {}
    cli = NEEDED | {name: in_command if present[2] else None}
    settings = resolve(cli, {"PATH": "/bin", **environ}, file)
    winner = max((i for i in range(3) if present[i]), default=3)
    assert settings.origin[name] == ((str(file), "environment", "command line", "default"))[winner]
    if any(present):
        attribute = f"{name}_s" if name in {"duration", "split_time", "ring"} else name
        assert getattr(settings, attribute) == PARSERS[name](GOOD[name][winner])


def test_every_setting_is_tested_and_the_docstring_s_example_holds_all(tmp_path):
    from undulog.capture.recorder import settings as module

    assert set(GOOD) == set(PARSERS)
    text = module.__doc__.split("A file::\n", 1)[1].split("Required are", 1)[0]
    body = "\n".join(line.strip() for line in text.splitlines())
    for ring in (True, False):  # a ring and parts exclude each other
        lines = [x for x in body.splitlines() if not x.startswith("split" if ring else "ring")]
        (tmp_path / "x.toml").write_text("\n".join(lines))
        settings = resolve({}, {}, tmp_path / "x.toml", now_ns=1_769_903_940 * 10**9)
        assert str(settings.output) == "run-20260131T235900Z.mcap"
        assert settings.metadata == {"place": "tank 2"}
        left = {"split_size", "split_time"} if ring else {"ring"}
        assert {name for name in PARSERS if settings.origin[name] == "default"} == left


@pytest.mark.skipif(not MANUAL.is_file(), reason="the manual is not here")
def test_the_manual_s_example_works_and_its_table_has_every_setting(tmp_path):
    text = MANUAL.read_text().split("## Control", 1)[0]
    (tmp_path / "snake.toml").write_text(text.split("```toml\n", 1)[1].split("```", 1)[0])
    assert resolve({"operator": "ann"}, {}, tmp_path / "snake.toml").split_time_s == 600.0
    rows = "".join(line.split("|")[1] for line in text.splitlines() if line.startswith("| `"))
    assert set(re.findall(r"`(\w+)`", rows)) == set(PARSERS)


def test_defaults():
    settings = resolve(NEEDED, {})
    assert settings.floor == DEFAULT_FLOOR == 500_000_000
    assert settings.robot is settings.ring_s is settings.split_size is settings.duration_s is None
    assert not settings.live
    assert settings.sources == ("can:virtual:a",)
    assert settings.output == Path("run.mcap")


def test_the_environment_may_name_the_file(tmp_path):
    (tmp_path / "x.toml").write_text(toml({"operator": "ann"}))
    assert resolve(NEEDED, {"UNDULOG_RECORD_SETTINGS": str(tmp_path / "x.toml")}).operator == "ann"


def test_a_robot_beside_the_settings_file_is_found_there(tmp_path):
    (tmp_path / "mine.toml").write_text("")
    (tmp_path / "x.toml").write_text(toml({"robot": "mine.toml"}))
    assert resolve(NEEDED, {}, tmp_path / "x.toml").robot == str(tmp_path / "mine.toml")
    assert resolve({**NEEDED, "robot": "mine.toml"}, {}, tmp_path / "x.toml").robot == "mine.toml"


# -- faults --------------------------------------------------------------------------------------


def test_all_faults_of_all_layers_are_reported_at_once(tmp_path):
    file = tmp_path / "x.toml"
    file.write_text('[record]\nsplit_sise = "1GB"\nduration = 5\nfloor = "1gb"\n[other]\n')
    environ = {"UNDULOG_RECORD_RNIG": "30s", "UNDULOG_RECORD_LIVE": "maybe"}
    environ["UNDULOG_RECORDS"] = "none of ours"
    with pytest.raises(SettingsError) as refused:
        resolve({"ring": "10m", "sources": (), "output": "run.log"}, environ, file)
    text = str(refused.value)
    assert refused.value.exit_code == 2
    assert text.startswith("8 faults in the settings")
    in_file = {f"{file}: {key}" for key in ("other", "record.split_sise", "record.floor")}
    given = {"UNDULOG_RECORD_RNIG", "UNDULOG_RECORD_LIVE", "--output", "--ring", "sources"}
    assert {fault.key for fault in refused.value.faults} == in_file | given
    for name in ("UNDULOG_RECORD_RING", "split_size", "GB"):
        assert f"did you mean {name}?" in text


BAD = dict.fromkeys(PARSERS, ()) | {
    "sources": (["a:1", "a:1"], [1], ("statsu",), "'open"),
    "output": ("run.log",),
    "force": (1,),
    "duration": (0,),
    "split_size": ("10kB",),
    "split_time": ("1ms",),
    "ring": ("0s",),
    "floor": (-1,),
    "operator": (" ", "two\nlines"),
    "metadata": (("place",), ("a=1", "a=2"), {"a": 1}, {"a b": "x"}),
    "socket": ("",),
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name in BAD for value in (7j, *BAD[name])]
)
def test_a_bad_value_is_a_fault_of_its_option(name, value):
    with pytest.raises(SettingsError) as refused:
        resolve({**NEEDED, name: value}, {})
    (fault,) = refused.value.faults
    assert fault.key == ("SOURCE" if name == "sources" else f"--{name.replace('_', '-')}")


def test_a_ring_and_parts_exclude_each_other():
    with pytest.raises(SettingsError, match='--split-size: found "1GB"; valid: leave it out'):
        resolve({**NEEDED, "ring": "30s", "split_size": "1GB"}, {})


def test_what_is_missing_is_named():
    with pytest.raises(SettingsError) as refused:
        resolve({}, {})
    assert [fault.key for fault in refused.value.faults] == ["sources", "output"]


@pytest.mark.parametrize(
    "text", [b"\xff[record]", b"[record", b"record = 1", b"x = 1" + b"0" * 5000]
)
def test_a_file_that_is_no_settings_file_is_a_fault(tmp_path, text):
    (tmp_path / "x.toml").write_bytes(text)
    with pytest.raises(SettingsError, match=r"x\.toml: "):
        resolve(NEEDED, {}, tmp_path / "x.toml")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputFileError, match=r"none\.toml: no such file"):
        resolve(NEEDED, {}, tmp_path / "none.toml")
    with pytest.raises(InputFileError, match="can't be read: Is a directory"):
        resolve(NEEDED, {}, tmp_path)


def test_a_name_that_no_setting_has_is_a_mistake_of_the_caller():
    with pytest.raises(TypeError, match="split_size_bytes"):
        resolve({**NEEDED, "split_size_bytes": 1}, {})
    assert ENVIRONMENT_PREFIX == "UNDULOG_RECORD_"
