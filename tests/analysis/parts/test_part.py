"""The order of the parts of an analysis follows from what they name, and from nothing else."""

import re
from dataclasses import dataclass, field, replace
from itertools import permutations

import pytest

from undulog.analysis.parts.part import Part, Results, in_order, measure
from undulog.capture.common.errors import UsageError


def part(name, *needs, reads=()):
    return Part(name, lambda signals, done, remarks: name, needs, reads)


def names(*parts, chosen=None):
    return [part.name for part in in_order(parts, chosen)]


CHAIN = part("gait"), part("energy", "gait"), part("answer", "energy", "gait")


@pytest.mark.parametrize("parts", list(permutations(CHAIN)))
def test_each_comes_after_what_it_needs(parts):
    assert names(*parts) == ["gait", "energy", "answer"]


def test_others_keep_their_order():
    free = [part(name) for name in "dacb"]
    assert names(*free) == ["d", "a", "c", "b"]
    late = part("first", "c")
    assert names(late, *free) == ["d", "a", "c", "first", "b"]


def test_a_choice_brings_what_it_needs_and_not_what_it_would_read():
    answer = part("answer", "gait", reads=("energy",))
    everything = (answer, part("energy", "gait"), part("gait"), part("body"))
    assert names(*everything, chosen={"answer"}) == ["gait", "answer"]
    assert names(*everything, chosen={"answer", "energy"}) == ["gait", "energy", "answer"]
    assert names(*everything) == ["gait", "energy", "answer", "body"]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((part("gait"), part("gait")), "one name: gait"),
        ((part("energy", "gait"),), "part 'energy' needs the part 'gait'"),
        ((part("a", "b"), part("b", "a")), "circle: a -> b -> a|circle: b -> a -> b"),
        ((part("a", "a"),), "circle: a -> a"),
    ],
)
def test_parts_that_have_no_order(parts, message):
    with pytest.raises(UsageError, match=message):
        in_order(parts)


def test_a_choice_that_is_not_there():
    with pytest.raises(UsageError, match="the choice of parts needs the part 'gaits'"):
        in_order(CHAIN, {"gaits"})


@dataclass
class Numbers:
    """Signals of a number, and what was released."""

    number: int = 1
    released: list[bool] = field(default_factory=list)

    def release(self, *, commands):
        self.released.append(commands)


def test_a_part_reads_what_it_names_and_no_more():
    signals = Numbers()
    gait = Part("gait", lambda signals, done, remarks: signals.number + 1, of_commands=True)
    energy = Part("energy", lambda signals, done, remarks: 10 * done[gait], ("gait",))
    spy = Part("spy", lambda signals, done, remarks: done[energy], ("gait",))
    done = measure((gait, energy), signals, None)
    assert (done[gait], done[energy]) == (2, 20)
    with pytest.raises(KeyError, match=re.escape("'spy' reads 'energy': name it in its 'needs'")):
        measure((gait, energy, spy), signals, None)


def test_commands_are_held_until_the_last_part_that_reads_them():
    signals = Numbers()
    parts = [replace(part(name), of_commands=name in "bc") for name in "abcd"]
    measure(parts, signals, None)
    assert signals.released == [False, False, True, False]


def test_a_result_that_may_be_missing_has_a_default():
    gait, body = part("gait"), part("body")
    assert Results({"gait": 3}).get(gait, 0) == 3
    assert Results({"gait": 3}).get(body, 0) == 0
    with pytest.raises(KeyError, match="'answer' reads 'body'"):
        Results({"body": 1}, {"gait"}, "answer").get(body, 0)
