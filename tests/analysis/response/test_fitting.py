"""What a fit of a gait says: whose joints, in which group, and one sentence for each doubt."""

from dataclasses import replace

import numpy as np
import pytest

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.common.remarks import Lacking, Note
from undulog.analysis.estimators.harmonic import fit_at
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.slow_changes import Coefficients, SlowChanges
from undulog.analysis.estimators.trends import Trend
from undulog.analysis.response.changes import Pace, ResponseChanges
from undulog.analysis.response.fitting import (
    GaitFit,
    _usable,
    fit_gait,
)
from undulog.analysis.response.gait_warnings import (
    _mixed,
    _needed,
    _within,
    warn_changes,
    warn_groups,
    warn_undriven,
)
from undulog.analysis.response.groups import Groups, MixedTone, Unresolved

T = np.arange(1000) / 100


def wave(name, omega=3.0, size=0.4, t=T, late=0.0):
    return Series(name, t, size * np.sin(omega * t - late))


def named(*series):
    return {channel.name: channel for channel in series}


def fitted(commands, responses, duration_s=10.0):
    notes = []
    return fit_gait(commands, responses, duration_s, notes.append), notes


def test_joints_are_listed_by_group():
    fit = fit_at([wave("a")], 3.0)
    small = GaitFit(fit, 0.1, 9.0, ("c", "d"), ("d",), None, {})
    whole = GaitFit(fit, 0.2, 9.0, ("a", "b"), ("b", "a"), None, {}, others=(small,))
    assert whole.groups == (replace(whole, others=()), small)
    assert whole.all_answered == ("b", "a", "d")
    assert [whole.group_of(name) for name in "abcdx"] == [0, 0, 1, 1, None]


def test_an_exact_gait_has_its_gain_lag_and_amplitudes():
    commands = named(wave("a"), wave("b", late=1.0, size=0.2), wave("still", size=0.0))
    responses = named(wave("b", late=1.3, size=0.18), wave("still"))
    gait, notes = fitted(commands, responses)
    assert (gait.driven, gait.answered) == (("a", "b"), ("b",))
    np.testing.assert_allclose(gait.response.gain, [0.9], rtol=1e-9)
    np.testing.assert_allclose(gait.response.lag_rad, [0.3], atol=1e-9)
    assert dict(gait.command_amplitudes) == pytest.approx({"a": 0.4, "b": 0.2, "still": 0.0})
    assert notes == ["1 joint is held still by the command, gain and lag are null: still"]
    assert isinstance(notes[0], Note)


def test_joints_without_samples_enough_are_named():
    late = T[:600]
    commands = named(
        wave("a"), wave("b"), wave("c", t=T[::100]), wave("d", t=late), wave("e", t=T[:400])
    )
    responses = named(
        wave("a", t=T[:16]), wave("b", size=0.3), wave("c"), wave("d", t=T[:700]), wave("e")
    )
    gait, notes = fitted(commands, responses)
    assert gait.answered == ("b",)
    assert any(
        text.endswith("commanded too seldom or too briefly, gain and lag are null: c, d, e")
        for text in notes
    )
    assert "too few response samples for a: gain and lag are null" in notes


def test_what_is_usable_is_long_and_dense():
    omega = 2 * np.pi
    assert _usable(wave("q", t=np.arange(300) / 100), omega)
    assert _usable(wave("q", t=np.arange(2991) / 1000), omega)
    assert not _usable(wave("q", t=np.arange(2989) / 1000), omega)
    assert not _usable(wave("q", t=np.arange(16) / 4), omega)
    assert _usable(wave("q", t=np.arange(17) / 4), omega)
    assert _usable(wave("q", t=np.arange(40) * 0.44), omega)
    assert not _usable(wave("q", t=np.arange(40) * 0.46), omega)
    assert not _usable(wave("q", t=np.arange(30) / 4), omega, 30)
    assert _usable(wave("q", t=np.arange(31) / 4), omega, 30)


def test_without_commands_the_responses_have_the_frequency():
    responses = named(wave("a"), wave("b", late=1.0), wave("still", size=0.0), wave("s", t=T[:16]))
    gait, notes = fitted({}, responses)
    assert gait.fit.omega == pytest.approx(3.0)
    assert gait.fit.count.tolist() == [1000.0, 1000.0]
    assert (gait.driven, gait.answered, gait.response, notes) == ((), (), None, [])
    assert gait.omega_error < 1e-6


def test_a_command_that_wanders_is_an_average():
    rng = np.random.default_rng(1)
    noise = 0.4 * 0.5**0.5 * np.sqrt(1 / 0.93 - 1) * rng.normal(size=T.size)
    loud = replace(wave("a"), values=wave("a").values + noise)
    _, notes = fitted(named(loud), {})
    (text,) = [text for text in notes if "one steady rhythm explains" in text]
    assert text.startswith("one steady rhythm explains 93 % of the commands' variance: gain")
    less = replace(loud, values=wave("a").values + 0.75 * noise)
    assert not any("one steady rhythm" in text for text in fitted(named(less), {})[1])


# -- sentences ------------------------------------------------------------------------------------


def test_a_value_in_words_has_its_interval():
    assert _within(Estimate(0.01234, (0.01, 0.02)), " %", 100.0) == "+1.23 % (+1 to +2)"
    assert _within(Estimate(-2.0), " s") == "-2 s"
    assert _within(Estimate(), "") == "+0"


