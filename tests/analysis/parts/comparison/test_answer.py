"""The sentence claims what a test or an interval carries, and no more; what acts comes first."""

import dataclasses

import pytest

from undulog.analysis.common.answer import NotFollowing, Shape, StandOut, Verdict
from undulog.analysis.parts.artefacts.result import Artefact
from undulog.analysis.parts.comparison.answer import Facts, compose
from undulog.analysis.parts.comparison.examine import Findings
from undulog.analysis.parts.comparison.words import kinds_in_words

YAW = tuple(f"joint{k:02d}" for k in range(1, 26, 2))


def facts(analysis, commanded=YAW, not_following=(), **findings):
    findings.setdefault("compared", YAW)
    return Facts(
        gait=analysis.gait,
        joints=analysis.joints,
        commanded=tuple(commanded),
        not_following=tuple(not_following),
        findings=Findings(**findings),
        warnings=analysis.warnings,
    )


def ends(value, low, high, quantity="lag"):
    return Shape("ends", quantity, "horizontal", 0, value, (low, high))


JAMMED = NotFollowing("joint07", ("jammed", "frozen_sensor"), 7.4, None, 0.5, "stands still")
WEAK = StandOut("joint11", "horizontal", 0, 1, "gain", -0.2, (-0.22, -0.18))


def test_the_paper_s_claim(snake):
    answer = snake.answer
    assert (answer.verdict, answer.alike) == (Verdict.UNLIKE, False)
    assert answer.sentence == (
        "The segments do not move alike: the middle yaw joints lag 6.20° [5.90, 6.50] more than "
        "the ends."
    )
    for part in (
        "13 of 25 joints respond to a gait of 0.5000 Hz [0.4998, 0.5002]",
        "lag runs from 7.5° (joint01) to 13.7° (joint13)",
        "Flagged, see the table of joints: joint13 (saturated).",
    ):
        assert part in answer.detail


def test_late_ends_turn_the_sentence_round(snake):
    answer = compose(facts(snake, shape=(ends(0.02, 0.01, 0.03),)))
    assert "the yaw joints at the ends lag" in answer.sentence


def test_without_a_shape_nothing_is_claimed(snake):
    answer = compose(facts(snake))
    assert (answer.verdict, answer.alike) == (Verdict.OPEN, None)
    assert answer.sentence == "No difference between the segments could be shown."


def test_a_joint_that_does_not_follow_comes_first(snake):
    answer = compose(facts(snake, not_following=[JAMMED], stand_out=(WEAK,), alike=True))
    first, _, rest = answer.sentence.partition(". ")
    assert first == (
        "joint07 does not follow its command from 7.4 s on: jammed or a frozen sensor; joint11 "
        "responds differently from the others, gain 20.0 % [18.0, 22.0] less"
    )
    assert "move alike" in rest
    assert (answer.verdict, answer.alike) == (Verdict.UNLIKE, False)


def test_alike_needs_every_commanded_joint(snake):
    answer = compose(facts(snake, alike=True))
    assert (answer.verdict, answer.alike) == (Verdict.ALIKE, True)
    assert answer.sentence.startswith("The segments move alike: all 13 joints are within 2 %")
    answer = compose(facts(snake, alike=True, compared=YAW[1:]))
    assert (answer.verdict, answer.alike) == (Verdict.OPEN, None)


def test_too_few_joints_decide_no_name(snake):
    answer = compose(facts(snake, undecided=(("horizontal", 0),)))
    assert answer.undecided == (
        "the yaw joints differ, but with fewer than 4 sound ones it can't be decided which one"
    )
    assert not any(name in answer.sentence for name in YAW)
    assert answer.alike is False


def test_many_names_are_counted(snake):
    several = [dataclasses.replace(JAMMED, joint=name) for name in YAW[:7]]
    answer = compose(facts(snake, not_following=several))
    assert "joint09, joint11, joint13 do not follow either" in answer.sentence


def test_no_gait_gives_the_reason(still):
    answer = still.answer
    assert answer.verdict is Verdict.NOTHING
    assert answer.sentence == (
        "No gait was found in this session, so there is no gain and no lag to compare."
    )
    assert answer.detail == still.warnings[0]


def test_one_joint_is_described_alone(single):
    answer = single.answer
    assert answer.verdict is Verdict.SINGLE
    assert "its gain is 0.928 [0.924, 0.932], its lag 13.66° [13.45, 13.87]" in answer.sentence


def test_kinds_are_listed_with_or():
    assert kinds_in_words(("jammed", "dead", "frozen_sensor")) == "jammed, dead or a frozen sensor"
    assert kinds_in_words(("inverted",)) == "inverted"


@pytest.mark.parametrize("name", ["snake", "still", "single", "hostile"])
def test_a_sentence_ends_with_one_stop(name, request):
    answer = request.getfixturevalue(name).answer
    for text in (answer.sentence, answer.detail):
        assert text.endswith(".")
        assert not text.endswith("..")


def test_ends_that_their_neighbours_do_not_follow_are_left_open(snake):
    shape = Shape("ends", "gain", "horizontal", 0, -0.03, (-0.04, -0.02))
    answer = compose(facts(snake, shape=(shape,), boundary=((YAW[0], YAW[-1]),)))
    both = "the boundary or joint01 and joint25: reverse, swap modules, or compare with an earlier"
    assert f"({both} session)." in answer.sentence
    assert answer.undecided.startswith(both)
    assert not answer.stand_out


def test_an_end_joint_alone_may_be_the_boundary_s_doing(snake):
    end = dataclasses.replace(WEAK, joint=YAW[0])
    answer = compose(facts(snake, stand_out=(end,)))
    assert "gain 20.0 % [18.0, 22.0] less: the joint or the boundary." in answer.sentence
    assert "the joint or the boundary" not in compose(facts(snake, stand_out=(WEAK,))).sentence


def test_a_velocity_of_another_scale_is_said(snake):
    note = "2.33 times the derivative of the position"
    odd = Artefact("joint05", "/joint_states", "velocity", "scale_mismatch", (), note)
    answer = compose(dataclasses.replace(facts(snake), artefacts=(odd,)))
    assert answer.sentence.endswith(f"joint05's velocity is {note}.")
