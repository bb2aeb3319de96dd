"""Joints at several frequencies: which share one, and gain and lag of each against the truth."""

import group_tables
import numpy as np
import pytest

from support.frozen_records import mutable_dataclasses
from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import residual_noise
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.response.groups import (
    find_groups,
    further_lines,
    group_model,
    mixed_tones,
    with_mixed_lines,
)

Snake, GOLDEN = group_tables.Snake, group_tables.GOLDEN


@pytest.mark.built("tables")
@pytest.mark.nightly
@pytest.mark.parametrize(("ratio", "bend"), [(1.0, 0.0), (1.5, 0.0), (GOLDEN, 0.02)])
def test_lags_at_the_bound_and_intervals_that_hold_in_each_group(ratio, bend):
    """Truth: the same estimator on the noise-free run; 40 draws of 16 joints here."""
    # 320 lags a group or more: standard errors 4 % of the ratio, 1.2 % of each coverage.
    for rmse, *covered in group_tables.figures(Snake(ratio, bend=bend), 2e-3, 40):
        assert rmse < 1.1
        assert all(0.915 <= share <= 0.985 for share in covered)


@pytest.mark.parametrize("ratio", [1.5, 1.432 / 0.954, GOLDEN, 2.0])
def test_odd_and_even_joints_at_two_frequencies(ratio):
    snake = Snake(ratio)
    gait = snake.fit()
    assert [group.driven for group in gait.groups] == sorted(
        (tuple(snake.names[k::2]) for k in (0, 1)), key=lambda names: gait.group_of(names[0])
    )
    for group in gait.groups:
        rate = snake.omega[snake.names.index(group.driven[0]) % 2]
        assert (group.fit.omega, group.answered) == (pytest.approx(rate, rel=1e-9), group.driven)
    # A dense least-squares fit of everything, at the true frequencies, is the reference.
    t = snake.t + snake.skew_s
    rows = [np.ones_like(t)]
    seen = []
    for order in (1, 2, 3):
        for omega in snake.omega:
            if all(abs(order * omega - other) * snake.seconds > np.pi for other in seen):
                seen.append(order * omega)
                rows += [np.cos(order * omega * t), -np.sin(order * omega * t)]
    theta = np.linalg.lstsq(np.stack(rows).T, snake.response.T, rcond=None)[0]
    estimates = snake.estimates(gait)[:, 0]
    for j in range(snake.joints):
        b = seen.index(snake.omega[snake.group[j]])
        a = complex(theta[1 + 2 * b, j], theta[2 + 2 * b, j])
        rate = snake.omega[snake.group[j]]
        c = 2 * np.mean(snake.command[j] * np.exp(-1j * rate * snake.t))
        assert estimates[0, j] == pytest.approx(-np.angle(a / c), abs=0.03)  # c by a plain sum
        assert estimates[1, j] == pytest.approx(abs(a / c), rel=0.05)


def test_one_frequency_is_one_group_with_the_numbers_of_the_plain_fit():
    snake = Snake(1.0)
    gait = snake.fit()
    assert (gait.others, gait.driven) == ((), tuple(snake.names))
    assert gait.fit.model == HarmonicModel()


def test_a_group_of_one_and_a_joint_that_follows_nothing():
    snake = Snake(1.5, joints=9)
    rng = np.random.default_rng(1)
    snake.group[:] = 1
    snake.command[:] = 0.4 * np.sin((2 * np.pi * 0.954) * snake.t - np.arange(9)[:, None])
    snake.command[4] = 0.2 * np.sin(2 * np.pi * 0.4 * snake.t)
    snake.command[7] = 0.2 * rng.normal(size=snake.t.size)
    snake.command[8] = 0.0
    snake.response = 0.9 * snake.command
    notes = []
    gait = snake.fit(warn=notes.append)
    most = tuple(snake.names[k] for k in (0, 1, 2, 3, 5, 6))
    assert [group.driven for group in gait.groups] == [most, (snake.names[4],)]
    assert gait.group_of(snake.names[7]) is None
    assert any("joint08" in text and "commanded something else" in text for text in notes)
    assert any("joint09" in text and "held still" in text for text in notes)


