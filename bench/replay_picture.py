"""The manual's picture of a replay, made anew.

``python bench/replay_picture.py [PICTURE.png]`` simulates the weak-servo scenario, analyses it,
converts it and has Rerun's viewer draw it off screen (needs a Vulkan driver; Debian:
mesa-vulkan-drivers libvulkan1). It takes about 15 s.
"""

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from analysis.analyse import analyse_session
from capture import Session
from replay import write_recording
from replay.headless import HeadlessViewer
from sim.record import record
from sim.scenario_file import load_scenario

TARGET = Path(__file__).parents[1] / "docs" / "images" / "replay.png"
SECONDS = 12.3
TITLE_BAR = 36
"""Height of the viewer's own title bar, which shows warnings about the software driver."""


def main(target: Path) -> None:
    """Make the picture."""
    with tempfile.TemporaryDirectory() as folder:
        log, recording = Path(folder) / "weak.mcap", Path(folder) / "weak.rrd"
        record(load_scenario("weak-servo-pi3"), log)
        with Session.open(log) as session:
            write_recording(session, recording, analysis=analyse_session(session))
        with HeadlessViewer((1440, 900 + TITLE_BAR)) as viewer:
            viewer.open(recording, SECONDS)
            for complaint in viewer.complaints():
                print(complaint)
            picture = Image.open(io.BytesIO(viewer.picture())).convert("RGB")
    picture = picture.crop((0, TITLE_BAR, *picture.size))
    target.parent.mkdir(parents=True, exist_ok=True)
    picture.save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET)
