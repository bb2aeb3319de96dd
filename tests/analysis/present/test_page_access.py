"""The page as assistive technology gets it: Chromium's accessibility tree; and on paper."""

import base64
import dataclasses
import re
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from undulog.analysis.present.page import render
from undulog.analysis.results.coupling import Coupling

PAGES = [
    *("snake", "hostile"),
    pytest.param("swept", marks=pytest.mark.slow),
    *(
        pytest.param(name, marks=pytest.mark.nightly)
        for name in ("both_ways", "kicked", "still", "single")
    ),
]


@pytest.fixture(scope="module", params=PAGES)
def address(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / f"{request.param}.html"
    path.write_text(render(request.getfixturevalue(request.param)), encoding="utf-8")
    return path.as_uri()


def nodes(browser):
    """Nodes of the tree that are not ignored: role, name, properties."""
    browser.call("Accessibility.enable")
    try:
        reply = browser.call("Accessibility.getFullAXTree")["nodes"]
    finally:
        browser.call("Accessibility.disable")
    return [
        (
            node["role"]["value"],
            node.get("name", {}).get("value", "").strip(),
            {p["name"]: p["value"].get("value") for p in node.get("properties", [])},
        )
        for node in reply
        if not node["ignored"]
    ]


@pytest.mark.nightly
def test_everything_that_is_reached_has_a_name_and_a_place(browser, address):
    browser.open(address)
    browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true })")
    tree = nodes(browser)
    named = {"image", "button", "link", "region", "navigation", "group", "heading", "article"}
    roles = Counter(role for role, *_ in tree)
    nameless = [
        (role, properties)
        for role, name, properties in tree
        if not name and (role in named - {"group"} or properties.get("focusable") is True)
    ]
    # The document and what scrolls have names, too; text to copy is its own name.
    assert [node for node in nameless if node[0] not in ("RootWebArea", "code", "generic")] == []
    assert roles["main"] == roles["contentinfo"] == roles["navigation"] == 1
    regions = [name for role, name, _ in tree if role == "region"]
    assert [regions.index(part) for part in ("Question", "Answer")] == [0, 1]
    assert [region for region in regions if region in ("Evidence", "Limits", "Method")] == [
        *("Evidence", "Limits", "Method")
    ]
    levels = [properties["level"] for role, _, properties in tree if role == "heading"]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert roles["columnheader"] >= roles["table"] > 0
    assert roles["rowheader"] > 0


@pytest.mark.nightly
def test_figures_have_name_and_description(browser, address):
    browser.open(address)
    tree = nodes(browser)
    images = [name for role, name, _ in tree if role == "image"]
    drawn = browser.evaluate("document.querySelectorAll('svg.figure, svg.map').length")
    assert len(images) >= drawn
    assert all(len(name.split()) > 1 for name in images)
    described = browser.evaluate(
        "[...document.querySelectorAll('svg[role]')].map(s => "
        "document.getElementById(s.getAttribute('aria-describedby')).textContent)"
    )
    assert all(len(text.split()) > 3 for text in described)


PORTRAIT_PX = (210 - 2 * 13) * 96 / 25.4
LANDSCAPE_PX = (297 - 2 * 12) * 96 / 25.4
BEYOND = """
[...document.querySelectorAll('main *')].filter(e => !e.closest('.broad, .hidden, svg *')
  && e.getBoundingClientRect().right > innerWidth + 1)
  .map(e => [e.tagName, e.className, e.getBoundingClientRect().right])
"""


@pytest.mark.nightly
def test_on_paper_nothing_is_cut(browser, address):
    browser.open(address, width=int(PORTRAIT_PX), media="print")
    assert browser.evaluate(BEYOND) == []
    browser.open(address, width=int(LANDSCAPE_PX), media="print")
    assert browser.evaluate(BEYOND.replace(".broad, ", "")) == []


@pytest.mark.nightly
def test_a_broad_matrix_has_a_page_across_and_is_not_cut(browser, snake, tmp_path):
    rng = np.random.default_rng(3)
    for count in (25, 60):
        matrix = tuple(map(tuple, rng.normal(size=(count, count)).tolist()))
        coupling = Coupling(True, "local kicks around one gait", None, matrix, 3.4)
        path = tmp_path / f"{count}.html"
        path.write_text(render(dataclasses.replace(snake, coupling=coupling)), encoding="utf-8")
        browser.open(path.as_uri(), width=int(LANDSCAPE_PX), media="print")
        assert browser.evaluate("document.querySelectorAll('.broad table').length") == 1
        assert browser.evaluate(BEYOND.replace(".broad, ", "")) == []
        browser.open(path.as_uri())
        printed = browser.call("Page.printToPDF", preferCSSPageSize=True)["data"]
        boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", base64.b64decode(printed))
        across = [float(width) > float(height) for width, height in boxes]
        assert 1 <= sum(across) < len(across) / 2
        browser.open(path.as_uri(), width=400)
        assert browser.evaluate("document.documentElement.scrollWidth") <= 400