def test_commands_with_the_tones_of_both_groups_go_where_their_own_is_largest():
    snake = Snake(GOLDEN, joints=8)
    first, second = (np.sin(omega * snake.t) for omega in snake.omega)
    snake.command[6] = 0.4 * first + 0.25 * second
    snake.command[7] = 0.3 * first + 0.4 * second
    snake.response = 0.8 * snake.command
    gait = snake.fit()
    assert gait.group_of(snake.names[6]) == gait.group_of(snake.names[0])
    assert gait.group_of(snake.names[7]) == gait.group_of(snake.names[1])


def test_frequencies_that_the_record_does_not_resolve():
    """0.2 cycles apart over the record one frequency fits all; 1.2 apart it doesn't."""
    for apart, others_null in ((0.2, False), (1.2, True)):
        snake = Snake(1 + apart / 12.0 / 0.954)
        notes = []
        gait = snake.fit(warn=notes.append)
        (text,) = [text for text in notes if "one group or two can't be decided" in text]
        assert gait.others == ()
        assert len(gait.driven) == (8 if others_null else 16)
        assert ("gain and lag of" in text) == others_null
        assert f"record {1.5 * 12 / apart:.3g} s or more" in text
    notes = []
    assert len(Snake(1 + 1.7 / 12.0 / 0.954).fit(warn=notes.append).groups) == 2
    assert not any("can't be decided" in text for text in notes)


def test_what_falls_on_a_groups_own_tone_is_named():
    notes = []
    Snake(1.5).fit(warn=notes.append)
    (text,) = [text for text in notes if "commensurate" in text]
    assert "3 x 0.954 Hz - 1.431 Hz falls on 1.431 Hz" in text
    assert "2 x 1.431 Hz - 2 x 0.954 Hz falls on 0.954 Hz" in text
    notes = []
    Snake(GOLDEN).fit(warn=notes.append)
    assert notes == []


def test_mixed_tones_of_lowest_order():
    for omegas, expected in (
        ([3.0, 2.0], [(0, {0: -1, 1: 3}), (1, {0: 2, 1: -2})]),
        ([1.0, 2.0], [(0, {0: -1, 1: 1}), (1, {0: 2})]),
        ([GOLDEN, 1.0], []),
    ):
        tones = mixed_tones(omegas, 2 * np.pi * 100)
        assert [(tone.group, dict(tone.factors)) for tone in tones] == expected


def test_lines_of_the_other_groups_are_distinct():
    lines = further_lines([3.0, 2.0], 0, 3, 100.0, 2 * np.pi * 100)
    assert lines == (2.0, 4.0)  # own 3, 6, 9; of 2, 4, 6 the last coincides
    assert further_lines([3.0, 2.0], 1, 3, 100.0, 2 * np.pi * 100) == (3.0, 9.0)
    assert further_lines([3.0, 2.0], 1, 3, 8.0, 2 * np.pi * 100) == (3.0,)
    assert further_lines([3.0, 2.0, 2.96], 1, 1, 100.0, 60.0)[:2] == (3.0, 6.0)  # 0.04: 0.4 / T


@pytest.mark.nightly
def test_mixed_tones_are_modelled_where_they_stand_out_and_only_there():
    """At 2 f2 - f1 and 3 f1 - 3 f2, three and ten times an amplitude's noise, in all joints."""
    rng = np.random.default_rng(6)
    t = np.arange(2000) / 100 - 10
    omegas = [2 * np.pi * GOLDEN, 2 * np.pi]
    planted = {2 * omegas[1] - omegas[0]: 1e-3, 3 * omegas[0] - 3 * omegas[1]: 3e-3}
    false = 0
    for _ in range(40):
        for tones in (planted, {}):
            series = []
            for k in range(8):
                y = np.sin(omegas[1] * t - k) + 0.1 * np.sin(omegas[0] * t + k)
                y = y + sum(size * np.sin(tone * t + 2 * k) for tone, size in tones.items())
                series.append(Series(f"j{k}", t, y + 0.01 * rng.normal(size=t.size)))
            model = group_model(series, omegas, 1, 20.0)
            lines = with_mixed_lines(series, omegas, 1, model, 20.0).lines[len(model.lines) :]
            if tones:
                assert set(lines) >= set(tones)
            false += len(set(lines) - set(tones))
    assert false <= 2  # of 80, each with a chance of 0.001


