"""Why there is no gait: nothing moves, too short, sampled too seldom, or not periodic."""

import numpy as np
import pytest

from support.analysed import analysed
from support.joint_runs import write_joints
from undulog.analysis.common.answer import Answer, Verdict, led
from undulog.analysis.common.remarks import Leading, Refusal, Remarks
from undulog.analysis.estimators.harmonic import fit_at
from undulog.analysis.estimators.series import Series, moves
from undulog.analysis.parts.frequency_response.excitation import find_excitation
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.response.groups import Groups
from undulog.analysis.response.rhythm import Rhythm
from undulog.analysis.response.without_gait import few_cycles, too_seldom, why_no_gait

T = np.arange(1000) / 100
NAMES = [f"m{k:02d}" for k in range(6)]


def wave(name, omega=3.0, size=0.4, t=T, late=0.0):
    return Series(name, t, size * np.sin(omega * t - late))


def chain(frequency_hz, duration_s, rate_hz=100.0, shape=np.sin, noise=0.0):
    """Six channels, each 0.6 rad later than the one before."""
    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    rng = np.random.default_rng(4)
    return [
        Series(
            name, t, shape(2 * np.pi * frequency_hz * t - 0.6 * k) + noise * rng.normal(size=t.size)
        )
        for k, name in enumerate(NAMES)
    ]


def test_why_there_is_no_gait():
    still = [Series("a", T, np.ones(T.size)), Series("b", T[:1], T[:1])]
    nulls = "gain, lag and frequency are null"
    assert (
        why_no_gait(still, None, "commands", 10.0) == f"no gait: the commands never move; {nulls}"
    )
    assert why_no_gait([], None, "responses", 1.0).startswith("no gait: the responses never move")
    assert why_no_gait([wave("a", t=T[:2])], None, "commands", 12.34) == (
        "no gait: not periodic: no rhythm of at least 3 cycles can be told from the commands in "
        f"12.3 s; {nulls}"
    )
    rhythm = Rhythm(("a",), fit_at([wave("a")], np.pi))
    single = why_no_gait([wave("a")], Groups((rhythm,), 0.5), "commands", 10.0)
    assert single.startswith(
        "no gait: the best rhythm (0.5 Hz) explains 50 % of the commands' variance, a gait at "
        f"least 80 %; {nulls} (if only"
    )
    two = why_no_gait([wave("a")], Groups((rhythm, rhythm), -0.5), "commands", 10.0)
    assert "the best rhythms (0.5 Hz, 0.5 Hz) explain 0 % of" in two


@pytest.mark.parametrize("cycles", [1.0, 1.3, 1.75, 2.25, 2.9])
def test_a_sine_of_fewer_than_three_cycles_is_counted_in_cycles(cycles):
    sine = few_cycles(chain(cycles / 8, 8.0, noise=0.01), 8.0)
    assert sine.cycles == pytest.approx(cycles, rel=0.01)
    assert sine.frequency_hz == pytest.approx(cycles / 8, rel=0.01)


def test_what_is_no_short_sine_is_not_counted_as_one():
    rng = np.random.default_rng(3)
    walks = [Series(n, T, np.cumsum(rng.normal(size=T.size))) for n in NAMES]
    ramps = [Series(n, T, (k + 1) * T) for k, n in enumerate(NAMES)]
    steps = [Series(n, T, np.floor(T / (2 + k))) for k, n in enumerate(NAMES)]
    sweep = [Series(n, T, np.sin(0.12 * T**2 + k)) for k, n in enumerate(NAMES)]
    square = chain(0.2, 10.0, shape=lambda turn: np.sign(np.sin(turn)))
    for other in (walks, ramps, steps, sweep, square, chain(0.05, 10.0), chain(0.5, 10.0), []):
        assert few_cycles(other, 10.0) is None


@pytest.mark.parametrize("frequency_hz", [9.2, 9.5, 9.9, 10.0])
def test_motion_near_half_the_sampling_rate_is_sampled_too_seldom(frequency_hz):
    for noise in (0.0, 0.1):
        seen = too_seldom(chain(frequency_hz, 12.0, rate_hz=20.0, noise=noise))
        assert seen.rate_hz == pytest.approx(20.0)
        assert seen.frequency_hz == pytest.approx(frequency_hz, abs=0.1)


