"""Values and zoom of figures in a real browser: true to the results, by mouse and by keyboard."""

import math
import re

import numpy as np
import pytest

from undulog.analysis.common.formats import degrees, estimate
from undulog.analysis.present.page import render

pytestmark = pytest.mark.nightly

TIP = "(t => t.hidden ? null : t.textContent)(document.querySelector('.tip'))"
MARKS = """
(() => {
  const panel = document.querySelectorAll('#FIGURE [data-panel]')[PANEL];
  const middle = r => [r.x + r.width / 2, r.y + r.height / 2];
  const box = e => middle(e.getBoundingClientRect());
  const shown = e => getComputedStyle(e).display !== 'none';
  const [left, top, width, height] = JSON.parse(panel.dataset.panel).box;
  const m = panel.ownerSVGElement.getScreenCTM();
  const [x, y] = [m.e + m.a * left, m.f + m.d * top];
  const frame = [x, y, x + m.a * width, y + m.d * height];
  return {
    frame,
    marks: [...panel.querySelectorAll('g[clip-path] > use')].map(box),
    ticks: [...panel.querySelectorAll('.tick.y')].filter(shown)
      .map(t => [Number(t.querySelector('text').textContent.replace('\\u2212', '-')),
                 box(t.querySelector('use'))[1]]),
  };
})()
"""


