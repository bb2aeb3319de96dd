"""Golden pictures: every view of a short session as it has been looked at and found right.

``python tests/support/golden_pictures.py`` makes them anew with the viewer; look at each before it
is committed. ``--session`` records the session that they show anew, too, from its scenario.

Two pictures are the same when no tile of 16 x 16 pixels holds more than 12 that differ. A pixel
differs when it is further than 48 of 255 in some channel from every pixel of the other picture
within one pixel around it. So another driver's edges, half a pixel away or softened otherwise,
pass; a line that is missing fills some tile with three times as many.
"""

import argparse
import io
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from uuid import uuid4

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image
from rerun.chunk import RrdReader

from undulog.analysis.session.analyse import analyse_session
from undulog.capture import Session
from undulog.replay.layout import build_views
from undulog.replay.recording import APPLICATION, write_recording
from undulog.replay.viewer import HeadlessViewer

FOLDER = Path(__file__).parents[1] / "replay" / "golden"
SESSION = FOLDER / "session.mcap"
SCENARIO = FOLDER / "scenario.toml"
SECONDS = 3.6
DEGREES = 120
WINDOW = (420, 340)
TILE = 16
DIFFERING = 12
FAR = 48


def convert(path):
    """Write the session's recording; return its views by name."""
    with Session.open(SESSION) as session:
        written = write_recording(session, path, analysis=analyse_session(session))
    return {str(view.name): view for view in build_views(written.content).all}


def alone(view):
    """Return the layout that shows one view and nothing else."""
    panels = (rrb.TopPanel, rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)
    hidden = [panel(state="hidden") for panel in panels]
    return rrb.Blueprint(view, *hidden, auto_views=False, auto_layout=False)


def take(viewer, recording, view):
    """Return the PNG of one view of a recording, by a viewer of the right size.

    ``recording`` is a file, or a stream of chunks.
    """
    stream = RrdReader(recording).stream() if isinstance(recording, Path) else recording
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.rrd"
        # Under a name of its own: the viewer adds to a recording that it has seen before.
        rec = rr.RecordingStream(APPLICATION, recording_id=uuid4(), send_properties=False)
        rec.set_log_time_enabled(False)
        rec.set_log_tick_enabled(False)
        rec.save(path)
        rec.send_chunks(stream)
        rec.send_blueprint(alone(view))
        rec.disconnect()
        viewer.open(path, SECONDS)
        if str(view.name).startswith("Mean"):
            viewer.seek_phase(DEGREES)
        return viewer.picture(str(view.name))


def slug(view):
    """Return the file name of a view: its name without numbers and units after it."""
    return re.sub(r"[^a-z0-9]+", "-", re.split(r"[:\[]|, [^a-z]", view)[0].lower()).strip("-")


def load(path):
    """Load a picture as integers, shape (height, width, 3)."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def glowing(picture):
    """Where a picture is vermilion, by hue, since the light shades the body."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return (red > 1.6 * blue) & (red > 1.4 * green) & (red > 90)


def marked(picture):
    """Return the number of pixels that stand out from the ground."""
    return int((np.abs(picture - np.median(picture, axis=(0, 1))).max(axis=-1) > 60).sum())


def differing(picture, golden, reach=1):
    """Return which pixels of either picture have no like within ``reach`` in the other, (h, w)."""
    return _lost(picture, golden, reach) | _lost(golden, picture, reach)


def _lost(picture, other, reach):
    around = np.pad(other, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    there = np.lib.stride_tricks.sliding_window_view(around, ((2 * reach + 1,) * 2), axis=(0, 1))
    return np.abs(picture[..., None, None] - there).max(axis=2).min(axis=(-2, -1)) > FAR


def worst_tile(picture, golden, reach=1):
    """Return the most differing pixels in any tile; all of a tile's where the sizes differ."""
    if picture.shape != golden.shape:
        return TILE * TILE
    differs = differing(picture, golden, reach)
    height, width = differs.shape
    padded = np.zeros((height + TILE, width + TILE), dtype=int)
    padded[:height, :width] = differs
    # Tiles at every half step, so that no edge between tiles can halve a difference.
    corners = ((0, 0), (0, TILE // 2), (TILE // 2, 0), (TILE // 2, TILE // 2))
    return max(_fullest(padded[down:, right:]) for down, right in corners)


def _fullest(differs):
    rows, columns = (side // TILE for side in differs.shape)
    tiles = differs[: rows * TILE, : columns * TILE].reshape(rows, TILE, columns, TILE)
    return int(tiles.sum(axis=(1, 3)).max())


def record_session():
    """Record the session that the pictures show."""
    run = (sys.executable, "-m", "undulog", "sim", "run", SCENARIO, "-o", SESSION, "--force")
    subprocess.run([*map(str, run)], check=True)


def main():
    """Make all pictures anew."""
    for old in FOLDER.glob("*.png"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder, HeadlessViewer(WINDOW) as viewer:
        recording = Path(folder) / "golden.rrd"
        for name, view in convert(recording).items():
            path = FOLDER / f"{slug(name)}.png"
            with Image.open(io.BytesIO(take(viewer, recording, view))) as picture:
                # By coverage: a median cut gives the few pixels of a marker away.
                few = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
            few.save(path, optimize=True)
            for complaint in viewer.complaints():
                print(complaint)
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--session", action="store_true", help="record the session anew, too")
    if parser.parse_args().session:
        record_session()
    main()
