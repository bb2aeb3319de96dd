"""Artefacts of a position that mean that its joint does not follow."""

import pytest

from undulog.analysis.results.answer import Artefact
from undulog.analysis.segments.session import Following, not_following


@pytest.mark.parametrize(
    ("span_s", "since_s", "until_s"), [((1.0, 9.5), None, None), ((4.0, 9.0), 4.0, 9.0)]
)
def test_a_joint_whose_values_are_old_is_named(span_s, since_s, until_s):
    old = Artefact("j2", "/joint_states", "position", "stale", (span_s,))
    (found,) = not_following(Following((), {}, {}), [old], ("j1", "j2"), 10.0)
    assert (found.joint, set(found.kinds)) == ("j2", {"stale_sensor", "lost_samples"})
    assert (found.since_s, found.until_s) == (since_s, until_s)
