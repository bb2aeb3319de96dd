"""The picture of the page on sessions side by side.

``python docs/side_by_side.py docs/images``: a session of the twin plays the robot, the same
commands run again on ground with less sideways grip, and the viewer draws both off screen (needs a
Vulkan driver; Debian: mesa-vulkan-drivers libvulkan1). With ``--quick`` a session of 3 s, only to
see that it runs.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from pictures import SECONDS, window_picture

import undulog

QUICK_S = 3.0


def main() -> None:
    """Record, run again, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("images", type=Path, help="the folder to write to")
    parser.add_argument("--quick", action="store_true", help=f"a session of {QUICK_S:g} s")
    options = parser.parse_args()
    short = ["--duration", f"{QUICK_S:g}"] if options.quick else []
    with tempfile.TemporaryDirectory() as folder:
        robot, twin, both = (f"{folder}/{name}" for name in ("robot.mcap", "twin.mcap", "both.rrd"))
        change = "world.ground.mu_normal=0.35"
        for words in (
            ["sim", "run", "weak-servo-pi3", *short, "-o", robot],
            ["replay", robot, "--on", "twin", "--set", change, "-o", twin],
            ["view", robot, twin, "--save", both],
        ):
            if code := undulog.run(words):
                sys.exit(code)
        options.images.mkdir(parents=True, exist_ok=True)
        at_s = QUICK_S / 2 if options.quick else SECONDS
        window_picture(Path(both), options.images / "side-by-side.png", at_s)


if __name__ == "__main__":
    main()
