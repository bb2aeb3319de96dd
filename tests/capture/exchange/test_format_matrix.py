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

from support.written_frames import log_messages
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.exchange.can_import import import_can
from undulog.capture.exchange.export import export_log
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
    ordered = sorted(frames, key=lambda each: (each.t_ns, each.bus))
    return [replace(each, t_ns=T0 + each.t_ns) for each in ordered]


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
    for row, each in zip(array, frames, strict=True):
        flags = {"data": 0, "remote": fr.REMOTE_FLAG, "error": fr.ERROR_FLAG}[each.kind]
        row["t_host_ns"] = each.t_ns
        row["id_flags"] = each.identifier | flags | (fr.EXTENDED_FLAG if each.extended else 0)
        row["dlc"], row["dir"] = each.dlc, fr.DIR_TX if each.sent else fr.DIR_RX
        row["data"][: len(each.data)] = list(each.data)
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
            own = record_of([each for each in frames if each.bus == bus])
            if len(own):
                writer.frames(f"/can/{bus}").write(int(own["t_host_ns"].max()), own)
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
    for each in frames:
        split[each.bus].append(each)
    return split


def by_kind(frames_of_bus):
    split = defaultdict(list)
    for bus, frames in frames_of_bus.items():
        for each in frames:
            split[bus, each.kind].append(each)
    return split


def same_but_time(found, expected):
    timeless = (
        {bus: [replace(each, t_ns=0) for each in frames] for bus, frames in buses.items()}
        for buses in (found, expected)
    )
    assert next(timeless) == next(timeless)


def time_errors(found, expected, shift_ns=0):
    pairs = (zip(frames, expected[bus], strict=True) for bus, frames in found.items())
    return np.array([one.t_ns + shift_ns - truth.t_ns for bus in pairs for one, truth in bus])


# -- session -> export -> import -----------------------------------------------------------


def held_by_blf(each):
    return replace(each, sent=False) if each.kind == "error" else each


def held_by_asc(each):
    kept = held_by_python_cans_asc(each)
    return replace(kept, dlc=min(kept.dlc, 8))


def held_by_python_cans_asc(each):
    if each.kind == "error":
        return replace(each, identifier=0, dlc=0, data=b"", sent=False)
    return each


EXPORTED = {
    # suffix: what it holds of a frame, error of its time [ns]
    ".log": (lambda each: each, 0),
    ".blf": (held_by_blf, 1000),  # of floating-point seconds in the reader, rounded to 1 us
    ".asc": (held_by_asc, 500),
}
FIELDS = {
    "identifier": lambda each: each.identifier,
    "length code": lambda each: each.dlc,
    "data": lambda each: each.data,
    "direction": lambda each: each.sent,
}


def losses(frames, held, *, sub_us):
    """The sentences that must be reported, from the truth alone."""
    counts = Counter()
    for each in frames:
        kept = held(each)
        lost = {name for name, of in FIELDS.items() if of(each) != of(kept)}
        # Data is compared as eight bytes: a loss of zeros is none.
        if "data" in lost and not any(each.data) and not any(kept.data):
            lost.discard("data")
        if sub_us and each.t_ns % 1000:
            lost.add("time below 1 us")
        counts.update((each.kind, name) for name in lost)
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
    expected = by_bus([held(each) for each in frames])
    assert report.facts["buses"] == {bus: len(own) for bus, own in by_bus(frames).items()}
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


def message_of(each):
    return can.Message(
        timestamp=each.t_ns / S,
        arbitration_id=each.identifier,
        is_extended_id=each.extended or each.kind == "error",
        is_remote_frame=each.kind == "remote",
        is_error_frame=each.kind == "error",
        dlc=each.dlc,
        data=each.data,
        is_rx=not each.sent,
        channel=int(each.bus.removeprefix("can")),
        check=False,
    )


def held_by_python_cans_candump(each):
    if each.kind == "error":  # its writer has one identifier for all of them, and no direction
        return replace(each, identifier=0x80, dlc=len(each.data), sent=False)
    if each.kind == "remote":
        return replace(each, dlc=0)
    return replace(each, dlc=len(each.data))


def held_by_csv(each):
    return replace(each, sent=False, bus="can0")


def held_by_trc(each):
    """Channels are counted from 1, in the format and in python-can's reader of it."""
    return replace(each, bus=f"can{int(each.bus.removeprefix('can')) + 1}")


WRITTEN = {
    # suffix: what it holds of a frame, error of its time [ns]
    ".log": (held_by_python_cans_candump, 1000),
    ".blf": (held_by_blf, 1000),
    ".asc": (held_by_python_cans_asc, 1000),
    ".asc.gz": (held_by_python_cans_asc, 1000),
    ".trc": (held_by_trc, 1500),  # its writer has data frames alone
    ".csv": (held_by_csv, 1000),
    ".db": (held_by_csv, 1000),
    ".mf4": (lambda each: each, 400),
}


def written_and_imported(suffix, frames):
    if suffix == ".mf4":
        pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
    held, error_ns = WRITTEN[suffix]
    frames = [each for each in frames if each.kind == "data" or suffix != ".trc"]
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
    kept = [held(each) for each in frames]
    expected = by_bus(kept)
    if suffix == ".mf4":  # a group for each kind: the order of kinds at one time isn't in the file
        back, expected = by_kind(back), by_kind(expected)
    assert report.frames == len(frames)
    same_but_time(back, expected)
    late = time_errors(back, expected)
    # Of the first frame's time, ASC has nothing, TRC 9 us.
    if suffix in {".asc", ".asc.gz", ".trc"}:
        first = min(each.t_ns for own in back.values() for each in own)
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
    found = [(each.identifier, each.data) for each in frames["can1"]]
    assert found == [(0x123, b"\x11\x22"), (0x124, b"\x33")]
    unsupported = "TRCReader: Unsupported type"
    assert report.problems[:2] == [f"{unsupported} 'ER' (2 times)", f"{unsupported} 'ST'"]
