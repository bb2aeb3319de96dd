"""The sentence claims what a test or an interval carries, and no more."""

import dataclasses

import pytest

from analysis.results.analysis import Index
from analysis.text.answer import Verdict, answer


def with_indices(analysis, **indices):
    return dataclasses.replace(analysis, heterogeneity=indices)


def contrast(value, low, high):
    return Index(value, (low, high), None, "rad", "lag, ends minus middle")


def test_the_paper_s_claim(snake):
    told = answer(snake)
    assert told.verdict is Verdict.UNLIKE
    assert told.sentence == (
        "The segments do not move alike: the middle yaw joints lag 6.20° [5.90, 6.50] more than "
        "the ends and gain spreads by 4.12 % [3.87, 4.40]."
    )
    assert "13 of 25 joints respond to a gait of 0.5000 Hz [0.4998, 0.5002]" in told.detail
    assert "lag runs from 7.5° (joint01) to 13.7° (joint13)" in told.detail
    assert "Flagged, see the table of joints: joint13 (saturated)." in told.detail


def test_late_ends_turn_the_sentence_round(snake):
    told = answer(with_indices(snake, boundary_contrast_lag=contrast(0.02, 0.01, 0.03)))
    assert "the ends yaw joints" not in told.sentence
    assert "the yaw joints at the ends lag" in told.sentence


def test_an_interval_over_zero_claims_nothing(snake):
    told = answer(with_indices(snake, boundary_contrast_lag=contrast(-0.01, -0.03, 0.01)))
    assert told.verdict is Verdict.OPEN
    assert told.sentence.startswith("No difference between the segments could be shown")


def test_a_spread_that_noise_explains_is_said_to_be_none(snake):
    spread = Index(0.0, (0.0, 0.064), 0.5, "1", "coefficient of variation of gain")
    told = answer(with_indices(snake, gain_cv=spread))
    assert "gain of the yaw joints spreads by no more than noise, 6.4 % at most" in told.sentence


def test_a_small_p_of_the_common_response_is_enough(snake):
    told = answer(with_indices(snake, common_response=Index(9.0, None, 0.01, "1", "F of H0")))
    assert told.verdict is Verdict.UNLIKE


def test_only_an_equivalence_test_says_alike(snake):
    gain = Index(0.001, None, 0.01, "1", "largest deviation from the mean; H1: gain within 2 %")
    lag = Index(
        0.001, None, 0.02, "rad", "largest deviation from the mean; H1: lag within 1 degree"
    )
    told = answer(
        with_indices(
            snake,
            boundary_contrast_lag=contrast(-0.002, -0.003, -0.001),  # sure, but too small to matter
            equivalence_gain=gain,
            equivalence_lag=lag,
        )
    )
    assert told.verdict is Verdict.ALIKE
    assert told.sentence.startswith(
        "The segments move alike, gain within 2 % and lag within 1 degree: "
    )
    doubtful = dataclasses.replace(lag, p=0.2)
    told = answer(with_indices(snake, equivalence_gain=gain, equivalence_lag=doubtful))
    assert told.verdict is Verdict.OPEN


def test_no_gait_gives_the_reason(still):
    told = answer(still)
    assert told.verdict is Verdict.NOTHING
    assert told.sentence == (
        "No gait was found in this session, so there is no gain and no lag to compare."
    )
    assert told.detail == still.warnings[0]


def test_one_joint_is_told_alone(single):
    told = answer(single)
    assert told.verdict is Verdict.SINGLE
    assert "its gain is 0.928 [0.924, 0.932], its lag 13.66° [13.45, 13.87]" in told.sentence


@pytest.mark.parametrize("name", ["snake", "still", "single", "hostile"])
def test_a_sentence_ends_with_one_stop(name, request):
    told = answer(request.getfixturevalue(name))
    for text in (told.sentence, told.detail):
        assert text.endswith(".")
        assert not text.endswith("..")
