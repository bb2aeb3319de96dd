"""Commands of each kind."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.frequency_response.excitation import ExcitationKind, find_excitation

T = np.arange(0.0, 60.0, 0.01)
RNG = np.random.default_rng(0)


def sines(*frequencies):
    return sum(np.sin(2 * np.pi * f * T + k) for k, f in enumerate(frequencies))


def multisine(period):
    lines = np.arange(1, 60, 2)
    phases = 2 * np.pi * RNG.random(lines.size)
    angle = 2 * np.pi * np.outer(T, lines) / period
    return np.cos(angle + phases).sum(axis=1)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (ExcitationKind.TONES, sines(0.25, 0.4, 0.613)),
        (ExcitationKind.TONES, sines(0.25)),
        (ExcitationKind.PERIODIC, multisine(12.0)),
        (ExcitationKind.CHIRP, signal.chirp(T, 0.2, 60.0, 6.0)),
        (ExcitationKind.CHIRP, signal.chirp(T, 6.0, 60.0, 0.2, method="logarithmic")),
        (ExcitationKind.STEPS, np.sign(RNG.normal(size=120)).repeat(50)),
        (ExcitationKind.NOISE, signal.lfilter(*signal.butter(2, 0.1), RNG.normal(size=T.size))),
    ],
)
def test_each_kind_is_found(kind, values):
    excitation = find_excitation(Series("u", T, values))
    assert excitation.kind is kind
    if kind is ExcitationKind.PERIODIC:
        assert excitation.period_s == pytest.approx(12.0, abs=0.005)


def test_what_never_moves_excites_nothing():
    assert find_excitation(Series("u", T, np.ones(T.size))) is None
    assert find_excitation(Series("u", T[:50], np.sin(T[:50]))) is None


@given(st.floats(1e3, 1e12))
def test_a_gap_that_is_longer_than_the_record_is_no_excitation_to_measure(gap_s):
    t_s = T + gap_s * np.heaviside(T - T[T.size // 2], 0.0)
    assert find_excitation(Series("u", t_s, np.sin(3 * T))) is None


@pytest.mark.parametrize(("chip", "count"), [(10, 4.3), (7, 2.2)])
def test_a_binary_sequence_that_repeats_is_periodic(chip, count):
    once = np.repeat(signal.max_len_seq(6)[0] * 2.0 - 1, chip)
    values = np.tile(once, 5)[: int(count * once.size)]
    excitation = find_excitation(Series("u", np.arange(values.size) * 0.01, values))
    assert excitation.kind is ExcitationKind.PERIODIC
    assert excitation.period_s == pytest.approx(once.size * 0.01, rel=1e-9)


def test_a_period_may_end_between_two_samples():
    lines, period_s, t = np.arange(1, 60, 2), 7.8937, np.arange(0.0, 40.0, 0.02)
    turns = 2 * np.pi * np.outer(t, lines) / period_s + 6.28 * RNG.random(lines.size)
    excitation = find_excitation(Series("u", t, np.cos(turns).sum(axis=1)))
    assert excitation.kind is ExcitationKind.PERIODIC
    assert excitation.period_s == pytest.approx(period_s, rel=1e-6)


def test_a_strong_line_is_not_taken_for_the_period():
    """Forty cycles of it in a period, each of which nearly repeats."""
    t, period_s = np.arange(0.0, 100.0, 0.02), 31.237
    values = np.cos(2 * np.pi * 40 * t / period_s)
    for line in (3, 7, 11, 16):
        values = values + 0.04 * np.cos(2 * np.pi * line * t / period_s + line)
    excitation = find_excitation(Series("u", t, values))
    assert excitation.kind is ExcitationKind.PERIODIC
    assert excitation.period_s == pytest.approx(period_s, rel=1e-6)
