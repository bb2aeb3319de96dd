"""Tables read and written as their dataclasses declare them."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import pytest

from undulog.capture.common.config import Key, Name, NonNegative, Positive, read, write
from undulog.capture.common.strict_table import Faults, StrictTable, at_least, at_most


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Part:
    size: Positive
    share: Annotated[float, at_least(0), at_most(1)] = 0.5


@dataclass(frozen=True)
class Whole:
    name: Name
    part: Part
    start: Annotated[tuple[float, float], Key("from")]
    number: Annotated[int, at_least(2)] = 3
    colour: Colour = Colour.RED
    spare: Part | None = None
    limit: NonNegative | None = None
    on: bool = True

    def contradictions(self):
        if self.limit is not None and self.limit < self.number:
            yield "limit", f"at least number = {self.number}"


def given(values):
    faults = Faults()
    return read(StrictTable(values, "", faults), Whole), [str(fault) for fault in faults.all()]


WHOLE = {"name": "a", "part": {"size": 2}, "from": [1, 2]}


def test_what_is_left_out_is_as_declared():
    assert given(WHOLE) == (Whole("a", Part(2.0), (1.0, 2.0)), [])


def test_what_is_written_reads_the_same():
    whole = Whole("a", Part(1.0), (1.0, 2.0), 4, Colour.BLUE, Part(3.0, 1.0), 5.0, on=False)
    values = write(whole)
    assert list(values)[:3] == ["name", "part", "from"]
    assert given({**values, "from": list(values["from"])}) == (whole, [])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"name": "1"}, "name: found"),
        ({"part": {}}, "part.size: found nothing; valid: a finite number > 0"),
        (
            {"spare": {"size": 1, "share": 2}},
            "spare.share: found 2; valid: a finite number >= 0 and <= 1",
        ),
        ({"from": [1]}, "from: found [1]; valid: an array of 2 finite numbers"),
        ({"number": 1}, "number: found 1; valid: a whole number >= 2"),
        ({"colour": "bleu"}, 'colour: found "bleu"; valid: red, blue (did you mean blue?)'),
        ({"limit": 1}, "limit: found 1; valid: at least number = 3"),
        ({"on": 1}, "on: found 1; valid: true or false"),
        ({"strat": 1}, "strat: found an unknown key; valid: name, part, from, number, colour"),
    ],
)
def test_each_fault_is_noted(change, fault):
    (text,) = given({**WHOLE, **change})[1]
    assert text.startswith(fault)
