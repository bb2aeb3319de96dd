"""Responses of digital filters, whose truth is exact, to noise that never repeats."""

import numpy as np
import pytest
from scipy import signal

from undulog.analysis.parts.frequency_response.nonparametric import local_response, window

N = 2000
BINS = np.arange(20, 300, 15)
FILTERS = (signal.butter(2, 0.2), signal.iirpeak(0.25, 4.0))
W = 2 * np.pi * BINS / N


def truth(k):
    return signal.freqz(*FILTERS[k], W)[1]


def test_intervals_hold_the_exact_response_in_spite_of_leakage():
    rng, inside, noise = np.random.default_rng(0), [], []
    for _ in range(100):
        u = rng.normal(size=N)
        y = signal.lfilter(*FILTERS[0], u) + 0.05 * rng.normal(size=N)
        local = local_response(np.fft.rfft(y), np.fft.rfft(u)[None], BINS, window(1))
        inside.append(np.abs(local.value[:, 0] - truth(0)) <= local.radius()[:, 0])
        noise.append(local.noise)
    assert 0.93 <= np.mean(inside) <= 0.97
    assert np.mean(noise) == pytest.approx(N * 0.05**2, rel=0.05)


def test_several_inputs_are_told_apart():
    rng, inside = np.random.default_rng(1), []
    for _ in range(60):
        u = rng.normal(size=(2, N))
        y = sum(signal.lfilter(*f, samples) for f, samples in zip(FILTERS, u, strict=True))
        y += 0.05 * rng.normal(size=N)
        local = local_response(np.fft.rfft(y), np.fft.rfft(u), BINS, window(2))
        exact = np.stack([truth(0), truth(1)], axis=1)
        inside.append(np.abs(local.value - exact) <= local.radius())
    assert 0.92 <= np.mean(inside) <= 0.98


def test_inputs_that_are_one_have_no_response_of_their_own():
    rng = np.random.default_rng(2)
    u = np.fft.rfft(rng.normal(size=N))
    local = local_response(u, np.stack([u, -2 * u]), BINS, window(2))
    assert np.isnan(local.value).all()


@pytest.mark.parametrize("half", [2, N])
def test_a_window_that_leaves_nothing_is_refused(half):
    u = np.fft.rfft(np.random.default_rng(3).normal(size=N))
    with pytest.raises(ValueError, match="a window of"):
        local_response(u, u[None], BINS, half)
