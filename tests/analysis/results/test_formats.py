"""Numbers as people read them."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from undulog.analysis.common import formats
from undulog.analysis.common.estimate import Estimate
from undulog.capture.common.console import plain


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (0.97149, 3, "0.971"),
        (-0.016, 3, "−0.016"),
        (-0.0001, 2, "0.00"),  # no negative zero
        (12.0, 0, "12"),
        (None, 3, "–"),
        (float("nan"), 3, "–"),
        (float("inf"), 3, "–"),
        (-5.98e302, 5, "−5.98e+302"),
    ],
)
def test_number(value, decimals, text):
    assert formats.number(value, decimals) == text


@pytest.mark.parametrize(
    # The examples of the Particle Data Group's rounding rule (Review of Particle Physics, 5.3):
    # 0.827 +- 0.119 becomes 0.83 +- 0.12, and 0.827 +- 0.367 becomes 0.8 +- 0.4.
    ("half", "decimals"),
    [(0.119, 2), (0.367, 1), (0.0354, 3), (0.0355, 2), (2.9, 1), (41.0, 0)],
)
def test_decimals_follow_the_particle_data_group(half, decimals):
    quantity = Estimate(0.827, (0.827 - half, 0.827 + half))
    assert formats.decimals_for([quantity], least=0) == decimals


@pytest.mark.parametrize(
    ("quantity", "unit", "most", "text"),
    [
        (Estimate(6.2, (5.9, 6.5)), "°", 3, "6.20° [5.90, 6.50]"),
        (Estimate(6.2), "°", 1, "6.2°"),
        (Estimate(), "°", 3, "–"),
        (Estimate(1.0, (-0.01, 2.0)), "", 1, "1.0 [0.0, 2.0]"),  # it holds zero
        (Estimate(1.0, (0.01, 2.0)), "", 1, "1.00 [0.01, 2.00]"),
    ],
)
def test_an_estimate_prints_value_unit_and_interval(quantity, unit, most, text):
    assert formats.estimate(quantity, unit, most=most) == text


@given(st.floats(0.001, 1.0))
def test_a_printed_p_value_decides_as_the_p_value_does(p):
    assert (float(formats.p_value(p)) < formats.LEVEL) == (p < formats.LEVEL)


@given(st.floats(1e-4, 10.0), st.floats(1.1, 1e3), st.booleans())
def test_an_interval_that_excludes_zero_is_printed_so(end, ratio, negative):
    low, high = (-ratio * end, -end) if negative else (end, ratio * end)
    text = formats.estimate(Estimate((low + high) / 2, (low, high)), most=1)
    ends = text.replace(formats.MINUS, "-").partition("[")[2].rstrip("]").split(", ")
    assert all(float(end) != 0 for end in ends)


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100 %"), (0.9996, "99.9 %"), (0.98999, "98 %"), (0.5, "50 %"), (0.0, "0 %")],
)
def test_only_what_is_whole_is_covered_whole(share, text):
    assert formats.coverage(share) == text


def test_degrees_turn_value_and_interval():
    turned = formats.degrees(Estimate(0.1, (-0.1, 0.2)))
    assert turned.value == pytest.approx(5.729577951308232)
    assert turned.ci95 == pytest.approx((-5.729577951308232, 11.459155902616464))


@pytest.mark.parametrize(
    ("p", "text"),
    [
        (None, "–"),
        (0.0491, "0.049"),
        (0.04951, "0.0495"),  # decides, and 0.050 doesn't
        (0.049996, "0.049996"),
        (0.05, "0.050"),
        (0.0503, "0.050"),
        (1e-9, "< 0.001"),
        (1.0, "1.000"),
    ],
)
def test_p_value(p, text):
    assert formats.p_value(p) == text


def test_utc_of_the_epoch_of_unix_and_of_impossible_times():
    assert formats.utc(0) == "1970-01-01 00:00:00 UTC"
    assert formats.utc(1_767_225_600_999_999_999) == "2026-01-01 00:00:00 UTC"
    assert formats.utc(10**30) == f"{10**30} ns"


def test_short_keeps_both_ends():
    assert formats.short("joint01") == "joint01"
    assert formats.short("a" * 50 + "b" * 50, 11) == "aaaaa…bbbbb"


@given(st.text())
def test_plain_text_is_valid_xml_and_comes_back(text):
    from xml.etree import ElementTree as ET

    kept = plain(text)
    element = ET.Element("t")
    element.text = kept
    assert ET.fromstring(ET.tostring(element, encoding="unicode")).text == (kept or None)
    back = re.sub(
        r"\\(?:x..|u....|U.{8}|[nrt])", lambda m: m[0].encode().decode("unicode_escape"), kept
    )
    assert back == text or "\\" in text


@given(st.floats(-1e6, 1e6), st.integers(0, 6))
def test_a_printed_number_is_the_number_rounded(value, decimals):
    read = float(formats.number(value, decimals).replace("−", "-"))
    assert read == pytest.approx(value, abs=0.5000001 * 10.0**-decimals)
