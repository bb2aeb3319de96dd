"""The web viewer in a real Chromium draws what the native one does, with another renderer.

Chromium draws by WebGL on SwiftShader, the native viewer by Vulkan on the machine's driver: two
rasterisers that know nothing of each other.
"""

import base64
import io

import numpy as np
import pytest
from PIL import Image

import undulog
from support import golden_pictures
from support.processes import served_page, wait_for

pytestmark = pytest.mark.nightly

WIDTH, HEIGHT = 1440, 900
SECONDS = 1.0
# Parts of the window as (top, bottom, left, right) [pixels]. Left out: the title bars, which
# differ, the lane of modes, whose colours the viewer makes up, and words, which wrap otherwise.
PARTS = {
    "body": (92, 588, 0, 752),
    "angles": (92, 352, 757, WIDTH),
    "power": (382, 582, 757, WIDTH),
    "response": (612, 868, 757, WIDTH),
}
REACH = 3
"""How far the two place a line differently where it is steep [pixels]."""
PLAY = (27, 886)
"""Its button [pixels], blue while it plays."""


@pytest.fixture(scope="module")
def native(show, rgb, tmp_path_factory):
    """The native viewer's picture."""
    path = tmp_path_factory.mktemp("native") / "session.rrd"
    assert undulog.run(["view", str(golden_pictures.SESSION), "--save", str(path)]) == 0
    return rgb(show(path, SECONDS).picture())


@pytest.fixture
def address(tmp_path):
    """Where ``undulog view --web`` serves the session, until the test is over."""
    with served_page(golden_pictures.SESSION, tmp_path) as (_, line):
        yield line


def part(picture, name):
    top, bottom, left, right = PARTS[name]
    return picture[top:bottom, left:right]


def glows(picture):
    """How many pixels are vermilion, which only the body's power is here."""
    return golden_pictures.glowing(part(picture, "body")).sum()


class Page:
    """Rerun's page in a browser."""

    def __init__(self, browser, address):
        self._browser = browser
        browser.open(f"{address}&renderer=webgl", width=WIDTH, height=HEIGHT, dark=True)

    def picture(self):
        shot = self._browser.call("Page.captureScreenshot", format="png")["data"]
        return golden_pictures.load(io.BytesIO(base64.b64decode(shot)))

    def rest(self, patience_s=60.0):
        """A picture that is the same as the two before."""
        last = [self.picture() for _ in range(3)]

        def rests():
            last[:] = [*last[1:], self.picture()]
            return (last[0] == last[1]).all() and (last[1] == last[2]).all()

        wait_for(rests, "the page's picture doesn't come to rest", patience_s, pause_s=1.0)
        return last[-1]

    def wait(self, until, patience_s=120.0):
        wait_for(lambda: until(self.picture()), "the page doesn't show the session", patience_s)

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self._browser.mouse(kind, x, y, clicks=1)

    def press(self, key, code, *, shift=False, control=False):
        for kind in ("rawKeyDown", "keyUp"):
            self._browser.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=key,
                windowsVirtualKeyCode=code,
                modifiers=2 * control + 8 * shift,
            )
        self.rest()  # it may draw one frame a second, and takes keys of one frame together


def plays(picture):
    """Whether the page plays, by the colour of its button."""
    red, _, blue = picture[PLAY[1] - 8, PLAY[0] - 8]
    return blue > red + 60


def complete(picture):
    """Whether body and plots are there, and it plays as it does once all is loaded."""
    bars = np.ptp(part(picture, "response"), axis=-1) > 60
    return glows(picture) > 300 and bars.sum() > 1000 and plays(picture)


def test_chromium_draws_what_the_native_viewer_draws(webgl_browser, address, native, tmp_path):
    page = Page(webgl_browser, address)
    page.wait(complete)
    page.click(*PLAY)
    page.wait(lambda picture: not plays(picture))
    page.rest()
    page.press("ArrowLeft", 37, control=True, shift=True)  # to the start
    for _ in range(round(SECONDS)):
        page.press("ArrowRight", 39, shift=True)  # a second on
    picture = page.rest()
    Image.fromarray(picture.astype(np.uint8)).save(tmp_path / "web.png")
    worst = {
        name: golden_pictures.worst_tile(part(picture, name), part(native, name), REACH)
        for name in PARTS
    }
    assert max(worst.values()) <= golden_pictures.DIFFERING, f"{worst} in {tmp_path / 'web.png'}"