def changes_of(trend=Trend.STEADY, cycles=16, effective=9.0, excess=0.5, **fields):
    level = Coefficients(np.array([1.0, 1.0, 0.0, 0.0]), np.zeros(4))
    change = Coefficients(np.array([0.01, 0.02, 0.0, 0.0]), np.full(4, 0.001))
    model = SlowChanges(
        trend,
        level,
        change,
        (4.0, 3.0, 5.0),
        0.0,
        (0.0, 0.0),
        False,
        9,
        excess,
        np.zeros((4, 9)),
        (0.1, 0.1),
        effective,
    )
    scatter = np.array([[0.0, 0.03], [0.01, 0.0]])
    return ResponseChanges(model, np.ones(2), excess, 2.0, cycles, scatter, None, **fields)


def words(changes, pace=None):
    notes = []
    warn_changes(changes, pace, ["a", "b"], notes.append)
    return notes


def test_changes_have_sentences():
    assert words(changes_of()) == words(None) == []
    (text,) = words(changes_of(Trend.DRIFTING))
    assert text.startswith(
        "not settled: the response of b drifts by +2 % (+1.9 to +2.1) in gain and "
    )
    assert "-0 degrees (-0.0573 to +0.0573) of lag per cycle" in text.replace("+0 deg", "-0 deg")
    (text,) = words(changes_of(Trend.SETTLING))
    assert "with a time constant of +8 s (+6 to +10), at the start b is off by +2 %" in text
    assert "the steady values" in text
    pace = Pace([], 0.02 * np.pi, 0.002 * np.pi)
    (text,) = words(None, pace)
    assert "frequency changes by +0.01 Hz/s (+0.009 to +0.011)" in text
    growing = replace(changes_of(), amplitude_drift=Estimate(0.01, (0.008, 0.012)))
    (text,) = words(growing)
    assert "amplitude changes by +1 % (+0.8 to +1.2) per cycle" in text
    assert isinstance(text, Note)


def test_variation_is_reported_where_it_is_clear():
    (text,) = words(changes_of(excess=0.0))
    assert "most at b (standard deviations 3 % and 0 degrees)" in text
    _, text = words(changes_of(excess=0.0, cycles=12, effective=2.0))
    assert "12 cycles show their means only as well as 2 independent" in text
    assert text.endswith("record at least 40 cycles")


def test_cycles_needed_are_tens_of_which_six_are_independent():
    for cycles, effective, needed in (
        (12, 2.0, 40),
        (20, 2.0, 60),
        (21, 2.0, 70),
        (4, 9.0, 20),
        (40, 9.0, 60),
        (40, 4.0, 60),
        (40, 3.0, 80),
    ):
        assert _needed(changes_of(cycles=cycles, effective=effective)) == needed


def test_joints_that_are_not_driven_are_named_by_why():
    notes = []
    warn_undriven(held=["a"], astray=["b", "c"], unusable=[], warn=notes.append)
    assert notes == [
        "1 joint is held still by the command, gain and lag are null: a",
        "2 joints are commanded something else than the common rhythm, gain and lag are null: b, c",
    ]
    assert [isinstance(text, Note) for text in notes] == [True, False]


def test_frequencies_that_are_too_close_are_named():
    fit = fit_at([wave("a")], 3.0)
    close = Unresolved(("a", "b"), ("c",), 0.95, 1.0)
    groups = Groups((), 1.0, (close, replace(close, left=())))
    notes = []
    warn_groups(groups, [fit], 12.0, notes.append)
    assert notes[0] == (
        "one group or two can't be decided: 3 joints are commanded at 0.95 to 1 Hz, closer than "
        "1.5/T in 12 s; gain and lag of c are null (record 30 s or more)"
    )
    assert "2 joints" in notes[1]
    assert "; they are analysed as one group (record" in notes[1]
    notes.clear()
    other = replace(fit, omega=6.0)
    warn_groups(Groups((), 1.0), [fit, other], 100.0, notes.append)
    (text,) = notes
    assert "commensurate within 1.5/T: 0.9549 Hz - 0.4775 Hz falls on 0.4775 Hz; 2 x" in text


def test_mixed_tones_are_named_by_their_frequencies():
    names = ["1 Hz", "2 Hz", "3 Hz"]
    assert _mixed(MixedTone(1, {0: -1, 2: 3}), names) == "3 x 3 Hz - 1 Hz falls on 2 Hz"
    assert _mixed(MixedTone(0, {0: 2, 1: 1}), names) == "2 x 1 Hz + 2 Hz falls on 1 Hz"


def test_what_never_moves_is_named_by_its_kind():
    still = named(Series("a", T, np.ones(T.size)))
    for commands, responses, kind in ((still, {}, "commands"), ({}, still, "responses")):
        gait, notes = fitted(commands, responses)
        assert gait is None
        assert notes[0].startswith(f"no gait: the {kind} never move")


def test_a_gait_explains_at_least_four_fifths():
    rng = np.random.default_rng(2)
    noise = rng.normal(size=T.size)
    for share, there in ((0.82, True), (0.78, False)):
        loud = wave("a").values + 0.4 * 0.5**0.5 * np.sqrt(1 / share - 1) * noise
        gait, notes = fitted(named(Series("a", T, loud)), {})
        assert (gait is not None) is there
        assert there or isinstance(notes[0], Lacking)
