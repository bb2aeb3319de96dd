"""Oscillators on the page: couplings of a chain, and patterns that the body relaxes."""

import dataclasses
import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from undulog.analysis import Estimate
from undulog.analysis.parts.oscillators.result import ChainCoupling, OscillatorLink, Rate
from undulog.analysis.present.oscillators import entrainment_entries
from undulog.analysis.present.page import render
from undulog.analysis.present.session_view import chain_view

pytestmark = pytest.mark.slow

LINKS = (
    OscillatorLink("a", "b", Estimate(2.0, (1.9, 2.1)), Estimate(0.5, (0.4, 0.6))),
    OscillatorLink("b", "a", Estimate(0.01, (0.0, 0.06)), Estimate()),
    OscillatorLink("b", "c", Estimate(3.0, (2.9, 3.1)), Estimate(-0.5, (-0.6, -0.4))),
)
RATES = tuple(Rate(name, Estimate(3.1, (3.0, 3.2)), Estimate(), 2e-7) for name in "abc")
CHAIN = ChainCoupling(
    "horizontal", True, "weak form", None, 55.0, 11, 60.0, 1, links=LINKS, oscillators=RATES
)
LOCKED = ChainCoupling(
    "vertical", False, "the phases are locked", "the chain kicked", None, 0, 60.0, 1
)


def numbers(page, table):
    body = re.search(rf'<table class="{table}">.*?<tbody>(.*?)</tbody>', page, re.DOTALL)[1]
    return [
        [float(v) for v in re.findall(r'<data value="([^"]+)"', row)]
        for row in re.findall(r"<tr>(.*?)</tr>", body, re.DOTALL)
    ]


@pytest.fixture(scope="module")
def page(snake):
    return render(dataclasses.replace(snake, oscillators=(CHAIN, LOCKED)))


def test_every_coupling_is_in_the_table(page):
    degrees = np.degrees([0.5, 0.4, 0.6])
    shown = numbers(page, "links")
    np.testing.assert_allclose(shown[0], [2.0, 1.9, 2.1, *degrees])
    assert shown[1] == [0.01, 0.0, 0.06]  # no lag where K does not differ from 0
    assert [row[0] for row in numbers(page, "rates")] == [3.1] * 3


def test_locked_phases_say_what_to_record(page):
    assert "The phases are locked." in page
    assert "The chain kicked." in page


def test_the_picture_leaves_out_what_was_not_looked_for():
    root = ET.fromstring(chain_view(CHAIN, "x")["matrix"].svg)
    rows = [g for g in root.iter("g") if g.get("class") == "row"]
    cells = [sum("style" in r.attrib for r in row.iter("rect")) for row in rows]
    assert cells == [1, 1, 1]  # who turns a, who turns b, who turns c
    assert "a is turned by: a –, b 0.010 ± 0.030, c –" in rows[0].get("aria-label")


def test_sessions_without_phases_have_no_such_section(snake):
    assert 'id="oscillators"' not in render(snake)


def test_patterns_of_a_kick_experiment_are_those_of_the_result(kicked):
    body = kicked.oscillators
    shown = numbers(render(kicked), "modes")
    assert [row[0] for row in shown] == [mode.real.value for mode in body.modes]
    assert [row[-1] for row in shown] == [mode.sensitivity for mode in body.modes]
    P = np.array(kicked.coupling.P.value)
    np.testing.assert_allclose(
        entrainment_entries(body).value, np.linalg.inv(P) - np.eye(5), atol=1e-12
    )
