"""A figure as clean, themed, deterministic SVG."""

import re
from xml.etree import ElementTree as ET

import matplotlib as mpl
import pytest

from undulog.analysis.present import svg


def draw(prefix="p", text="lag [°]", **options):
    with svg.drawing(3, 4) as figure:
        axes = figure.subplots()
        axes.plot([1, 2, 3], [1, 5, 2], "o-", color=svg.INK, gid="curve")
        axes.set_xlabel(text)
        return svg.inline_svg(figure, prefix=prefix, title="T", description="D", **options)


def test_two_figures_on_a_page_share_no_identifier():
    ids = [set(re.findall(r'id="([^"]+)"', draw(prefix))) for prefix in ("a", "b")]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_every_reference_points_into_the_figure():
    drawn = draw()
    ids = set(re.findall(r'\bid="([^"]+)"', drawn))
    targets = re.findall(r'href="([^"]+)"', drawn) + re.findall(r"url\(([^)]+)\)", drawn)
    assert targets
    assert all(target[0] == "#" and target[1:] in ids for target in targets)


def test_same_figure_same_bytes_whatever_the_reader_has_set():
    first = draw()
    with mpl.rc_context({"font.size": 20, "lines.linewidth": 9, "svg.hashsalt": "other"}):
        assert draw() == first


def test_no_metadata_no_date_no_font_no_sentinel_is_left():
    drawn = draw()
    for word in ("metadata", "rdf", "matplotlib", "DejaVu", "font-family", "<style", "#010101"):
        assert word not in drawn
    assert "var(--ink)" in drawn


def test_title_description_role_and_tooltips():
    root = ET.fromstring(draw(tooltips={"curve": "joint01: gain 1"}))
    assert root.get("role") == "img"
    named = {e.get("id"): e.text for e in root.iter() if e.get("id")}
    assert named[root.get("aria-labelledby")] == "T"
    assert named[root.get("aria-describedby")] == "D"
    assert [g.find("title").text for g in root.iter("g") if g.find("title") is not None] == [
        "joint01: gain 1"
    ]


@pytest.mark.parametrize("text", ["$\\frac{a}{b$", "</svg><script>x</script>", "蛇 \x07"])
def test_hostile_text_stays_text(text):
    root = ET.fromstring(draw(text=svg.plain(text)))
    assert svg.plain(text) in [t.text for t in root.iter("text")]
    assert root.find(".//script") is None
