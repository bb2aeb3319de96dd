"""The pictures of README and manual, from what ``make demo`` left.

``python studies/pictures.py`` draws into ``docs/images``, or elsewhere with ``-o``: the replay's
tabs as Rerun's viewer draws them off screen (needs a Vulkan driver; Debian: mesa-vulkan-drivers
libvulkan1), the view of a recording that runs, a session of the twin beside its commands run again
on ground with less sideways grip, the body's motion, and the report's first figure as a picture of
its own that follows the reader's light or dark scheme. With ``--quick`` one tab, a small clip and
short sessions, to see that it runs.
"""

import argparse
import io
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from PIL import Image

import undulog
from undulog.replay.viewer import HeadlessViewer

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs/images"
SECONDS = 12.3
SCENARIO = "weak-servo-pi3"
QUICK_S, QUICK_DEMO_S = 3.0, 14.5
LIVE_S = 13.0
DEGREES = 90
TITLE_BAR = 36
"""Height of the viewer's own title bar [pixels]; it warns of the software driver."""
SIZE = (1440, 900 + TITLE_BAR)
CLIP = ("--from", "12", "--to", "14")
"""One period of the gait."""
SMALL = ("--fps", "12", "--size", "720x406")
"""Small enough for a page."""
QUICK = ("--fps", "2", "--size", "320x180")
TABS = {"session": "replay", "cycles": "replay-cycles", "mean-cycle": "replay-mean-cycle"}


def undulog_all(*commands: list[str | Path]) -> None:
    """Run commands one after the other; end at the first one that fails."""
    for words in commands:
        if code := undulog.run([*map(str, words)]):
            sys.exit(code)


def short_demo(demo: Path) -> None:
    """Make what ``make demo`` leaves, of a session just long enough for the clip."""
    session = demo / "session.mcap"
    length = ["--duration", f"{QUICK_DEMO_S:g}", "--kernels", "numba"]
    undulog_all(
        ["sim", "run", SCENARIO, *length, "-o", session],
        ["analyse", session, "-o", demo / "result.json"],
        ["report", session, "-o", demo / "report.html"],
    )


def window_picture(
    recording: Path, target: Path, seconds: float, *, degrees: int | None = None
) -> None:
    """Draw the viewer's window at one instant of a recording.

    Args:
        recording: The .rrd file.
        target: The PNG to write.
        seconds: Place on ``session_time`` [s].
        degrees: Place in the mean cycle, where that is in front.
    """
    with HeadlessViewer(SIZE) as viewer:
        viewer.open(recording, seconds)
        if degrees is not None:
            viewer.seek_phase(degrees)
        for complaint in viewer.complaints():
            print(complaint)
        picture = Image.open(io.BytesIO(viewer.picture())).convert("RGB")
    picture.crop((0, TITLE_BAR, *picture.size)).save(target, optimize=True)


def replay_picture(demo: Path, images: Path, tab: str) -> None:
    """Draw the viewer at one instant of the session, one tab in front."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "tab.rrd"
        words = ["--result", demo / "result.json", "--tab", tab, "--save", recording]
        undulog_all(["view", demo / "session.mcap", *words])
        degrees = DEGREES if tab == "mean-cycle" else None
        window_picture(recording, images / f"{TABS[tab]}.png", SECONDS, degrees=degrees)


def _started(stack: ExitStack, *command: str | Path) -> subprocess.Popen[bytes]:
    """Start a process that is ended with the stack."""
    process = subprocess.Popen(command)  # noqa: S603  our own arguments
    stack.callback(process.wait)
    stack.callback(process.terminate)
    stack.callback(process.send_signal, signal.SIGCONT)
    return process


def live_picture(target: Path) -> None:
    """Draw the viewer beside a recorder of the twin that runs."""
    with tempfile.TemporaryDirectory() as name, HeadlessViewer(SIZE) as viewer:
        folder, command = Path(name), [sys.executable, "-m", "undulog"]
        record = ["record", f"twin:{SCENARIO}", "-o", folder / "run.mcap", "--duration", "60s"]
        record += ["--socket", folder / "run.sock", "--quiet"]
        view = ["view", "--live", folder / "run.live", "--connect", viewer.address]
        with ExitStack() as stack:
            relay, _ = (_started(stack, *command, *words) for words in (view, record))
            time.sleep(LIVE_S + 4.0)  # with its start
            viewer.seek(LIVE_S)
            relay.send_signal(signal.SIGSTOP)  # a picture is taken when nothing moves
            picture = Image.open(io.BytesIO(viewer.picture())).convert("RGB")
    picture.crop((0, TITLE_BAR, *picture.size)).save(target, optimize=True)


def side_by_side_picture(target: Path, *, quick: bool) -> None:
    """Draw the viewer with a session of the twin that plays the robot, and its repetition."""
    short = ["--duration", f"{QUICK_S:g}"] if quick else []
    with tempfile.TemporaryDirectory() as folder:
        robot, twin, both = (f"{folder}/{name}" for name in ("robot.mcap", "twin.mcap", "both.rrd"))
        change = "world.ground.mu_normal=0.35"
        undulog_all(
            ["sim", "run", SCENARIO, *short, "-o", robot],
            ["replay", robot, "--on", "twin", "--set", change, "-o", twin],
            ["view", robot, twin, "--save", both],
        )
        window_picture(Path(both), target, QUICK_S / 2 if quick else SECONDS)


def clip(demo: Path, target: Path, *size: str) -> None:
    """Write the body's motion over one period."""
    undulog_all(["view", demo / "session.mcap", "--clip", target, *CLIP, *size, "--force"])


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


def main() -> None:
    """Make them all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "demo", type=Path, nargs="?", default=ROOT / "out/demo", help="what `make demo` left"
    )
    parser.add_argument("-o", dest="images", type=Path, default=IMAGES, help="folder to write to")
    parser.add_argument(
        "--quick", action="store_true", help="one tab, a small clip, short sessions of its own"
    )
    options = parser.parse_args()
    images: Path = options.images
    images.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        demo: Path = options.demo
        if options.quick:
            demo = Path(name)
            short_demo(demo)
        for tab in list(TABS)[-1:] if options.quick else TABS:
            replay_picture(demo, images, tab)
        if not options.quick:
            live_picture(images / "live.png")
        side_by_side_picture(images / "side-by-side.png", quick=options.quick)
        clip(demo, images / "clip.gif", *(QUICK if options.quick else SMALL))
        response_picture(demo / "report.html", images / "response.svg")
    for path in sorted(images.iterdir()):
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
