"""The order in which the parts of a session's analysis are measured."""

import pytest

from undulog.analysis.parts.part import in_order
from undulog.analysis.session.parts import PARTS

ORDER = (
    "judgement artefacts gait dead_band frequency_response tracking gaits energies joints energy "
    "over_time body ground_contact heterogeneity comparison free_motion closed_loop oscillators"
)
"""In which remarks have always come."""


def names(parts):
    return " ".join(part.name for part in parts)


def test_remarks_come_in_their_order():
    assert names(in_order(PARTS)) == ORDER


@pytest.mark.parametrize(
    ("asked", "measured"),
    [
        ("gait", "judgement artefacts gait"),
        ("free_motion", "judgement artefacts gait body free_motion"),
        ("joints", "judgement artefacts gait tracking energies joints"),
        ("comparison", "judgement artefacts gait tracking gaits energies joints comparison"),
        ("oscillators", "oscillators"),
    ],
)
def test_what_is_asked_for_brings_what_it_needs(asked, measured):
    assert names(in_order(PARTS, {asked})) == measured


def test_only_a_few_parts_read_the_samples_of_the_commands():
    """They are as large as those of the positions, and are released after the last of these."""
    of_commands = [part.name for part in in_order(PARTS) if part.of_commands]
    assert of_commands == ["gait", "dead_band", "frequency_response", "tracking"]
