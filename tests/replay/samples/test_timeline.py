"""Time columns against the phases and times they stand for."""

from types import SimpleNamespace

import numpy as np
import pytest

from undulog.replay.samples.timeline import (
    GAIT_CYCLE,
    ROWS_PER_CHUNK,
    SESSION_TIME,
    STRETCH_NS,
    DrawnSpan,
    LoggedRhythm,
    TimeColumns,
    stretch_length_ns,
)

MS = 1_000_000
T = np.arange(400, dtype=np.int64) * 10 * MS


def gathered(clock, t_ns):
    """Rows and their times from all chunks: (timeline to times by row)."""
    row_times = {SESSION_TIME: {}, GAIT_CYCLE: {}}
    for rows, columns in clock.rows(t_ns):
        assert rows.stop - rows.start <= ROWS_PER_CHUNK
        for column in columns:
            times = column.times.cast("int64").to_pylist()
            assert len(times) == rows.stop - rows.start
            row_times[column.timeline] |= dict(
                zip(range(rows.start, rows.stop), times, strict=True)
            )
    return row_times


def test_session_time_counts_nanoseconds_from_the_start():
    start = 1_735_689_600_000_000_007
    rows = gathered(TimeColumns(start), start + T)
    assert list(rows[SESSION_TIME].values()) == T.tolist()
    assert not rows[GAIT_CYCLE]


def test_every_row_is_in_exactly_one_chunk_and_in_order():
    t = np.arange(3 * ROWS_PER_CHUNK + 17, dtype=np.int64)
    rows = [part for part, _ in TimeColumns(0).rows(t)]
    assert [i for part in rows for i in range(part.start, part.stop)] == list(range(len(t)))


@pytest.mark.parametrize("wrap", [False, True])
def test_a_cycle_is_a_second_whether_the_phase_was_wrapped_or_not(wrap):
    phase = 2 * np.pi * 0.5 * T / 1e9 + 0.3
    logged = np.angle(np.exp(1j * phase)) if wrap else phase
    rows = gathered(TimeColumns(0, LoggedRhythm.from_phase(T, logged)), T)
    cycles = np.array(list(rows[GAIT_CYCLE].values())) / 1e9
    np.testing.assert_allclose(cycles, phase / (2 * np.pi), atol=1e-9)


def test_a_phase_that_runs_backwards_counts_down():
    rhythm = LoggedRhythm.from_phase(T, -2 * np.pi * T / 1e9)
    np.testing.assert_allclose(rhythm.cycles, -T / 1e9, atol=1e-12)


def test_rows_without_a_phase_are_on_session_time_only():
    phase = 2 * np.pi * T / 1e9
    logged = (T >= 1000 * MS) & ~((T > 2000 * MS) & (T < 2500 * MS))
    rows = gathered(TimeColumns(0, LoggedRhythm.from_phase(T[logged], phase[logged])), T)
    assert list(rows[SESSION_TIME]) == list(range(len(T)))
    assert list(rows[GAIT_CYCLE]) == np.flatnonzero(logged).tolist()


def test_no_rows_make_no_chunks():
    assert list(TimeColumns(0).rows(T[:0])) == []


def test_rows_with_and_without_a_phase_are_chunks_of_their_own():
    t = np.arange(3 * ROWS_PER_CHUNK, dtype=np.int64)
    first, last = ROWS_PER_CHUNK + 5, 2 * ROWS_PER_CHUNK + 9
    rhythm = LoggedRhythm(t[first : last + 1], t[first : last + 1] / 1e9)
    chunks = [
        (rows.start, rows.stop, len(columns)) for rows, columns in TimeColumns(0, rhythm).rows(t)
    ]
    assert chunks == [
        (0, ROWS_PER_CHUNK, 1),
        (ROWS_PER_CHUNK, first, 1),
        (first, first + ROWS_PER_CHUNK, 2),
        (first + ROWS_PER_CHUNK, last + 1, 2),
        (last + 1, 3 * ROWS_PER_CHUNK, 1),
    ]


def test_a_chunk_has_4096_rows():
    t = np.arange(10_000, dtype=np.int64)
    parts = [(rows.start, rows.stop) for rows, _ in TimeColumns(0).rows(t)]
    assert parts == [(0, 4096), (4096, 8192), (8192, 10_000)]


def test_a_cycle_is_rounded_to_its_nanosecond():
    t = np.arange(4, dtype=np.int64)
    rows = gathered(TimeColumns(0, LoggedRhythm(t, np.array([0.0, 1.6e-9, 2.4e-9, 0.25]))), t)
    assert list(rows[GAIT_CYCLE].values()) == [0, 2, 2, 250_000_000]


def test_a_span_without_bounds_holds_every_time():
    t_ns = np.array([-(1 << 62), 0, (1 << 62) - 1], dtype=np.int64)
    assert DrawnSpan().rows(t_ns) == slice(0, 3)
    assert DrawnSpan(stop_ns=0).rows(t_ns) == slice(0, 1)
    assert DrawnSpan(start_ns=0).rows(t_ns) == slice(1, 3)
    assert DrawnSpan().known_ns is None


def session_of(count, messages=0, first=(), last=()):
    """A session so many stretches long, with chunks from and to some times, in stretches."""
    times = (np.array([STRETCH_NS * k for k in ends], dtype=np.uint64) for ends in (first, last))
    channels = {"a": SimpleNamespace(count=messages), "b": SimpleNamespace(count=0)}
    return SimpleNamespace(
        start_ns=7, end_ns=7 + count * STRETCH_NS, channels=channels, chunk_times_ns=tuple(times)
    )


@pytest.mark.parametrize(
    ("session", "doubled"),
    [
        (session_of(200), 0),
        (session_of(201), 1),
        (session_of(403), 2),  # 403, 201.5 and 100.75 stretches
        (session_of(300, 30_000), 0),
        (session_of(301, 30_000), 1),
        (session_of(300, 29_999), 1),
        # A chunk is read for eight stretches in the mean, and for 200 more in all.
        (session_of(150, 0, [0], [207]), 0),
        (session_of(150, 0, [0], [208]), 1),
        (session_of(150, 0, [208], [0]), 0),  # of a damaged index
        (session_of(150, 0, [0, 10], [107, 117]), 0),
        (session_of(150, 0, [0, 10], [107, 118]), 1),
        (session_of(150, 0, [100, 10], [108, 216]), 0),
        (session_of(1, 0, [0], [5000]), 0),
        (session_of(2, 0, [0], [5000]), 1),
    ],
)
def test_stretches_are_longer_where_shorter_ones_would_be_laborious(session, doubled):
    assert stretch_length_ns(session) == STRETCH_NS * 2**doubled
