"""The picture of the page on sessions side by side.

``python docs/side_by_side.py docs/images``: a session of the twin plays the robot, the same
commands run again on ground with less sideways grip, and the viewer draws both off screen (needs a
Vulkan driver; Debian: mesa-vulkan-drivers libvulkan1).
"""

import sys
import tempfile
from pathlib import Path

from pictures import replay_picture

import undulog


def main(images: Path) -> None:
    """Record, run again, draw."""
    with tempfile.TemporaryDirectory() as folder:
        robot, twin, both = (f"{folder}/{name}" for name in ("robot.mcap", "twin.mcap", "both.rrd"))
        change = "world.ground.mu_normal=0.35"
        for words in (
            ["sim", "run", "weak-servo-pi3", "-o", robot],
            ["replay", robot, "--on", "twin", "--set", change, "-o", twin],
            ["view", robot, twin, "--save", both],
        ):
            if code := undulog.run(words):
                sys.exit(code)
        images.mkdir(parents=True, exist_ok=True)
        replay_picture(Path(both), images / "side-by-side.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
