"""Time columns against the phases and times they stand for."""

import numpy as np
import pytest

from undulog.replay.samples.timeline import GAIT_CYCLE, ROWS_PER_CHUNK, SESSION_TIME, Clock, Rhythm

MS = 1_000_000
T = np.arange(400, dtype=np.int64) * 10 * MS


def gathered(clock, t_ns):
    """Rows and their times from all chunks: (timeline to times by row)."""
    found = {SESSION_TIME: {}, GAIT_CYCLE: {}}
    for rows, columns in clock.rows(t_ns):
        assert rows.stop - rows.start <= ROWS_PER_CHUNK
        for column in columns:
            times = column.times.cast("int64").to_pylist()
            assert len(times) == rows.stop - rows.start
            found[column.timeline] |= dict(zip(range(rows.start, rows.stop), times, strict=True))
    return found


def test_session_time_counts_nanoseconds_from_the_start():
    start = 1_735_689_600_000_000_007
    found = gathered(Clock(start), start + T)
    assert list(found[SESSION_TIME].values()) == T.tolist()
    assert not found[GAIT_CYCLE]


def test_every_row_is_in_exactly_one_chunk_and_in_order():
    t = np.arange(3 * ROWS_PER_CHUNK + 17, dtype=np.int64)
    rows = [part for part, _ in Clock(0).rows(t)]
    assert [i for part in rows for i in range(part.start, part.stop)] == list(range(len(t)))


@pytest.mark.parametrize("wrap", [False, True])
def test_a_cycle_is_a_second_whether_the_phase_was_wrapped_or_not(wrap):
    phase = 2 * np.pi * 0.5 * T / 1e9 + 0.3
    logged = np.angle(np.exp(1j * phase)) if wrap else phase
    found = gathered(Clock(0, Rhythm.from_phase(T, logged)), T)
    cycles = np.array(list(found[GAIT_CYCLE].values())) / 1e9
    np.testing.assert_allclose(cycles, phase / (2 * np.pi), atol=1e-9)


def test_a_phase_that_runs_backwards_counts_down():
    rhythm = Rhythm.from_phase(T, -2 * np.pi * T / 1e9)
    np.testing.assert_allclose(rhythm.cycles, -T / 1e9, atol=1e-12)


def test_rows_without_a_phase_are_on_session_time_only():
    phase = 2 * np.pi * T / 1e9
    logged = (T >= 1000 * MS) & ~((T > 2000 * MS) & (T < 2500 * MS))
    found = gathered(Clock(0, Rhythm.from_phase(T[logged], phase[logged])), T)
    assert list(found[SESSION_TIME]) == list(range(len(T)))
    assert list(found[GAIT_CYCLE]) == np.flatnonzero(logged).tolist()


def test_no_rows_make_no_chunks():
    assert list(Clock(0).rows(T[:0])) == []
