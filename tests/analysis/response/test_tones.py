"""Responses at tones whose truth is chosen, with noise of its own level and colour."""

import numpy as np
import pytest
from scipy import signal

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.frequency_response.nonparametric import (
    find_tones,
    resampled,
    tone_response,
)

TONES = np.array([0.31, 0.5, 0.83, 1.4, 2.3])
RESPONSE = np.array([0.99, 0.9, 0.7, 0.4, 0.2]) * np.exp(-1j * np.array([0.1, 0.3, 0.8, 1.5, 2.2]))


def record(rng, *, noise=0.02, length_s=60.0):
    """Command and response at times of their own, the response with a drift and red noise."""
    t_u = np.arange(0.0, length_s, 0.02) + 0.001 * rng.random()
    t_y = np.sort(np.arange(0.004, length_s, 0.017) + 1e-4 * rng.random())
    phase = 2 * np.pi * rng.random(TONES.size)
    u = sum(np.cos(2 * np.pi * f * t_u + p) for f, p in zip(TONES, phase, strict=True))
    y = sum(
        np.abs(h) * np.cos(2 * np.pi * f * t_y + p + np.angle(h))
        for f, p, h in zip(TONES, phase, RESPONSE, strict=True)
    )
    red = signal.lfilter([1.0], [1.0, -0.8], rng.normal(size=t_y.size))
    y = y + 0.1 + 0.002 * t_y + noise * red
    return Series("u", t_u, u), Series("y", t_y, y)


def tones_of(command):
    t_s = np.arange(command.t_s[0], command.t_s[-1], command.period_s)
    return find_tones(command, resampled(command, t_s))


@pytest.mark.nightly
def test_intervals_hold_the_chosen_responses():
    rng, inside = np.random.default_rng(0), []
    for _ in range(100):
        command, response = record(rng)
        tones = tones_of(command)
        assert tones == pytest.approx(TONES, abs=1e-6)
        at_tones = tone_response(command, response, tones)
        inside.append(np.abs(at_tones.value - RESPONSE) <= at_tones.radius())
    assert 0.92 <= np.mean(inside) <= 0.98


def test_what_is_no_sum_of_sines_has_no_tones():
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 0.02)
    for values in (
        rng.normal(size=t.size),
        signal.chirp(t, 0.1, 60.0, 5.0),
        np.sign(rng.normal(size=60)).repeat(50),
        np.zeros(t.size),
    ):
        assert tones_of(Series("u", t, values)) is None
