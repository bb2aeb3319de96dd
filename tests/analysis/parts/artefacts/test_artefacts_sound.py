"""Sound sessions of unusual motion: resonances and joints that hardly follow are no artefacts."""

import numpy as np
import pytest

from support import planted_artefacts
from support.planted_artefacts import DRIVEN, OMEGA

TONES = OMEGA * np.array([1.0, 2.2, 3.4])
"""As `undulog plan multisine` has them; their amplitudes are equal here."""


def multisine(seed, steps, response):
    """Tones in all driven joints at once, which answer by ``response(rng)``, over TONES each."""
    snake = planted_artefacts.Snake(seed, steps)
    command, position, velocity = (np.zeros_like(snake.command) for _ in range(3))
    for j in DRIVEN:
        c = 0.05 * np.exp(1j * snake.rng.uniform(-np.pi, np.pi, TONES.size))
        wave = np.exp(1j * snake.t[:, None] * TONES)
        a = response(snake.rng) * c
        command[:, j] = (wave @ c).imag
        position[:, j] = (wave @ a).imag
        velocity[:, j] = (wave @ (1j * TONES * a)).imag
    snake.command, snake.velocity = command, velocity + snake.rng.normal(0, 0.002, velocity.shape)
    snake.position = snake.encoded(position + snake.rng.normal(0, 1e-4, position.shape))
    return snake


def resonance(rng):
    """A light damping, and a frequency among the tones."""
    w = TONES / (OMEGA * rng.uniform(1.3, 4.0))
    return 1.0 / (1.0 - w**2 + 2j * rng.uniform(0.1, 0.3) * w)


def hardly(rng):
    """A small gain: a few steps of a coarse encoder."""
    return rng.uniform(0.05, 0.3) * np.exp(-1j * rng.uniform(0.0, 0.5, TONES.size))


@pytest.mark.parametrize("response", [resonance, hardly])
@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(k, marks=pytest.mark.nightly) for k in range(2, 6))]
)
def test_no_artefact_is_found(response, seed, tmp_path):
    snake = multisine(seed, (2 * np.pi / 4096, 0.005), response)
    assert planted_artefacts.artefacts(snake.write(tmp_path / "run.mcap")) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_that_answers_upside_down_at_all_tones_is_reported(seed, tmp_path):
    snake = multisine(seed, (0.0,), lambda rng: rng.uniform(0.8, 1.1) * np.exp(-0.01j * TONES))
    j = snake.joint()
    snake.position[:, j] *= -1
    snake.velocity[:, j] *= -1
    (artefact,) = planted_artefacts.artefacts(snake.write(tmp_path / "run.mcap"))
    assert (artefact.joint, artefact.quantity) == (snake.robot.joint_names[j], "position")
    assert (artefact.flag, artefact.spans_s) == ("wrong_sign", (pytest.approx((0.0, snake.t[-1])),))


def wave(lags_deg, upside_down=()):
    """A gait of one frequency; some joints answer upside down."""
    snake = planted_artefacts.Snake(1, (2 * np.pi / 4096, 0.005))
    for j, lag in zip(DRIVEN, np.radians(lags_deg), strict=True):
        sign = -1 if j in upside_down else 1
        phase = OMEGA * snake.t - j
        snake.command[:, j] = 0.3 * np.sin(phase)
        snake.position[:, j] = sign * 0.35 * np.sin(phase - lag)
        snake.velocity[:, j] = sign * 0.35 * OMEGA * np.cos(phase - lag)
    snake.velocity += snake.rng.normal(0, 0.002, snake.velocity.shape)
    snake.position = snake.encoded(snake.position + snake.rng.normal(0, 1e-4, snake.position.shape))
    return snake


def test_joints_that_lag_by_nearly_half_a_cycle_near_a_resonance_are_sound(tmp_path):
    bend = np.sin(np.pi * np.arange(len(DRIVEN)) / (len(DRIVEN) - 1))
    snake = wave(20 + 140 * bend)
    assert planted_artefacts.artefacts(snake.write(tmp_path / "run.mcap")) == ()


@pytest.mark.parametrize("lag_deg", [-10, 0, 40])
@pytest.mark.parametrize("upside_down", [DRIVEN[3:4], DRIVEN])
def test_joints_that_answer_upside_down_are_reported(upside_down, lag_deg, tmp_path):
    snake = wave(np.full(len(DRIVEN), lag_deg), upside_down)
    artefacts = planted_artefacts.artefacts(snake.write(tmp_path / "run.mcap"))
    assert {artefact.flag for artefact in artefacts} == {"wrong_sign"}
    assert {artefact.joint for artefact in artefacts} == {
        snake.robot.joint_names[j] for j in upside_down
    }
