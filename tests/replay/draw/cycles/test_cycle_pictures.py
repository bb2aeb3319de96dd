"""What the viewer really draws of cycles and of the mean cycle."""

from functools import partial

import numpy as np
import pytest

import undulog
from undulog.capture import Session
from undulog.capture.common.palette import joint_colors
from undulog.replay.feed.numbers import computed
from undulog.replay.feed.recording import write_recording
from undulog.replay.layout import build_blueprint

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tabs(tmp_path_factory):
    """The weak snake of the paper, each tab in front once: tab to recording, and the numbers."""
    folder = tmp_path_factory.mktemp("tabs")
    session_file = folder / "weak.mcap"
    assert undulog.run(["sim", "run", "weak-servo-pi3", "-o", str(session_file)]) == 0
    found = {}
    with Session.open(session_file) as session:
        layer = computed(session)
        for tab in ("session", "cycles", "mean-cycle"):
            found[tab] = folder / f"{tab}.rrd"
            said = write_recording(
                session,
                found[tab],
                analysis=layer.analysis,
                layout=partial(build_blueprint, front=tab),
            )
    return found, said.content


def in_front(viewer):
    """Views that are drawn, with their pictures."""
    shown = {}
    for name in viewer.views:
        try:
            shown[name] = viewer.picture(name)
        except ConnectionError:  # behind a tab
            continue
    return shown


def named(pictures, start):
    """The picture of the one view whose name begins so."""
    (name,) = (name for name in pictures if name.startswith(start))
    return pictures[name]


@pytest.mark.parametrize("tab", ["session", "cycles", "mean-cycle"])
def test_every_tab_fits_a_laptop_and_nothing_complains(tabs, show, rgb, tab):
    viewer = show(tabs[0][tab], 12.3)
    assert viewer.complaints() == []
    sizes = [rgb(picture).shape[:2] for picture in in_front(viewer).values()]
    assert len(sizes) >= {"session": 6, "cycles": 6, "mean-cycle": 4}[tab]
    assert min(height for height, _ in sizes) > 140
    assert min(width for _, width in sizes) > 180


def test_cells_wear_the_colours_of_their_values_where_they_are(tabs, show, rgb):
    files, content = tabs
    picture = rgb(named(in_front(show(files["cycles"], 12.3)), "Gain − 1 map"))
    shown = content.maps[0]
    # A settled row's colours by the map's own scale, found again along a line of the picture.
    share = (shown.table.value[:, 4] - shown.low) / (shown.high - shown.low)
    truth = joint_colors(256)[np.rint(255 * share).astype(int), :3].astype(int)
    is_cell = (picture.max(axis=-1) - picture.min(axis=-1)) > 40
    rows = np.flatnonzero(is_cell.mean(axis=1) > 0.6)
    columns = np.flatnonzero(is_cell[rows].mean(axis=0) > 0.6)
    left, right = columns[0], columns[-1] + 1
    line = rows[0] + int(0.62 * (rows[-1] - rows[0]))  # in the fifth of seven rows, off its middle
    for i in range(13):
        at = int(left + (i + 0.3) * (right - left) / 13)
        assert np.abs(picture[line, at] - truth[i]).max() <= 3, f"joint {2 * i + 1}"


def test_the_frame_moves_to_the_cycle_at_the_cursor(tabs, show, rgb):
    viewer = show(tabs[0]["cycles"], 4.0)
    heights = []
    for seconds in (4.0, 12.0):  # the second and the sixth of seven cycles
        viewer.seek(seconds)
        picture = rgb(named(in_front(viewer), "Lag map"))
        white = (picture.min(axis=-1) > 250).sum(axis=1) > 0.5 * picture.shape[1]
        lines = np.flatnonzero(white)
        heights.append((lines[0], lines[-1]))
    first, second = heights
    row = first[1] - first[0]
    assert second[0] - first[0] == pytest.approx(4 * row, abs=8)


def test_the_mean_cycles_body_moves_with_its_phase(tabs, show, rgb):
    viewer = show(tabs[0]["mean-cycle"], 0.0)
    pictures = []
    for degrees in (0, 180, 360):
        viewer.seek_phase(degrees)
        pictures.append(rgb(viewer.picture("Mean cycle: body")))
    still, half, again = pictures
    assert (np.abs(still - half).max(axis=-1) > 40).sum() > 3000
    assert (np.abs(still - again).max(axis=-1) > 40).sum() == 0


def test_the_mean_cycles_lines_are_drawn_on_its_own_timeline_only(tabs, show, rgb):
    viewer = show(tabs[0]["mean-cycle"], 12.3)
    color = joint_colors(25)[24, :3].astype(int)

    def amber():
        picture = rgb(viewer.picture("Mean angle [°]"))[:, 160:]  # beside the legend
        return int((np.abs(picture - color).max(axis=-1) <= 26).sum())

    assert amber() == 0
    viewer.seek_phase(90)
    assert amber() > 300