def test_a_fit_with_further_lines_is_least_squares():
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(-5, 5, 400))
    y = np.sin(3 * t) + 0.3 * np.cos(2 * t) + 0.1 * rng.normal(size=t.size)
    fit = fit_at([Series("q", t, y)], 3.0, HarmonicModel(harmonics=2, trend=1, lines=(2.0, 4.5)))
    rows = [np.ones_like(t), t]
    for line in (2.0, 4.5, 3.0, 6.0):
        rows += [np.cos(line * t), -np.sin(line * t)]
    theta, (rss,), *_ = np.linalg.lstsq(np.stack(rows).T, y, rcond=None)
    parts = np.array([*fit.lines[0], *fit.amplitudes[0]])
    ours = [*fit.trend[0], *np.ravel([parts.real, parts.imag], order="F")]
    np.testing.assert_allclose(ours, theta, rtol=0, atol=1e-10)
    assert fit.rss[0] == pytest.approx(rss)
    np.testing.assert_allclose(fit.predict(0, t), np.stack(rows).T @ theta, atol=1e-10)


def test_the_noise_beside_a_tone_leaves_out_the_other_groups_lines():
    """A line of another group within the bins is no noise once it is in the model."""
    rng = np.random.default_rng(3)
    t = np.arange(2000) / 100 - 10
    level = []
    wave = np.sin(2 * np.pi * t) + 0.05 * np.sin(2 * np.pi * 1.2 * t + 1)
    for lines in ((), (2 * np.pi * 1.2,)):
        draws = [Series("q", t, wave + 0.01 * n) for n in rng.normal(size=(200, t.size))]
        fit = fit_at(draws, 2 * np.pi, HarmonicModel(lines=lines))
        level.append(residual_noise(draws, fit).level.mean())
    assert level[0] > 10 * level[1]
    assert level[1] == pytest.approx(1e-4, rel=0.05)  # standard error 1.4 %


@pytest.mark.parametrize("seed", range(3))
def test_one_gait_is_not_split_by_noise_modulation_or_harmonics(seed):
    rng = np.random.default_rng(seed)
    t = np.arange(1500) / 100
    omega = 2 * np.pi * 0.8
    k = np.arange(8)[:, None]
    wave = np.sin(omega * t - k)
    for commands in (
        wave + 0.3 * rng.normal(size=wave.shape),
        wave * (1 + 0.4 * np.sin(0.9 * t)),
        np.sign(wave),
        wave * np.clip(t / 4, 0, 1),
        np.sin(omega * t + 0.5 * np.sin(0.5 * t) - k),
        0.6 * wave + np.sin(2 * (omega * t - k)) * (k < 4),
    ):
        groups = find_groups(
            [Series(f"j{i}", t, command) for i, command in enumerate(commands)], 15.0
        )
        assert (len(groups.rhythms), groups.unresolved) == (1, ())


def test_too_slow_or_too_few_samples_for_a_group_are_reported():
    snake = Snake(1.5, joints=6)
    commands, responses = (
        {n: Series(n, snake.t[::step], v[::step]) for n, v in zip(snake.names, rows, strict=True)}
        for rows, step in ((snake.command, 1), (snake.response, 60))
    )
    notes = []
    gait = fit_gait(commands, responses, snake.seconds, notes.append)
    assert all(group.answered == () for group in gait.groups)
    assert any("too few response samples" in text for text in notes)


@pytest.mark.nightly
def test_the_shared_frequencies_have_intervals_that_hold():
    """Commands and responses with noise of 5 mrad; 40 draws of two frequencies."""
    snake = Snake(GOLDEN, joints=6)
    rng = np.random.default_rng(4)
    inside = []
    for _ in range(40):
        noise = rng.normal(0, 5e-3, (2, *snake.command.shape))
        for group in snake.fit(noise[0], noise[1]).groups:
            true = snake.omega[snake.names.index(group.driven[0]) % 2]
            half = t_factor(group.omega_dof) * group.omega_error
            inside.append(abs(group.fit.omega - true) <= half)
    assert np.mean(inside) > 0.87  # 80 draws: standard error 2.4 %


def test_what_is_handed_on_can_not_be_changed():
    assert mutable_dataclasses("undulog.analysis.response") == set()