def test_what_lies_within_the_band_is_sampled_often_enough():
    rng = np.random.default_rng(3)
    t = np.arange(240) / 20
    noise = [Series(n, t, rng.normal(size=t.size)) for n in NAMES]
    bits = [Series(n, t, rng.choice([-1.0, 1.0], t.size)) for n in NAMES]
    still = [Series(n, t, np.ones(t.size)) for n in NAMES]
    sparse = [Series(n, t[[*range(20), 239]], rng.normal(size=21)) for n in NAMES]
    inside = [chain(hz, 12.0, rate_hz=20.0, noise=0.1) for hz in (0.5, 5.0, 8.0, 8.8)]
    for other in (noise, bits, still, sparse, [], *inside):
        assert too_seldom(other) is None


def test_rounding_is_no_motion():
    turns = 2 * np.pi * np.arange(72_000.0)  # an hour, one sample a cycle
    assert not moves(0.4 * np.sin(turns - 0.6))
    assert not moves(turns[:0])
    assert moves(1e-6 * np.sin(T))
    assert find_excitation(Series("a", T, 0.4 + 1e-13 * np.sin(99.0 * T))) is None


@pytest.mark.parametrize("frequency_hz", [6.7, 8.0, 8.9])
@pytest.mark.parametrize("joints", [1, 6])
def test_a_gait_just_within_the_band_has_its_gain_and_lag(frequency_hz, joints):
    commands = chain(frequency_hz, 12.0, rate_hz=20.0)[:joints]
    t = commands[0].t_s
    turn = 2 * np.pi * frequency_hz * t
    answers = [0.93 * np.sin(turn - 0.6 * k - 0.2) for k in range(joints)]
    noise = 0.004 * np.random.default_rng(1).normal(size=(joints, t.size))
    both = ({c.name: c for c in commands}, {})
    both[1].update((n, Series(n, t, a + e)) for n, a, e in zip(NAMES, answers, noise, strict=False))
    gait = fit_gait(*both, 12.0, lambda _: None)
    assert np.abs(gait.response.ratio) == pytest.approx(0.93, abs=3e-3)
    assert np.angle(gait.response.ratio) == pytest.approx(-0.2, abs=3e-3)


@pytest.mark.parametrize(
    ("rate_hz", "run", "sentence"),
    [
        (
            20,
            (9.5, 12, 0),
            "Sampled too seldom: most of the commands is at 9.5 Hz or above, beyond",
        ),
        (
            20,
            (10.0, 12, 0),
            "Sampled too seldom: most of the commands is at 10 Hz or above, beyond",
        ),
        (50, (0.3, 6, 0), "Too short for a gait: 1.8 of at least 3 cycles of 0.3 Hz."),
        (50, (0.3, 6, 8), "Too short for a gait: 1.8 of at least 3 cycles of 0.3 Hz."),
        (50, (0.8, 6, 8), "Too short: 0 of 6 s are left after the settling time of 8 s. The seg"),
        (50, (0.8, 9, 8), "Too short: 1 of 9 s are left after the settling time of 8 s. The seg"),
        (50, (0.8, 14, 8), "The segments move alike: all 6 joints are within 2 % of gain and 1 de"),
    ],
)
def test_the_first_sentence_says_that_the_record_is_too_short_or_sampled_too_seldom(
    tmp_path, rate_hz, run, sentence
):
    frequency_hz, duration_s, settle_s = run
    turn = 2 * np.pi * frequency_hz * np.arange(rate_hz * duration_s)[:, None] / rate_hz
    commands, states = (0.4 * np.sin(turn - 0.6 * np.arange(6) - late) for late in (0.0, 0.2))
    states += 0.002 * np.random.default_rng(1).normal(size=states.shape)
    still = np.zeros_like(states)
    path = write_joints(
        tmp_path / "run.mcap",
        *(NAMES, commands, (states, still, still)),
        rate_hz=rate_hz,
        metadata={"settle_s": repr(float(settle_s))},
    )
    result = analysed(path)
    assert result.answer.sentence.startswith(sentence)
    assert result.frequency_response == ()


def test_a_leading_remark_begins_the_answer_and_replaces_that_there_is_nothing():
    late = Leading("too short: 1 s is left; all is taken")
    alike = Answer(verdict=Verdict.ALIKE, sentence="All alike.")
    assert led(alike, [late]).sentence == "Too short: 1 s is left. All alike."
    assert led(Answer(sentence="No gait."), [late]).sentence == "Too short: 1 s is left."
    assert led(alike, []) == alike
    remarks = Remarks()
    remarks(late)
    assert remarks.leading == (late,)
    assert not remarks.refused
    remarks(Refusal("no gait: sampled too seldom (log faster); nulls"))
    assert led(Answer(), remarks.leading).sentence == "Sampled too seldom."
    assert remarks.warnings() == (late, "no gait: sampled too seldom (log faster); nulls")
