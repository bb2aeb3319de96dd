"""Planted couplings, integrated here: by Euler and Maruyama with noise, by SciPy without."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from undulog.analysis.parts.oscillators.measure import MOST_CONDITION, chain_coupling, kicked_steps

PERIOD_S = 0.01
PARTS = ("K", "psi", "omega")


class Planted:
    """A chain with couplings of its own in each direction, lags, and rates."""

    def __init__(self, rng, n, reach=1):
        self.n, self.reach = n, reach
        near = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        near = (near > 0) & (near <= reach)
        self.K = np.where(near, rng.uniform(1.0, 4.0, (n, n)), 0.0)
        self.psi = np.where(near, rng.uniform(-1.0, 1.0, (n, n)), 0.0)
        self.omega = math.pi + rng.normal(0.0, 0.3, n)
        self.names = [f"joint{i:02d}" for i in range(n)]

    def rates(self, phases):
        ahead = phases[None, :] - phases[:, None] - self.psi
        return self.omega + np.sum(self.K * np.sin(ahead), axis=1)

    def flow(self, rng, kicks, every_s, kick):
        """Phases without noise, by SciPy."""
        state, phases = rng.uniform(-1.0, 1.0, self.n), []
        times = np.arange(round(every_s / PERIOD_S) + 1) * PERIOD_S
        for _ in range(kicks + 1):
            span = (0.0, times[-1])
            method = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10}
            y = solve_ivp(lambda _, x: self.rates(x), span, state, t_eval=times, **method).y
            phases.append(y[:, :-1].T)
            state = y[:, -1] + rng.uniform(-kick, kick, self.n)
        return np.concatenate(phases)

    def answer(self, phases, **more):
        return chain_coupling("horizontal", self.names, phases, PERIOD_S, **more)

    def errors(self, coupling):
        """Relative errors of K, and which intervals of K and psi hold the truth."""
        off, inside = [], []
        for link in coupling.links:
            i, j = self.names.index(link.target), self.names.index(link.source)
            off.append(abs(link.K.value / self.K[i, j] - 1.0))
            low, high = link.K.ci95
            inside.append(low <= self.K[i, j] <= high)
            turn = self.psi[i, j] - link.lag_rad.value
            half = (link.lag_rad.ci95[1] - link.lag_rad.ci95[0]) / 2
            inside.append(abs(math.remainder(turn, math.tau)) <= half)
        return off, inside


def walk(chains, rng, duration_s, noise, kick, *, every_s=5.0, steps=5):
    """Phases of chains by Euler and Maruyama, every phase kicked by up to `kick` every so often."""
    K, psi, omega = (np.stack([getattr(chain, name) for chain in chains]) for name in PARTS)
    h, state, states = PERIOD_S / steps, np.zeros(omega.shape), []
    for k in range(round(duration_s / h)):
        if kick and k and k % round(every_s / h) == 0:
            state = state + rng.uniform(-kick, kick, state.shape)
        if k % steps == 0:
            states.append(state)
        rates = omega + np.sum(K * np.sin(state[:, None, :] - state[:, :, None] - psi), axis=2)
        state = state + h * rates + noise * math.sqrt(h) * rng.standard_normal(state.shape)
    return np.stack(states, axis=1)


@pytest.mark.slow
def test_heterogeneous_couplings_are_recovered_from_noisy_kicked_phases():
    off, inside = [], []
    rng = np.random.default_rng(0)
    chains = [Planted(rng, 7) for _ in range(6)]
    for chain, phases in zip(chains, walk(chains, rng, 60.0, 0.05, 1.0), strict=True):
        coupling = chain.answer(phases)
        assert (coupling.identifiable, coupling.kicks, len(coupling.links)) == (True, 11, 12)
        assert coupling.condition_number < MOST_CONDITION
        errors, held = chain.errors(coupling)
        assert np.median(errors) < 0.05
        off += errors
        inside += held
        for rate, omega in zip(coupling.oscillators, chain.omega, strict=True):
            low, high = rate.omega.ci95
            inside.append(low <= omega <= high)
            assert (rate.noise, rate.feedback.value) == (pytest.approx(0.05, rel=0.15), None)
    assert np.median(off) < 0.03
    # 186 intervals of 95 %: 3 standard deviations are 4.8 %.
    assert np.mean(inside) > 0.90


def test_couplings_beyond_neighbours_are_found_where_they_are_looked_for():
    rng = np.random.default_rng(3)
    chain = Planted(rng, 5, reach=4)
    coupling = chain.answer(chain.flow(rng, 12, 2.0, 1.0), reach=4)
    assert len(coupling.links) == 20
    errors, _ = chain.errors(coupling)
    assert max(errors) < 2e-3


def test_without_noise_only_the_sampling_is_left():
    rng = np.random.default_rng(2)
    chain = Planted(rng, 9)
    errors, _ = chain.errors(chain.answer(chain.flow(rng, 8, 4.0, 1.0)))
    assert max(errors) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.05, 0.1, 0.2])
def test_locked_phases_are_refused(noise):
    rng = np.random.default_rng(5)
    chains = [Planted(rng, 7) for _ in range(4)]
    for chain, phases in zip(chains, walk(chains, rng, 65.0, noise, 0.0, steps=2), strict=True):
        coupling = chain.answer(phases[500:])
        assert (coupling.identifiable, coupling.links) == (False, ())
        assert "locked" in coupling.why
        assert "condition number" in coupling.why
        assert "kicked as it runs" in coupling.record
        if noise < 0.15:
            assert coupling.condition_number is None or coupling.condition_number > MOST_CONDITION


def test_exactly_constant_differences_are_singular():
    phases = math.pi * (np.arange(2000) * PERIOD_S)[:, None] - np.arange(4) * math.pi / 3
    coupling = chain_coupling("horizontal", list("abcd"), phases, PERIOD_S)
    assert not coupling.identifiable
    assert coupling.condition_number is None or coupling.condition_number > 1e12


@pytest.mark.slow
def test_a_coupling_that_is_not_there_has_an_interval_from_zero():
    rng = np.random.default_rng(8)
    chain = Planted(rng, 6)
    chain.K[np.triu_indices(6)] = 0.0  # nothing from behind
    coupling = chain.answer(walk([chain], rng, 60.0, 0.05, 1.0)[0])
    # Names are in the order of the chain.
    at_zero = [link.K.ci95[0] == 0.0 for link in coupling.links if link.source > link.target]
    assert len(at_zero) == 5
    assert sum(at_zero) >= 4
    assert all(link.K.ci95[0] > 0.5 for link in coupling.links if link.source < link.target)


def test_a_known_input_is_separated_from_couplings():
    rng = np.random.default_rng(4)
    chain = Planted(rng, 4)
    gain = np.array([0.3, 0.6, 0.0, 0.9])
    h, state, phases, inputs = 0.002, np.zeros(4), [], []
    for k in range(30_000):
        if k and k % 2000 == 0:
            state = state + rng.uniform(-1.0, 1.0, 4)
        push = np.cos(state) * 2.0 * np.sin(math.pi * k * h + np.arange(4))
        if k % 5 == 0:
            phases.append(state)
            inputs.append(push)
        noise = 0.03 * math.sqrt(h) * rng.standard_normal(4)
        state = state + h * (chain.rates(state) + gain * push) + noise
    coupling = chain.answer(np.array(phases), inputs=np.array(inputs))
    errors, _ = chain.errors(coupling)
    assert np.median(errors) < 0.05
    for rate, true in zip(coupling.oscillators, gain, strict=True):
        assert rate.feedback.value == pytest.approx(true, abs=0.03)


def test_a_short_record_is_refused():
    coupling = chain_coupling("horizontal", list("abc"), np.zeros((50, 3)), PERIOD_S)
    assert not coupling.identifiable
    assert "too short" in coupling.why


def test_fast_transients_are_no_kicks_and_noise_is_none_either():
    t = np.arange(300) * PERIOD_S
    # The way back of a stiff chain: 1.5 rad within some samples.
    phases = np.stack([1.5 * np.exp(-30.0 * t), np.zeros(300)], axis=1)
    assert not kicked_steps(phases).any()
    phases[150:, 1] += 0.2
    assert np.flatnonzero(kicked_steps(phases)).tolist() == [149]
    assert not kicked_steps(phases + np.random.default_rng(1).normal(0.0, 0.1, phases.shape)).any()
