"""Damaged foreign logs: an import ends in a session or in an error of ours that names the file."""

import random
import sqlite3

import can
import pytest

from support.imported import import_can, open_mapped
from support.written_frames import log_messages
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import UndulogError
from undulog.capture.exchange.column_map import column_map_from_options
from undulog.capture.exchange.table_import import import_tables

SUFFIXES = (".log", ".asc", ".blf", ".trc", ".csv", ".db")
LARGE = ("1e308", "-1e308", "1e19", "1e999999999", "9" * 400)
NUMBERS = ("nan", "inf", "-inf", *LARGE, "-1", "", "\0", "0x", "é")
SIMILAR = ("-inf", "-1e308", "1e999999999", "0x")
"""Fail where others of the numbers fail."""
CASES = 40


MESSAGES = [
    can.Message(
        timestamp=1_700_000_000 + 0.01 * k,
        arbitration_id=0x140 + k % 4,
        is_extended_id=k % 7 == 0,
        data=bytes(range(k % 9)),
        channel=k % 2,
        is_rx=k % 3 > 0,
    )
    for k in range(60)
]


@pytest.fixture(scope="module")
def robot():
    return load_robot("arcsnake-joint")


@pytest.fixture(scope="module")
def traces(tmp_path_factory):
    folder = tmp_path_factory.mktemp("traces")
    return {s: log_messages(folder / f"run{s}", MESSAGES).read_bytes() for s in SUFFIXES}


def mutated(data, rng, *, text):
    """One to three changes: bytes, a cut, a piece twice, a number that is none or too large."""
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(5)
        if kind == 0:
            data = data[:at] + rng.randbytes(rng.randint(1, 8)) + data[at + 4 :]
        elif kind == 1:
            data = data[:at]
        elif kind == 2:
            data = data[:at] + data[at // 2 :]
        elif text:
            words = data.split(b" " if b"," not in data else b",")
            words[rng.randrange(len(words))] = rng.choice(NUMBERS).encode()
            data = (b" " if b"," not in data else b",").join(words)
        else:
            width = rng.choice((1, 2, 4, 8))
            value = rng.choice((b"\xff" * width, b"\0" * width, b"\x7f" + b"\xff" * (width - 1)))
            data = data[:at] + value + data[at + width :]
    return data


def refusal(work):
    """The error of ours that some work ends in; None if it is done."""
    try:
        work()
    except UndulogError as error:
        return str(error)
    return None


def imported(path, robot):
    """Import; a session that came of it can be read."""
    output = path.with_suffix(".mcap")
    why = refusal(lambda: import_can(path, output, robot, force=True))
    if why is None:
        with Session.open(output) as session:
            assert session.channels
    assert why is None or str(path) in why


BINARY = (".blf", ".db")
"""Each import starts a process."""
MARKS = {".blf": pytest.mark.nightly, ".db": pytest.mark.nightly}


@pytest.mark.parametrize("suffix", [pytest.param(s, marks=MARKS.get(s, ())) for s in SUFFIXES])
def test_mutated_traces_end_in_a_session_or_an_error_of_ours(suffix, traces, robot, tmp_path):
    for seed in range(CASES):
        rng = random.Random(f"{suffix} {seed}")
        path = tmp_path / f"{seed}{suffix}"
        path.write_bytes(mutated(traces[suffix], rng, text=suffix not in BINARY))
        imported(path, robot)


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [pytest.param(n, marks=pytest.mark.nightly) if n in SIMILAR else n for n in NUMBERS],
)
@pytest.mark.parametrize("suffix", [".asc", ".trc", ".csv", ".log"])
def test_each_odd_number_in_a_text(suffix, number, traces, robot, tmp_path):
    lines = traces[suffix].decode().split("\n")
    separator = "," if suffix == ".csv" else " "
    whole = lines[-10].split(separator)
    for column in range(len(whole)):
        odd = f"({number})" if suffix == ".log" and not column else number
        lines[-10] = separator.join([*whole[:column], odd, *whole[column + 1 :]])
        path = tmp_path / f"{column}{suffix}"
        path.write_text("\n".join(lines))
        imported(path, robot)


@pytest.mark.slow
@pytest.mark.parametrize(
    "value",
    [
        *(None, 2**62),
        *(
            pytest.param(v, marks=pytest.mark.nightly)
            for v in ("text", b"\xff", 1e308, float("inf"), -1)
        ),
    ],
)
def test_each_odd_value_in_a_database(value, traces, robot, tmp_path):
    columns = ("ts", "arbitration_id", "extended", "remote", "error", "dlc", "data")
    for column in columns:
        path = tmp_path / f"{column}.db"
        path.write_bytes(traces[".db"])
        with sqlite3.connect(path) as base:
            base.execute(f"UPDATE messages SET {column} = ? WHERE rowid = 30", (value,))
        base.close()
        imported(path, robot)


@pytest.mark.parametrize("cut", [0, 1, 15, 16, 100, 4000, 4096, 5000])
def test_a_database_cut_short(cut, traces, robot, tmp_path):
    path = tmp_path / "cut.db"
    path.write_bytes(traces[".db"][:cut])
    imported(path, robot)


@pytest.mark.parametrize("number", NUMBERS)
def test_odd_numbers_in_a_csv_of_columns(number, robot, tmp_path):
    name = robot.joint_names[0]
    for row in (f"{number},1.0", f"0.01,{number}", f"{number},{number}"):
        path = tmp_path / "a.csv"
        path.write_bytes(f"t,a\n0.0,0.5\n{row}\n0.03,0.25\n".encode())
        columns = column_map_from_options(["t=time:s", f"a={name}.position:rad"], robot)
        given = {"robot": robot, "column_map": columns, "force": True}
        why = refusal(
            lambda source=(path, columns), given=given: import_tables(
                open_mapped(*source), tmp_path / "a.mcap", **given
            )
        )
        assert why is None or str(path) in why
