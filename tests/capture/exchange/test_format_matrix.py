"""Every format of CAN frames, whatever the frames: exact, or counted as lost.

Two ways round: a session exported and imported again, and a trace of python-can's writers imported.
The truth is the frames that went in and the limits that each format documents.
"""

import itertools
import tempfile
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from support.imported import export_file as export_log
from support.imported import import_can
from support.written_frames import log_messages
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS
from undulog.capture.log.messages import frames as fr

T0 = 1_700_000_003_250_000_000
S = 1_000_000_000
BUSES = ("can0", "can1")
ROBOT = load_robot("snake13")


@dataclass(frozen=True, order=True)
class Frame:
    """One frame of the truth."""

    t_ns: int
    bus: str
    kind: str
    identifier: int
    extended: bool
    dlc: int
    data: bytes
    sent: bool


@st.composite
def frame(draw):
    kind = draw(st.sampled_from(["data", "data", "data", "remote", "error"]))
    extended = kind != "error" and draw(st.booleans())
    limit = 0x7FF if kind != "error" and not extended else 0x1FFF_FFFF
    dlc = draw(st.integers(0, 15) if kind == "data" else st.integers(0, 8))
    size = 0 if kind == "remote" else min(dlc, 8)
    t_ns = st.integers(0, 3_000_000_000) | st.integers(0, 3_000_000).map(lambda t: t * 1000)
    parts = (t_ns, st.sampled_from(BUSES), st.integers(0, limit), st.booleans())
    t_ns, bus, identifier, sent = draw(st.tuples(*parts))
    data = draw(st.binary(min_size=size, max_size=size))
    return Frame(t_ns, bus, kind, identifier, extended, dlc, data, sent)


def in_order(frames):
    """By time; those of one time keep the order of their buses, as a merge has it."""
    ordered = sorted(frames, key=lambda can_frame: (can_frame.t_ns, can_frame.bus))
    return [replace(can_frame, t_ns=T0 + can_frame.t_ns) for can_frame in ordered]


traces = st.lists(frame(), min_size=1, max_size=40).map(in_order)
BOTH = (False, True)
KINDS = itertools.product(BUSES, ("data", "remote", "error"), BOTH, (0, 5, 8), BOTH)
EVERY_KIND = in_order(
    Frame(k * 1_001_000, bus, kind, 0x7F, extended and kind != "error", dlc, b"\xa5" * size, sent)
    for k, (bus, kind, extended, dlc, sent) in enumerate(KINDS)
    for size in [0 if kind == "remote" else dlc]
)
COUNTS = [2, pytest.param(60, marks=pytest.mark.nightly)]


def each_trace(check, count):
    """Check so many drawn traces, and the trace with every kind of frame."""
    how = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow], "database": None}
    settings(max_examples=count, **how)(example(EVERY_KIND)(given(traces)(check)))()


def record_of(frames):
    array = fr.empty_frames(len(frames))
    for row, can_frame in zip(array, frames, strict=True):
        flags = {"data": 0, "remote": fr.REMOTE_FLAG, "error": fr.ERROR_FLAG}[can_frame.kind]
        row["t_host_ns"] = can_frame.t_ns
        row["id_flags"] = (
            can_frame.identifier | flags | (fr.EXTENDED_FLAG if can_frame.extended else 0)
        )
        row["dlc"], row["dir"] = can_frame.dlc, fr.DIR_TX if can_frame.sent else fr.DIR_RX
        row["data"][: len(can_frame.data)] = list(can_frame.data)
    return array


def frame_of(row, bus):
    flags = int(row["id_flags"])
    kind = "error" if flags & fr.ERROR_FLAG else "remote" if flags & fr.REMOTE_FLAG else "data"
    t_ns, dlc, data = int(row["t_host_ns"]), int(row["dlc"]), bytes(row["data"])
    size = 0 if kind == "remote" else min(dlc, 8)
    assert not any(data[size:])
    identifier, extended = flags & 0x1FFF_FFFF, bool(flags & fr.EXTENDED_FLAG)
    return Frame(t_ns, bus, kind, identifier, extended, dlc, data[:size], row["dir"] == fr.DIR_TX)


def session_of(path, frames):
    with SessionWriter(path, session_id="s", epoch_ns=T0) as writer:
        for bus in BUSES:
            of_bus = record_of([can_frame for can_frame in frames if can_frame.bus == bus])
            if len(of_bus):
                writer.frames(f"/can/{bus}").write(int(of_bus["t_host_ns"].max()), of_bus)
    return path


