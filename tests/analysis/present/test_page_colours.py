"""Colours of the page for readers with a colour vision deficiency, and contrast of its text."""

import re
from itertools import combinations

import pytest

from support.colour_vision import DEFICIENCIES, contrast, difference, seen
from support.paths import ROOT
from undulog.analysis.present.bode import JOINTS, MARKERS
from undulog.analysis.present.svg import COMMAND
from undulog.capture.common.palette import joint_hex

STYLE = (ROOT / "analysis/present/templates/style.css").read_text(encoding="utf-8")
SCHEMES = [
    dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", block))
    for block in re.findall(r":root \{(.*?)\}", STYLE, re.DOTALL)[:2]
]


@pytest.mark.parametrize(
    ("first", "other", "expected"),
    [  # G. Sharma, W. Wu, E. N. Dalal, Color Research and Application 30 (2005), Table 1.
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
        ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_difference_is_ciede2000(first, other, expected):
    assert difference(first, other) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
@pytest.mark.parametrize("scheme", SCHEMES, ids=["light", "dark"])
def test_both_signs_of_a_matrix_differ(deficiency, scheme):
    plus, minus = (seen(scheme[name], deficiency) for name in ("plus", "minus"))
    assert difference(plus, minus) > 40
    paper = seen(scheme["paper"], deficiency)
    assert min(difference(plus, paper), difference(minus, paper)) > 15


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
@pytest.mark.parametrize(("count", "least"), [(2, 40), (3, 15), (JOINTS, 5)])
def test_joints_of_a_figure_differ(deficiency, count, least):
    colors = [seen(color, deficiency) for color in joint_hex(count)]
    assert min(difference(*pair) for pair in combinations(colors, 2)) > least


def test_what_colour_alone_does_not_distinguish_has_a_line_or_marker_of_its_own():
    # Green and grey are alike for deutan readers, and neighbours of six are for most.
    assert difference(seen(joint_hex(3)[1], "deutan"), seen("#8c8c8c", "deutan")) < 5
    assert COMMAND["linestyle"] != "-"
    assert len(set(MARKERS)) == JOINTS


@pytest.mark.parametrize("scheme", SCHEMES, ids=["light", "dark"])
def test_text_has_the_contrast_of_wcag(scheme):
    # WCAG 2.2, success criterion 1.4.3, on every ground that the style has.
    for ground in ("paper", "raised", "warn-paper"):
        for text in ("ink", "muted", "link"):
            assert contrast(scheme[text], scheme[ground]) >= 4.5
    assert contrast(scheme["ink"], scheme["paper"]) >= 7
