"""Loops u = C (r - y / z), y = G u + v in closed form: the direct bias, the indirect intervals."""

import numpy as np
import pytest
from scipy import signal

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.frequency_response.excitation import find_excitation
from undulog.analysis.parts.frequency_response.measure import estimate, frequency_responses

STEP_S, COUNT, DRAWS = 0.01, 4000, 60
POLE, SIZE, CONTROL = 0.6, 0.3, 0.8  # G = SIZE / (1 - POLE / z)
NOISE_SHARE = 0.1  # of the power of r + v
T_S = np.arange(COUNT) * STEP_S


def plant(frequency_hz):
    return SIZE / (1 - POLE * np.exp(-2j * np.pi * frequency_hz * STEP_S))


def loop(rng, reference, noise_sd):
    """Return r, u and y."""
    v = rng.normal(0, noise_sd, COUNT)
    late = np.concatenate([[0.0], v[:-1]])
    closed = [1.0, CONTROL * SIZE - POLE]  # times u: C (1 - POLE / z) (r - v / z)
    u = signal.lfilter(CONTROL * np.array([1.0, -POLE]), closed, reference - late)
    y = signal.lfilter([SIZE], [1.0, -POLE], u) + v
    return [Series("q", T_S, samples) for samples in (reference, u, y)]


def noisy(rng):
    reference = rng.normal(0, (1 - NOISE_SHARE) ** 0.5, COUNT)
    return loop(rng, reference, NOISE_SHARE**0.5)


def directly_expected(frequency_hz):
    """Return G + S_vu / S_uu for white r and v."""
    z = np.exp(2j * np.pi * frequency_hz * STEP_S)
    G = plant(frequency_hz)
    return G - NOISE_SHARE * z * (1 + CONTROL * G / z) / CONTROL


def covered(value, lines):
    return np.abs(lines.value - value) <= lines.radius()


def test_the_direct_estimate_is_biased_as_derived_and_the_indirect_one_is_not():
    rng = np.random.default_rng(4)
    direct, indirect, inside = [], [], []
    for _ in range(DRAWS):
        r, u, y = noisy(rng)
        excitation = find_excitation(r)
        lines = estimate(u, y, excitation, r)
        f = lines.frequency_hz
        inside.append(covered(plant(f), lines))
        indirect.append(np.mean(lines.value - plant(f)))
        lines = estimate(u, y, find_excitation(u))
        f = lines.frequency_hz
        direct.append(np.mean(lines.value - directly_expected(f)))
        bias = np.mean(directly_expected(f) - plant(f))
    assert abs(bias) > 0.15
    for errors in (direct, indirect):
        error = np.std(errors) / DRAWS**0.5
        assert abs(np.mean(errors)) < 4 * error < 0.2 * abs(bias)
    covers = np.mean(np.concatenate(inside))
    assert 0.91 <= covers <= 0.98, covers


@pytest.mark.nightly
def test_tones_of_a_reference():
    rng = np.random.default_rng(5)
    tones = np.array([0.31, 0.73, 1.9, 4.1])
    reference = np.sin(2 * np.pi * np.outer(T_S, tones) + np.arange(4)).sum(axis=1)
    inside, apart = [], []
    for _ in range(80):
        r, u, y = loop(rng, reference, 0.5)
        excitation = find_excitation(r)
        lines = estimate(u, y, excitation, r)
        np.testing.assert_allclose(lines.frequency_hz, tones, atol=1e-6)
        inside.append(covered(plant(tones), lines))
        apart.append(np.abs(lines.value - plant(tones)) ** 2 / lines.variance)
    assert 0.91 <= np.mean(inside) <= 0.98, np.mean(inside)
    assert np.median(apart) == pytest.approx(np.log(2), rel=0.3)


def test_the_method_is_named_and_a_reference_that_is_still_is_none():
    r, u, y = noisy(np.random.default_rng(6))
    (response,) = frequency_responses({"q": u}, {"q": y}, print, {"q": r})
    assert response.method == "indirect"
    agree, lines = response.halves_agree
    assert agree >= 0.85 * lines
    still = Series("q", T_S, np.zeros(COUNT))
    for references in (None, {}, {"p": r}, {"q": still}):
        (response,) = frequency_responses({"q": u}, {"q": y}, print, references)
        assert response.method == "direct"


def test_lines_at_which_the_reference_does_not_move_the_command_are_left_out():
    rng = np.random.default_rng(7)
    slow = signal.lfilter(*signal.butter(4, 0.04), rng.normal(0, 1.0, COUNT))
    r, u, y = loop(rng, slow + rng.normal(0, 0.005, COUNT), 0.5)
    lines = estimate(u, y, find_excitation(r), r)
    assert 5 < lines.frequency_hz.size < 40
    assert lines.frequency_hz.max() < 6.0
    assert covered(plant(lines.frequency_hz), lines).mean() > 0.8
