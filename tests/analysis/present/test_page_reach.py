"""The page of an experiment in a real browser: by keyboard, in both schemes, on paper."""

import pytest

from undulog.analysis.present.page import render

pytestmark = pytest.mark.slow

PAGE_PX = (297 - 2 * 14) * 96 / 25.4
"""Height of an A4 page within its margins, in CSS pixels."""

CELLS = """
(() => {
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = 1;
  const context = canvas.getContext('2d', { willReadFrequently: true });
  const rgb = color => {
    context.fillStyle = color;
    context.fillRect(0, 0, 1, 1);
    return [...context.getImageData(0, 0, 1, 1).data].slice(0, 3);
  };
  const lum = color => {
    const [r, g, b] = rgb(color).map(v => v / 255)
      .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  return [...document.querySelectorAll('.row rect:not(.frame)')].map(rect => {
    const text = rect.parentElement.querySelector('text.value');
    const [a, b] = [lum(getComputedStyle(rect).fill), lum(getComputedStyle(text).fill)];
    return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  });
})()
"""


@pytest.fixture(scope="module")
def address(kicked, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "kicked.html"
    path.write_text(render(kicked), encoding="utf-8")
    return path.as_uri()


@pytest.mark.parametrize("dark", [False, True])
def test_numbers_stand_out_from_their_cells(browser, address, dark):
    # WCAG 2.2, success criterion 1.4.3, with the colours as the browser mixes them.
    browser.open(address, dark=dark)
    ratios = browser.evaluate(CELLS)
    assert len(ratios) == 25
    assert min(ratios) > 4.5
    assert max(ratios) > 1.5 * min(ratios), "the cells are not all of one colour"


def test_the_tab_key_reaches_every_row_and_shows_its_intervals(browser, address):
    browser.open(address)
    script = "(e => e.getAttribute('aria-label') || e.textContent)(document.activeElement)"
    seen = "[...document.querySelectorAll('.half')].map(t => getComputedStyle(t).visibility)"
    reached = []
    while len(reached) < 60 and not (reached and reached[-1].startswith("j2 follows")):
        browser.press("Tab")
        reached.append(browser.evaluate(script))
    assert reached[0] == "Skip to the answer"
    assert reached[-2].startswith("j1 follows: j1 ")
    assert "\N{PLUS-MINUS SIGN}" in reached[-1]
    assert browser.evaluate(seen) == [
        "visible" if row == 1 else "hidden" for row in range(5) for _ in range(5)
    ]


def test_on_paper_no_figure_is_cut_and_all_tables_are_there(browser, address):
    browser.open(address, width=696, media="print")
    figures = browser.evaluate(
        "[...document.querySelectorAll('figure')].map(f => "
        "[getComputedStyle(f).breakInside, f.getBoundingClientRect().height])"
    )
    assert len(figures) == 5
    for inside, height in figures:
        assert inside == "avoid"
        assert height < PAGE_PX
    shown = browser.evaluate(
        "[...document.querySelectorAll('details table')].every("
        "t => t.getBoundingClientRect().height > 0)"
    )
    assert shown, "what is folded on screen is unfolded on paper"
