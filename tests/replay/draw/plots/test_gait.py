"""The gait's rhythm and its changes of mode."""

import numpy as np

from undulog.replay.draw.plots.gait import changes, rhythm_of
from undulog.replay.draw.scene.stage import trail_segments
from undulog.replay.samples.tracks import Track

T = np.arange(500, dtype=np.int64) * 10_000_000


def gait(**planes):
    tracks = []
    for plane, (amplitude, frequency) in planes.items():
        tracks.append(Track(f"{plane}.A", T, np.full(500, amplitude)))
        tracks.append(Track(f"{plane}.phase", T, 2e-9 * np.pi * frequency * T))
    return tracks


def test_the_plane_that_swings_most_sets_the_rhythm():
    rhythm = rhythm_of(gait(horizontal=(0.1, 0.5), vertical=(0.4, 2.0)))
    np.testing.assert_allclose(rhythm.cycles, 2e-9 * T, atol=1e-9)


def test_a_phase_that_stands_still_is_no_rhythm():
    assert rhythm_of(gait(horizontal=(0.4, 0.0))) is None
    assert rhythm_of(gait(horizontal=(0.4, 0.1))) is None  # half a cycle
    assert rhythm_of([]) is None


def test_a_mode_begins_where_it_differs_from_the_one_before():
    assert changes(["walk", "walk", "avoid", "avoid", "walk"]) == [0, 2, 4]
    assert changes([]) == []


def test_the_trail_joins_successive_positions_but_not_across_a_gap():
    t = np.array([0, 100, 200, 300, 2000, 2100], dtype=np.int64)
    position = np.arange(18.0).reshape(6, 3)
    position[1] = np.nan
    ends, pieces = trail_segments(t, position)
    np.testing.assert_array_equal(ends, [300, 2100])
    np.testing.assert_array_equal(pieces, [position[2:4], position[4:6]])