def frames_in(path):
    """The frames of a session by bus, each in its order."""
    with Session.open(path) as session:
        buses = [t.removeprefix("/can/") for t in session.channels if t.startswith("/can/")]
        return {b: [frame_of(row, b) for row in session.frames(f"/can/{b}")] for b in buses}


def imported(trace, folder):
    report = import_can(trace, folder / "back.mcap", ROBOT, force=True)
    return frames_in(folder / "back.mcap"), report


def by_bus(frames):
    split = defaultdict(list)
    for can_frame in frames:
        split[can_frame.bus].append(can_frame)
    return split


def by_kind(frames_of_bus):
    split = defaultdict(list)
    for bus, frames in frames_of_bus.items():
        for can_frame in frames:
            split[bus, can_frame.kind].append(can_frame)
    return split


def same_but_time(frames_by_bus, expected):
    timeless = (
        {bus: [replace(can_frame, t_ns=0) for can_frame in frames] for bus, frames in buses.items()}
        for buses in (frames_by_bus, expected)
    )
    assert next(timeless) == next(timeless)


def time_errors(frames_by_bus, expected, shift_ns=0):
    pairs = (zip(frames, expected[bus], strict=True) for bus, frames in frames_by_bus.items())
    return np.array(
        [can_frame.t_ns + shift_ns - truth.t_ns for bus in pairs for can_frame, truth in bus]
    )


# -- session -> export -> import -----------------------------------------------------------


def held_by_blf(can_frame):
    return replace(can_frame, sent=False) if can_frame.kind == "error" else can_frame


def held_by_asc(can_frame):
    kept = held_by_python_cans_asc(can_frame)
    return replace(kept, dlc=min(kept.dlc, 8))


def held_by_python_cans_asc(can_frame):
    if can_frame.kind == "error":
        return replace(can_frame, identifier=0, dlc=0, data=b"", sent=False)
    return can_frame


EXPORTED = {
    # suffix: what it holds of a frame, error of its time [ns]
    ".log": (lambda can_frame: can_frame, 0),
    ".blf": (held_by_blf, 1000),  # of floating-point seconds in the reader, rounded to 1 us
    ".asc": (held_by_asc, 500),
}
FIELDS = {
    "identifier": lambda can_frame: can_frame.identifier,
    "length code": lambda can_frame: can_frame.dlc,
    "data": lambda can_frame: can_frame.data,
    "direction": lambda can_frame: can_frame.sent,
}


def losses(frames, held, *, sub_us):
    """The sentences that must be reported, from the truth alone."""
    counts = Counter()
    for can_frame in frames:
        kept = held(can_frame)
        lost = {name for name, of in FIELDS.items() if of(can_frame) != of(kept)}
        # Data is compared as eight bytes: a loss of zeros is none.
        if "data" in lost and not any(can_frame.data) and not any(kept.data):
            lost.discard("data")
        if sub_us and can_frame.t_ns % 1000:
            lost.add("time below 1 us")
        counts.update((can_frame.kind, name) for name in lost)
    return sorted(
        f"1 {kind} frame loses its {name}" if n == 1 else f"{n} {kind} frames lose their {name}"
        for (kind, name), n in counts.items()
    )


def exported_and_imported(suffix, frames):
    held, error_ns = EXPORTED[suffix]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trace = folder / f"x{suffix}"
        report = export_log(session_of(folder / "run.mcap", frames), trace)
        back, _ = imported(trace, folder)
    expected = by_bus([held(can_frame) for can_frame in frames])
    assert report.facts["buses"] == {bus: len(of_bus) for bus, of_bus in by_bus(frames).items()}
    assert sorted(report.warnings) == losses(frames, held, sub_us=suffix == ".asc")
    same_but_time(back, expected)
    # ASC has its date as local time, and an import leaves it alone: its times count from 2000.
    shift = frames[0].t_ns // S * S - RELATIVE_EPOCH_NS if suffix == ".asc" else 0
    assert abs(time_errors(back, expected, shift)).max() <= error_ns


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("suffix", EXPORTED)
def test_export_and_import(suffix, count):
    each_trace(lambda frames: exported_and_imported(suffix, frames), count)


# -- python-can's writers -> import --------------------------------------------------------


