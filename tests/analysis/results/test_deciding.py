"""What decides is printed so that it decides."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from undulog.analysis.common.answer import beyond, distinct, percent


@pytest.mark.parametrize(
    ("share", "limit", "text"),
    [
        (0.7999, 0.8, "79.99 %"),
        (0.796, 0.8, "79.6 %"),
        (0.31, 0.8, "31 %"),
        (0.8, 0.8, "80 %"),
        (0.01004, 0.01, "1.004 %"),
        (0.0, 0.8, "0 %"),
    ],
)
def test_shares(share, limit, text):
    assert percent(share, limit) == text


def test_numbers():
    assert (beyond(100.4, 100), beyond(250.0, 100)) == ("100.4", "2.5e+02")
    assert distinct(0.5, 0.5025) == ("0.5", "0.5025")
    assert distinct(0.95400001, 0.954) == ("0.95400001", "0.954")
    assert distinct(0.5, 0.5) == ("0.5", "0.5")


@given(st.floats(0, 1), st.floats(0.001, 1))
def test_a_printed_value_is_on_its_side_of_the_limit(value, limit):
    if abs(value - limit) > 1e-9 * limit:
        assert (float(beyond(value, limit)) > limit) == (value > limit)
        assert (float(percent(value, limit).removesuffix(" %")) / 100 > limit) == (value > limit)
