"""The pictures of README and manual, from what ``make demo`` left.

``python docs/pictures.py out/demo docs/images``: the replay's tabs as Rerun's viewer draws them off
screen (needs a Vulkan driver; Debian: mesa-vulkan-drivers libvulkan1), the body's motion, and the
report's first figure as a picture of its own that follows the reader's light or dark scheme.
"""

import io
import re
import sys
import tempfile
from pathlib import Path

from PIL import Image

import undulog
from replay.headless import HeadlessViewer

SECONDS = 12.3
DEGREES = 90
TITLE_BAR = 36
"""Height of the viewer's own title bar [pixels]; it warns of the software driver."""
SIZE = (1440, 900 + TITLE_BAR)
CLIP = ("--from", "12", "--to", "14", "--fps", "12", "--size", "720x406")
"""One period of the gait, small enough for a page."""
TABS = {"session": "replay", "cycles": "replay-cycles", "mean-cycle": "replay-mean-cycle"}


def replay_pictures(demo: Path, images: Path) -> None:
    """The viewer at one instant of the session, each tab in front once."""
    for tab, name in TABS.items():
        with tempfile.TemporaryDirectory() as folder, HeadlessViewer(SIZE) as viewer:
            recording = Path(folder) / "tab.rrd"
            words = ["--result", demo / "result.json", "--tab", tab, "--save", recording]
            if undulog.run(["view", *map(str, (demo / "session.mcap", *words))]):
                sys.exit(f"no recording of {demo / 'session.mcap'}")
            viewer.open(recording, SECONDS)
            if tab == "mean-cycle":
                viewer.seek_phase(DEGREES)
            for complaint in viewer.complaints():
                print(complaint)
            picture = Image.open(io.BytesIO(viewer.picture())).convert("RGB")
        shown = picture.crop((0, TITLE_BAR, *picture.size))
        shown.save(images / f"{name}.png", optimize=True)


def clip(demo: Path, target: Path) -> None:
    """The body's motion over one period."""
    words = [demo / "session.mcap", "--clip", target, *CLIP, "--force"]
    if undulog.run(["view", *map(str, words)]):
        sys.exit(f"no clip of {demo / 'session.mcap'}")


def response_picture(page: Path, target: Path) -> None:
    """The first figure of a report, with the page's colours for light and for dark."""
    text = page.read_text(encoding="utf-8")
    figure = re.search(r"<svg[^>]*>.*?</svg>", text, re.DOTALL)
    light, dark = re.findall(r":root \{(.*?)\}", text, re.DOTALL)[:2]
    if figure is None:
        sys.exit(f"{page} has no figure")
    style = (
        "<style>svg { background: var(--paper); font-family: sans-serif; "
        f"{' '.join(light.split())} }} "
        f"@media (prefers-color-scheme: dark) {{ svg {{ {' '.join(dark.split())} }} }}</style>"
    )
    opening, _, rest = figure[0].partition(">")
    opening = opening.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    target.write_text(f"{opening}>{style}{rest}\n", encoding="utf-8")


def main(demo: Path, images: Path) -> None:
    """Make them all."""
    images.mkdir(parents=True, exist_ok=True)
    replay_pictures(demo, images)
    clip(demo, images / "clip.gif")
    response_picture(demo / "report.html", images / "response.svg")
    for path in sorted(images.iterdir()):
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
