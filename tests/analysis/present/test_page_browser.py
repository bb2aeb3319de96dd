"""The page in a real browser: silent, self-sufficient, readable in both schemes and when narrow."""

import base64
from functools import cache

import pytest

from undulog.analysis.present.page import render

SCHEMES = [pytest.param(False, id="light"), pytest.param(True, id="dark")]

PAGES = ["snake", "still", "single", "hostile", "both_ways", "kicked"]

CONTRAST = """
(() => {
  const parse = s => s.match(/[\\d.]+/g).map(Number);
  const lum = c => {
    const [r, g, b] = parse(c).slice(0, 3).map(v => v / 255)
      .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = e => {
    for (; e; e = e.parentElement) {
      const c = getComputedStyle(e).backgroundColor;
      if (parse(c)[3] !== 0) return c;
    }
  };
  const poor = [];
  const all = 'h1,h2,h3,p,li,td,th,dt,dd,a,figcaption,caption,code,svg text,.ci';
  for (const e of document.querySelectorAll(all)) {
    const style = getComputedStyle(e);
    const color = e.closest('svg') ? style.fill : style.color;
    const [a, b] = [lum(color), lum(behind(e))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < 4.5) poor.push([e.tagName, e.textContent.slice(0, 30), color, ratio]);
  }
  return poor;
})()
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory, request):
    """Writes the page on the named result, once, and returns its address."""

    @cache
    def write(name):
        path = tmp_path_factory.mktemp("page") / "page.html"
        path.write_text(render(request.getfixturevalue(name)), encoding="utf-8")
        return path.as_uri()

    return write


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("snake", "hostile"),
        *(
            pytest.param(x, marks=pytest.mark.nightly)
            for x in sorted({*PAGES} - {"snake", "hostile"})
        ),
    ],
)
def test_it_opens_without_a_word_and_asks_for_nothing(browser, address, name):
    url = address(name)
    browser.open(url)
    assert (browser.requests(), browser.complaints()) == ([url], [])


@pytest.mark.parametrize("dark", SCHEMES)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("snake", marks=pytest.mark.slow),
        pytest.param("both_ways", marks=pytest.mark.nightly),
        pytest.param("kicked", marks=pytest.mark.nightly),
    ],
)
def test_all_text_stands_out_from_its_ground(browser, address, name, dark):
    # WCAG 2.2, success criterion 1.4.3: 4.5 to 1.
    browser.open(address(name), dark=dark)
    ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (max(map(int, ground[4:-1].split(","))) < 64) == dark
    assert browser.evaluate(CONTRAST) == []


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 400, 820, 1280])
@pytest.mark.parametrize("name", ["snake", "both_ways", "kicked"])
def test_the_page_itself_never_scrolls_sideways(browser, address, name, width):
    browser.open(address(name), width=width)
    browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true })")
    assert browser.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 720])
@pytest.mark.parametrize("name", ["snake", "both_ways", "kicked"])
def test_no_label_of_a_figure_is_cut_off(browser, address, name, width):
    browser.open(address(name), width=width)
    outside = """
    [...document.querySelectorAll('svg text')].filter(t => {
      const a = t.getBoundingClientRect(), b = t.ownerSVGElement.getBoundingClientRect();
      return a.left < b.left - 1 || a.right > b.right + 1
          || a.top < b.top - 1 || a.bottom > b.bottom + 1;
    }).map(t => t.textContent)
    """
    assert browser.evaluate(outside) == []


@pytest.mark.slow
def test_the_tab_key_reaches_the_skip_link_first_and_every_figure(browser, address):
    browser.open(address("snake"))
    name = "(e => e.getAttribute('aria-label') || e.textContent)(document.activeElement)"
    reached = []
    while len(reached) == len(set(reached)) < 60:
        browser.press("Tab")
        reached.append(browser.evaluate(name))
    assert reached[0] == "Skip to the answer"
    assert any(label.startswith("Figure: gain, lag and energy") for label in reached)
    assert any(label.startswith("Table: response of every joint") for label in reached)


@pytest.mark.slow
def test_it_prints_on_white_with_its_figures(browser, address):
    browser.open(address("snake"), dark=True)
    printed = browser.call("Page.printToPDF", preferCSSPageSize=True)["data"]
    assert base64.b64decode(printed).startswith(b"%PDF-")
    browser.open(address("snake"), dark=True, media="print")
    ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == "rgb(255, 255, 255)"
    assert browser.evaluate("getComputedStyle(document.querySelector('nav')).display") == "none"
