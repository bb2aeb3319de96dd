"""The pictures of README and manual, from what ``make demo`` left.

``python docs/pictures.py out/demo docs/images``: the replay as Rerun's viewer draws it off screen
(needs a Vulkan driver; Debian: mesa-vulkan-drivers libvulkan1), and the report's first figure as a
picture of its own that follows the reader's light or dark scheme.
"""

import io
import re
import sys
from pathlib import Path

from PIL import Image

from replay.headless import HeadlessViewer

SECONDS = 12.3
TITLE_BAR = 36
"""Height of the viewer's own title bar [pixels]; it warns of the software driver."""


def replay_picture(recording: Path, target: Path) -> None:
    """The viewer at one instant of the recording."""
    with HeadlessViewer((1440, 900 + TITLE_BAR)) as viewer:
        viewer.open(recording, SECONDS)
        for complaint in viewer.complaints():
            print(complaint)
        picture = Image.open(io.BytesIO(viewer.picture())).convert("RGB")
    picture.crop((0, TITLE_BAR, *picture.size)).save(target, optimize=True)


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
    """Make both."""
    images.mkdir(parents=True, exist_ok=True)
    replay_picture(demo / "replay.rrd", images / "replay.png")
    response_picture(demo / "report.html", images / "response.svg")
    for path in sorted(images.iterdir()):
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