def message_of(can_frame):
    return can.Message(
        timestamp=can_frame.t_ns / S,
        arbitration_id=can_frame.identifier,
        is_extended_id=can_frame.extended or can_frame.kind == "error",
        is_remote_frame=can_frame.kind == "remote",
        is_error_frame=can_frame.kind == "error",
        dlc=can_frame.dlc,
        data=can_frame.data,
        is_rx=not can_frame.sent,
        channel=int(can_frame.bus.removeprefix("can")),
        check=False,
    )


def held_by_python_cans_candump(can_frame):
    if can_frame.kind == "error":  # its writer has one identifier for all of them, and no direction
        return replace(can_frame, identifier=0x80, dlc=len(can_frame.data), sent=False)
    if can_frame.kind == "remote":
        return replace(can_frame, dlc=0)
    return replace(can_frame, dlc=len(can_frame.data))


def held_by_csv(can_frame):
    return replace(can_frame, sent=False, bus="can0")


def held_by_trc(can_frame):
    """Channels are counted from 1, in the format and in python-can's reader of it."""
    return replace(can_frame, bus=f"can{int(can_frame.bus.removeprefix('can')) + 1}")


WRITTEN = {
    # suffix: what it holds of a frame, error of its time [ns]
    ".log": (held_by_python_cans_candump, 1000),
    ".blf": (held_by_blf, 1000),
    ".asc": (held_by_python_cans_asc, 1000),
    ".asc.gz": (held_by_python_cans_asc, 1000),
    ".trc": (held_by_trc, 1500),  # its writer has data frames alone
    ".csv": (held_by_csv, 1000),
    ".db": (held_by_csv, 1000),
    ".mf4": (lambda can_frame: can_frame, 400),
}


def written_and_imported(suffix, frames):
    if suffix == ".mf4":
        pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
    held, error_ns = WRITTEN[suffix]
    frames = [can_frame for can_frame in frames if can_frame.kind == "data" or suffix != ".trc"]
    if not frames:
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trace = log_messages(folder / f"x{suffix}", map(message_of, frames))
        back, report = imported(trace, folder)
        with Session.open(folder / "back.mcap") as session:
            directions = session.metadata["undulog"]["import.directions"]
    # Candump has no directions if its first frame has none, as python-can's error frames.
    without = suffix in {".csv", ".db"} or (suffix == ".log" and frames[0].kind == "error")
    assert directions == ("none" if without else "recorded")
    kept = [held(can_frame) for can_frame in frames]
    expected = by_bus(kept)
    if suffix == ".mf4":  # a group for each kind: the order of kinds at one time isn't in the file
        back, expected = by_kind(back), by_kind(expected)
    assert report.frames == len(frames)
    same_but_time(back, expected)
    late = time_errors(back, expected)
    # Of the first frame's time, ASC has nothing, TRC 9 us.
    if suffix in {".asc", ".asc.gz", ".trc"}:
        first = min(can_frame.t_ns for of_bus in back.values() for can_frame in of_bus)
        assert suffix != ".trc" or abs(first - kept[0].t_ns) < 10_000
        assert suffix == ".trc" or first == RELATIVE_EPOCH_NS
        late -= first - kept[0].t_ns
    assert abs(late).max() <= error_ns


@pytest.mark.nightly
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("suffix", WRITTEN)
def test_python_cans_writer_and_import(suffix, count):
    each_trace(lambda frames: written_and_imported(suffix, frames), count)


def test_lines_that_a_reader_passes_over_are_counted(tmp_path):
    """Status and error lines of PEAK's format, which python-can has no frames for."""
    lines = [
        ";$FILEVERSION=2.1",
        ";$STARTTIME=43000.5",
        ";$COLUMNS=N,O,T,B,I,d,R,L,D",
        "1 1.000 DT 1 0123 Rx - 2 11 22",
        *(f"{n} 2.000 ER 1 - Rx - 5 04 00 02 00 00" for n in (2, 3)),
        "4 3.000 ST 1 - Rx - 4 00 00 00 08",
        "5 4.000 DT 1 0124 Tx - 1 33",
    ]
    (tmp_path / "x.trc").write_text("\n".join(lines) + "\n")
    frames, report = imported(tmp_path / "x.trc", tmp_path)
    contents = [(can_frame.identifier, can_frame.data) for can_frame in frames["can1"]]
    assert contents == [(0x123, b"\x11\x22"), (0x124, b"\x33")]
    unsupported = "TRCReader: Unsupported type"
    assert report.problems[:2] == [f"{unsupported} 'ER' (2 times)", f"{unsupported} 'ST'"]
