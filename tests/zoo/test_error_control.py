"""How often an answer names what is not there, by the script of the manual."""

import answer_tables
import numpy as np
import pytest
from scipy.stats import binom, norm

SESSIONS = 60
ANY, BROKEN, NAMED = 0.065, 0.01, 0.95
CHANCE = 1e-3
"""A cell may be off by what chance makes of so few sessions; all cells together may not."""


def too_often(share, sessions, bar):
    return round(share * sessions) > binom.ppf(1 - CHANCE, sessions, bar)


@pytest.mark.built("tables")
@pytest.mark.slow
def test_identical_joints_are_rarely_reported_to_differ():
    cells = answer_tables.identical(SESSIONS)
    print(cells)
    for cell, (any_of_them, broken, *_) in cells.items():
        assert not too_often(any_of_them, SESSIONS, ANY), cell
        assert not too_often(broken, SESSIONS, BROKEN), cell
    assert np.mean([shares[0] for shares in cells.values()]) <= ANY
    assert np.mean([shares[1] for shares in cells.values()]) <= BROKEN


@pytest.mark.built("tables")
@pytest.mark.slow
def test_a_joint_off_by_three_half_widths_is_named():
    sessions = SESSIONS // 4
    cells = answer_tables.one_off(sessions)
    print(cells)
    for cell, (named, _) in cells.items():
        assert not too_often(1 - named, sessions, 1 - NAMED), cell
    assert np.mean([shares[0] for shares in cells.values()]) >= NAMED


@pytest.mark.parametrize("noise", ["white", "AR(0.9)", "shared"])
def test_half_widths_are_those_of_the_noise(noise):
    """Errors of ln|H| by projection of drawn noise on the gait, against the closed form."""
    random = np.random.default_rng(5)
    m, omega, t = answer_tables.JOINTS, 2 * np.pi * 0.8, np.arange(600) / 50
    response = 0.4 * np.exp(-1j * np.arange(m))
    basis = np.linspace(-1, 1, m)[:, None] ** np.arange(3)
    carrier = 2 / t.size * np.exp(-1j * omega * t)
    drawn = (answer_tables.noise_of(random, noise, m, t.size) for _ in range(400))
    errors = np.array([(sample @ carrier / response).real for sample in drawn])
    for joint in (0, 4):
        others = np.delete(np.arange(m), joint)
        predicted = errors[:, others] @ (basis[joint] @ np.linalg.pinv(basis[others]))
        half = answer_tables.half_width(noise, 1, joint, t, omega=omega, response=response)
        factor = norm.ppf(1 - 0.025 / (3 * m))
        assert factor * np.std(errors[:, joint] - predicted) == pytest.approx(half, rel=0.12)