@pytest.fixture(scope="module")
def address(snake, recorded, tmp_path_factory):
    from undulog.capture import Session

    path = tmp_path_factory.mktemp("page") / "snake.html"
    with Session.open(recorded) as session:
        path.write_text(render(snake, session), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def page(browser, address):
    browser.open(address)
    return browser


def panel(page, number, section="segments"):
    """Marks, ticks and frame of a panel on the screen, once it is in the middle of it."""
    page.evaluate(f"document.querySelector('[aria-labelledby={section}] svg').id = 'FIGURE'")
    page.evaluate(
        f"document.querySelectorAll('#FIGURE [data-panel]')[{number}]"
        ".scrollIntoView({block: 'center'})"
    )
    return page.evaluate(MARKS.replace("PANEL", str(number)))


@pytest.mark.parametrize("number", [0, 1])
def test_pointing_at_a_mark_shows_joint_value_interval_and_unit(page, snake, number):
    driven = [joint for joint in snake.joints if joint.gain.value is not None]
    marks = panel(page, number)["marks"]
    assert len(marks) == len(driven) == 13
    for joint, (x, y) in zip(driven, marks, strict=True):
        page.mouse("mouseMoved", x, y)
        lag = f"lag {estimate(degrees(joint.lag_rad), '°')}"
        what = lag if number else f"gain {estimate(joint.gain)}"
        assert page.evaluate(TIP).startswith(f"{joint.name}: {what}")
    page.mouse("mouseMoved", 5, 5)
    assert page.evaluate(TIP) is None


def test_a_drag_zooms_and_the_new_ticks_are_true(page, snake):
    before = page.evaluate("document.querySelector('[aria-labelledby=segments] svg').innerHTML")
    left, top, right, bottom = panel(page, 1)["frame"]
    width, height = right - left, bottom - top
    start = left + 0.3 * width, top + 0.05 * height
    stop = left + 0.8 * width, top + 0.55 * height
    page.mouse("mousePressed", *start, clicks=1)
    page.mouse("mouseMoved", *stop, clicks=1)
    page.mouse("mouseReleased", *stop, clicks=1)
    zoomed = panel(page, 1)
    driven = [joint for joint in snake.joints if joint.gain.value is not None]
    at_px = np.array([y for _, y in zoomed["marks"]])
    values, ticks_px = np.array(zoomed["ticks"]).T
    assert len(values) > 1
    slope, offset = np.polyfit(ticks_px, values, 1)
    lags = np.degrees([joint.lag_rad.value for joint in driven])
    np.testing.assert_allclose(slope * at_px + offset, lags, atol=0.02 * np.ptp(lags))
    inside = [x for x, y in zoomed["marks"] if left < x < right and top < y < bottom]
    assert 0 < len(inside) < len(driven)
    panel(page, 1)
    page.mouse("mousePressed", *start, clicks=1)
    page.mouse("mouseReleased", *start, clicks=1)
    page.mouse("mousePressed", *start, clicks=2)
    page.mouse("mouseReleased", *start, clicks=2)
    after = page.evaluate("document.querySelector('[aria-labelledby=segments] svg').innerHTML")
    assert positions(after) == pytest.approx(positions(before), abs=0.011)


def positions(svg):
    """Every coordinate of a figure, without the ring around the value."""
    shapes = re.sub(r'<rect class="ring".*?</rect>', "", svg)
    coordinates = re.findall(r' (?:d|x|y)="([^"]*)"', shapes)
    return [float(v) for text in coordinates for v in re.findall(r"-?\d+\.?\d*", text)]


def test_keys_walk_along_the_samples_and_zoom(page, snake):
    page.evaluate("document.querySelector('[aria-labelledby=signals] .wide').focus()")
    texts = []
    for _ in range(30):
        page.press("ArrowRight")
        texts.append(page.evaluate(TIP))
    assert page.evaluate("document.querySelector('.tip').getAttribute('aria-live')") == "polite"
    amplitude = math.degrees(snake.joints[0].command_amplitude_rad)
    for text in texts:
        values = re.fullmatch(r"joint01 command: (.+)° at (.+) s", text.replace("\u2212", "-"))
        value, at_s = map(float, values.groups())
        assert value == pytest.approx(amplitude * math.sin(math.pi * at_s), abs=0.02 * amplitude)
    times = "[...document.querySelectorAll('[aria-labelledby=signals] .tick.x text')]"
    times += ".filter(t => getComputedStyle(t.closest('.tick')).display !== 'none')"
    times += ".map(t => Number(t.textContent))"
    whole = page.evaluate(times)
    for _ in range(4):
        page.press("+")
    near = page.evaluate(times)
    assert max(near) - min(near) < 0.3 * (max(whole) - min(whole))
    assert page.evaluate(TIP) == texts[-1], "the value stays while the figure zooms"
    page.press("0")
    assert page.evaluate(times) == whole
    page.press("Escape")
    assert page.evaluate(TIP) is None


def test_the_buttons_are_reached_by_the_tab_key_and_zoom(page):
    page.evaluate("document.querySelector('[aria-labelledby=segments] .tools button').focus()")
    name = "document.activeElement.getAttribute('aria-label')"
    assert page.evaluate(name).startswith("Zoom in, Figure: gain, lag and energy")
    before = panel(page, 0)["marks"]
    page.evaluate("document.activeElement.click()")
    assert panel(page, 0)["marks"] != before
    page.press("Tab")
    assert page.evaluate(name).startswith("Zoom out, ")
    page.press("Tab")
    page.evaluate("document.activeElement.click()")
    np.testing.assert_allclose(panel(page, 0)["marks"], before, atol=1.0)


def test_cells_of_a_matrix_are_read_by_keys_and_by_mouse(browser, kicked, tmp_path):
    path = tmp_path / "kicked.html"
    path.write_text(render(kicked), encoding="utf-8")
    browser.open(path.as_uri())
    browser.evaluate("document.querySelector('[aria-labelledby=coupling] .wide').focus()")
    browser.press("ArrowRight")
    browser.press("ArrowRight")
    first = f"{kicked.coupling.P.value[0][1]:.3f}"[:4]
    assert browser.evaluate(TIP).startswith(f"j1 follows j2: {first}")
    place = browser.evaluate(
        "(r => [r.x + r.width / 2, r.y + r.height / 2])"
        "(document.querySelector('svg.matrix .row rect').getBoundingClientRect())"
    )
    browser.mouse("mouseMoved", *place)
    assert browser.evaluate(TIP).startswith("j1 follows j1: ")


def test_a_value_at_the_edge_of_a_narrow_screen_stays_on_it(browser, address):
    browser.open(address, width=400)
    browser.evaluate("document.querySelector('[aria-labelledby=segments] .wide').focus()")
    browser.press("ArrowRight")
    browser.press("ArrowLeft")  # the last value, scrolled into view
    left, right = browser.evaluate(
        "(r => [r.left, r.right])(document.querySelector('.tip').getBoundingClientRect())"
    )
    assert 0 <= left < right <= 400
    assert browser.evaluate("document.documentElement.scrollWidth") <= 400


def test_without_scripts_the_page_is_complete(browser, address):
    browser.open(address, scripts=False)
    assert browser.evaluate("document.querySelector('.tools')") is None
    titles = "document.querySelectorAll('[aria-labelledby=segments] g > title').length"
    assert browser.evaluate(titles) >= 26
    assert browser.evaluate("document.querySelectorAll('svg.figure').length") >= 2


def test_on_paper_there_is_nothing_to_press(browser, address):
    browser.open(address, width=696, media="print")
    shown = "[...document.querySelectorAll('.tools, .tip, nav, .skip')].filter(e => "
    assert browser.evaluate(f"{shown}getComputedStyle(e).display !== 'none').length") == 0
