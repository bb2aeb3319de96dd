"""Statements against truths, on closed cases."""

import pytest

from zoo.adapter import Accused, Different, Said
from zoo.planted import PlantedJoint
from zoo.verdicts import judged

NAMES = ("a1", "a2", "a3")
JAM = PlantedJoint(1, frozenset({"jammed"}), frozenset({"jammed", "dead"}), since_s=10.0)
WEAK = PlantedJoint(
    1, frozenset({"weak"}), frozenset({"weak"}), frozenset({"gain"}), -1.0, since_s=None
)


def statement_of(*accused, different=(), sentence=None, **more):
    names = [a.joint for a in accused] + [d.joint for d in different]
    text = " ".join(names) if sentence is None else sentence
    usual = {"shaped": False, "alike": False, "not_decided": False} | more
    return Said(tuple(accused), tuple(different), sentence=text, **usual)


def accused(joint="a2", kinds=("jammed", "dead"), since_s=10.4):
    return Accused(joint, frozenset(kinds), since_s, None)


def judge(statement, *joints, **more):
    return judged(statement, NAMES, joints, period_s=1.0, length_s=20.0, **more)


def test_a_right_accusation():
    verdict = judge(statement_of(accused()), JAM)
    assert verdict.right
    assert not verdict.silent


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"kinds": ("dead",)}, "kind"),
        ({"kinds": ("jammed", "inverted")}, "kind"),
        ({"since_s": 12.1}, "onset"),
        ({"since_s": None}, "onset"),
        ({"joint": "a3"}, "joint"),
    ],
)
def test_a_wrong_accusation(change, wrong):
    verdict = judge(statement_of(accused(**change)), JAM)
    assert not getattr(verdict, wrong)
    assert verdict.right == (wrong == "onset")


def test_an_accusation_that_the_sentence_does_not_have():
    assert not judge(statement_of(accused(), sentence="a1 a22"), JAM).joint


def test_a_sound_joint_beside_the_right_one():
    verdict = judge(statement_of(accused(), accused("a3")), JAM)
    assert verdict.joint
    assert verdict.accusations == ("a3",)
    assert not verdict.right


def test_a_difference_names_quantity_and_sign():
    less, more = (Different("a2", "gain", value, None) for value in (-0.2, 0.2))
    assert judge(statement_of(different=[less]), WEAK).right
    assert not judge(statement_of(different=[more]), WEAK).right
    assert not judge(statement_of(different=[Different("a2", "lag", -0.2, None)]), WEAK).kind
    late = PlantedJoint(1, WEAK.names, WEAK.allowed, WEAK.quantities, -1.0, since_s=20.0)
    assert not judge(statement_of(different=[less]), late).onset
    assert judge(statement_of(different=[Different("a2", "gain", -0.2, 20.9)]), late).onset


def test_silence_and_alike_are_misses():
    verdict = judge(statement_of(not_decided=True), WEAK)
    assert verdict.silent
    assert not verdict.right
    assert not judge(statement_of(alike=True), WEAK).right


def test_what_cannot_be_decided_may_be_left_open():
    ends = [PlantedJoint(j, WEAK.names, WEAK.allowed, WEAK.quantities, -1.0) for j in (0, 2)]
    assert judge(statement_of(not_decided=True), *ends, undecidable=True).right
    assert not judge(statement_of(not_decided=True), *ends).right
    assert not judge(statement_of(alike=True), *ends, undecidable=True).right
    lone = statement_of(different=[Different("a1", "gain", -0.2, None)])
    assert not judge(lone, *ends, undecidable=True).right
    both = statement_of(different=[Different(name, "gain", -0.2, None) for name in ("a1", "a3")])
    assert judge(both, *ends, undecidable=True).right


def test_a_healthy_robot():
    assert judge(statement_of(alike=True)).accusations == ()
    verdict = judge(statement_of(accused(), different=[Different("a1", "lag", 0.1, None)]))
    assert verdict.accusations == ("a2",)
    assert verdict.differences == ("a1",)
    assert not verdict.shaped
    assert judge(statement_of(shaped=True)).shaped
