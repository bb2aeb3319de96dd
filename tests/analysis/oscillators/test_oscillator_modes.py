"""Modes, pseudospectra, comparator and entrainment against closed forms and a foreign chain."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from study.coupling import henrici, pattern_condition

from undulog.analysis.estimators.intervals import noise_draws
from undulog.analysis.oscillators import laplacian
from undulog.analysis.oscillators.predictions import (
    entrainment,
    explicit_coupling,
    felt_response,
    homogeneous,
    path_laplacian,
    relaxation,
)


@dataclass(frozen=True)
class Table:
    """A matrix with errors, as central differences give it."""

    value: np.ndarray
    error: np.ndarray
    dof: np.ndarray
    correlation: None = None


def noisy(P, sigma, rng=None):
    error = np.full(P.shape, sigma)
    value = P if rng is None else P + rng.normal(0.0, sigma, P.shape)
    return Table(value, error, np.full(P.shape, 60.0))


def signed(rng, m, size=0.2):
    """Rows that sum to 1, entries of both signs."""
    off = rng.normal(0.0, size, (m, m))
    np.fill_diagonal(off, 0.0)
    return off + np.diag(1.0 - off.sum(axis=1))


@pytest.mark.parametrize("n", [5, 9, 13])
def test_a_path_has_the_gap_of_its_closed_form(n):
    K = 0.17
    P = np.eye(n) - K * path_laplacian(n)
    modes = laplacian.spectrum(P)
    expected = 4.0 * K * np.sin(np.arange(1, n) * math.pi / (2 * n)) ** 2
    np.testing.assert_allclose(modes.rates, expected, atol=1e-12)
    assert modes.gap == pytest.approx(4.0 * K * math.sin(math.pi / (2 * n)) ** 2)
    assert modes.strong == np.count_nonzero(expected > 0.1)
    np.testing.assert_allclose(modes.sensitivity, 1.0)  # symmetric
    slowest = np.cos((np.arange(n) + 0.5) * math.pi / n)
    assert abs(modes.patterns[:, 0] @ slowest) / np.linalg.norm(slowest) == pytest.approx(1.0)
    # Nothing grows, not even for a while: a symmetric chain's fastest growth is minus its gap.
    assert laplacian.growth(P) == pytest.approx(-modes.gap)


@pytest.mark.parametrize("n", [5, 13])
def test_explicit_coupling_supplies_the_gap(n):
    # Through a body that brings nothing back, the path has to do it all.
    K = explicit_coupling(np.eye(n), 0.1)
    assert 4.0 * K * math.sin(math.pi / (2 * n)) ** 2 == pytest.approx(0.1, rel=1e-4)
    assert explicit_coupling(np.eye(n) - 10.0 * path_laplacian(n), 0.1) == 0.0


def test_a_one_way_chain_is_not_normal_and_says_so():
    n, K = 8, 0.5
    L = np.diag(np.r_[0.0, np.ones(n - 1)]) - np.diag(np.ones(n - 1), -1)
    slightly = K * L @ np.diag(1.0 + 0.05 * np.arange(n))  # else its eigenvalues are all the same
    slightly -= np.diag(slightly.sum(axis=1))
    modes = laplacian.spectrum(np.eye(n) - slightly)
    assert modes.sensitivity.max() > 100.0
    # sigma_min is never above the distance to the nearest eigenvalue, and far below it here.
    z = complex(np.median(modes.rates.real), 0.2)
    level = laplacian.smallest_singular(
        np.eye(n) - slightly, np.array([z.real]), np.array([z.imag])
    )[0, 0]
    assert level < 0.2 * np.abs(modes.rates - z).min()


def test_levels_of_a_normal_matrix_are_distances():
    P = np.eye(5) - path_laplacian(5) * 0.3
    levels = laplacian.pseudospectrum(noisy(P, 1e-3))
    values = np.linalg.eigvalsh(np.eye(5) - P)[1:]  # all phases together are left out
    z = np.array(levels.real)[:, None] + 1j * np.array(levels.imag)
    np.testing.assert_allclose(levels.level, np.abs(z[..., None] - values).min(axis=-1), atol=1e-12)
    # The norm of a 4 x 4 matrix of noise: about 2 sqrt(4) sigma at most.
    assert 2.0e-3 < levels.noise < 6.0e-3


@pytest.mark.nightly
def test_intervals_of_rates_hold_the_truth():
    rng = np.random.default_rng(7)
    P = signed(rng, 6)
    truth = laplacian.spectrum(P)
    assert truth.sensitivity.max() > 1.2
    held = []
    for _ in range(60):
        table = noisy(P, 0.01, rng)
        modes = laplacian.spectrum(table.value)
        shown = laplacian.intervals_of(table.value, table.value + noise_draws(table, 21))
        order = [int(np.argmin(np.abs(modes.rates - rate))) for rate in truth.rates]
        for rate, k in zip(truth.rates, order, strict=True):
            held.append(shown.real[k, 0] <= rate.real <= shown.real[k, 1])
            if abs(rate.imag) > 0.1:  # of a real eigenvalue the imaginary part is exactly zero
                held.append(shown.imag[k, 0] <= rate.imag <= shown.imag[k, 1])
        held.append(shown.gap.ci95[0] <= truth.gap <= shown.gap.ci95[1])
        held.append(shown.growth.ci95[0] <= laplacian.growth(P) <= shown.growth.ci95[1])
        held.append(shown.strong.ci95[0] <= truth.strong <= shown.strong.ci95[1])
    assert np.mean(held) > 0.92


def test_the_comparator_is_homogeneous_and_as_strong():
    P = signed(np.random.default_rng(3), 9, 0.05)
    T = homogeneous(P)
    np.testing.assert_allclose(T.sum(axis=1), 1.0)
    assert np.linalg.norm(np.eye(9) - T) == pytest.approx(np.linalg.norm(np.eye(9) - P))
    # Off the diagonal, entries of one row keep the ratios of the diagonals' means.
    means = [np.diagonal(P, k).mean() for k in range(-8, 9)]
    for i in range(9):
        off = [j for j in range(9) if j != i]
        ratio = T[i, off] / [means[8 + j - i] for j in off]
        np.testing.assert_allclose(ratio, ratio[0])
    # A ring is homogeneous already but for its corners; what is Toeplitz stays.
    wave = 0.3 * (np.eye(9, k=1) + np.eye(9, k=-1)) + 0.4 * np.eye(9)
    wave /= wave.sum(axis=1, keepdims=True)
    again = homogeneous(homogeneous(wave))
    assert np.linalg.norm(again - homogeneous(wave)) < 0.05 * np.linalg.norm(np.eye(9) - wave)


def test_entrainment_is_read_from_settled_phases():
    # Oscillators that follow their commands and each other; SciPy settles them.
    rng = np.random.default_rng(5)
    m, Gamma = 6, rng.uniform(1.0, 3.0, 6)
    K = np.where(np.abs(np.subtract.outer(range(m), range(m))) == 1, rng.uniform(0.2, 1, (m, m)), 0)

    def pull(phase, command):
        drawn = Gamma * np.sin(command - phase)
        return drawn + np.sum(K * np.sin(phase[None, :] - phase[:, None] - 0.3), axis=1)

    def settled(command):
        tight = {"rtol": 1e-10, "atol": 1e-12}
        return solve_ivp(lambda _, x: pull(x, command), (0, 40), command, **tight).y[:, -1]

    base = np.zeros(m)
    step = 1e-3
    P = np.stack(
        [(settled(base + d) - settled(base - d)) / (2 * step) for d in step * np.eye(m)], axis=1
    )
    rest = settled(base)
    slope = Gamma * np.cos(base - rest)
    ahead = K * np.cos(rest[None, :] - rest[:, None] - 0.3)
    L = np.diag(ahead.sum(axis=1)) - ahead
    entrained = entrainment(noisy(P, 1e-3))
    np.testing.assert_allclose(entrained.value, L / slope[:, None], atol=3e-6)
    assert entrained.condition_number == pytest.approx(np.linalg.cond(P))
    # A chain twice as fast in everything has the same P: rates are not to be had from it.
    again = np.linalg.solve(np.diag(2 * slope) + 2 * L, np.diag(2 * slope))
    np.testing.assert_allclose(again, P, atol=1e-6)


def test_intervals_of_the_entrainment_hold_the_truth():
    rng = np.random.default_rng(9)
    P = signed(rng, 5)
    truth = np.linalg.inv(P) - np.eye(5)
    held = []
    for _ in range(60):
        entrained = entrainment(noisy(P, 0.01, rng))
        held.append(np.abs(np.array(entrained.value) - truth) <= entrained.ci95_half)
    assert 0.92 < np.mean(held) < 0.985


def test_a_singular_matrix_is_not_inverted():
    entrained = entrainment(noisy(np.full((4, 4), 0.25), 1e-3))
    assert entrained.value is None
    assert entrained.condition_number is None or entrained.condition_number > 1e6


def test_feedback_of_a_linear_body_relaxes_as_predicted():
    # A body that answers like a complex matrix, q = Im(H c): averaging is exact to first order in
    # eps, and SciPy integrates the whole of it.
    m, omega, eps = 5, math.pi, 0.05
    rng = np.random.default_rng(2)
    H = np.diag(rng.uniform(0.9, 1.1, m) * np.exp(-1j * rng.uniform(0.1, 0.5, m)))
    H = H + 0.15 * (rng.normal(size=(m, m)) + 1j * rng.normal(size=(m, m)))
    base = np.exp(-1j * math.pi / 3 * np.arange(m))
    answer = H @ base
    D = H * base[None, :] / answer[:, None]
    P, R = D.real, -D.imag
    felt = felt_response(answer / base, omega, 0.0)

    def rate(t, theta):
        c = base * np.exp(1j * theta)
        phase = omega * t - math.pi / 3 * np.arange(m) + theta
        q = np.imag(np.exp(1j * omega * t) * (H @ c))
        return eps * (2.0 * q * np.cos(phase) - felt.imag)

    kick = rng.uniform(-0.1, 0.1, m)
    t = np.arange(0.0, 41.0, 2.0)
    options = {"t_eval": t, "rtol": 1e-9, "atol": 1e-11}
    with_kick, without = (solve_ivp(rate, (0, 40), x, **options).y.T for x in (kick, 0 * kick))
    J = eps * relaxation(P, R, felt)
    predicted = np.array([expm(J * moment) @ kick for moment in t])
    error = np.linalg.norm(with_kick - without - predicted, axis=1) / np.linalg.norm(kick)
    assert error.max() < 0.06
    assert np.linalg.norm(predicted[-1] - kick) > 0.2 * np.linalg.norm(kick)


def test_the_age_of_a_reading_is_lag():
    felt = felt_response(np.array([0.9 * np.exp(-0.2j)]), math.pi, 0.02)
    assert np.angle(felt[0]) == pytest.approx(-0.2 - 0.02 * math.pi)
    assert felt.imag[0] == pytest.approx(0.9 * math.sin(-0.2 - 0.02 * math.pi))


@pytest.mark.parametrize("k", [0.0, 0.5, 7.0])
def test_distance_from_normal_is_that_of_the_closed_form(k):
    """[[1, k], [0, 2]] has eigenvalues 1 and 2, and eigenvectors (1, 0) and (k, 1)."""
    A = np.array([[1.0, k], [0.0, 2.0]])
    basis = np.linalg.qr(np.column_stack([np.ones(3), np.eye(3)[:, 1:]]))[0][:, 1:]
    P = np.eye(3) - basis @ A @ basis.T
    assert henrici(P) == pytest.approx(k / math.sqrt(5.0 + k * k), abs=1e-7)
    cosine = k / math.sqrt(1.0 + k * k)  # between the two eigenvectors
    expected = math.sqrt((1.0 + cosine) / (1.0 - cosine))
    assert pattern_condition(P) == pytest.approx(expected)


def test_no_coupling_is_normal():
    assert henrici(np.eye(4)) == 0.0
