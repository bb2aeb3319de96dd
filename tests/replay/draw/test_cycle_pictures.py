"""What the viewer really draws of cycles and of the mean cycle."""

from functools import partial

import numpy as np
import pytest

import undulog
from undulog.capture import Session
from undulog.capture.common.palette import joint_colors
from undulog.replay.layout import build_blueprint
from undulog.replay.numbers import computed
from undulog.replay.recording import write_recording

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def tabs(tmp_path_factory):
    """The weak snake of the paper, each tab in front once: tab to recording."""
    folder = tmp_path_factory.mktemp("tabs")
    session_file = folder / "weak.mcap"
    assert undulog.run(["sim", "run", "weak-servo-pi3", "-o", str(session_file)]) == 0
    files = {}
    with Session.open(session_file) as session:
        layer = computed(session)
        for tab in ("session", "cycles", "mean-cycle"):
            files[tab] = folder / f"{tab}.rrd"
            front = partial(build_blueprint, front=tab)
            write_recording(session, files[tab], analysis=layer.analysis, layout=front)
    return files


@pytest.mark.parametrize("tab", ["session", "cycles", "mean-cycle"])
def test_every_tab_fits_a_laptop_and_nothing_complains(tabs, show, sizes, tab):
    viewer = show(tabs[tab], 12.3)
    assert viewer.complaints() == []
    shown = sizes(viewer)
    assert len(shown) >= {"session": 6, "cycles": 6, "mean-cycle": 4}[tab]
    assert min(height for height, _ in shown) > 140
    assert min(width for _, width in shown) > 180


def test_the_mean_cycle_moves_on_its_own_timeline_only(tabs, show, rgb):
    viewer = show(tabs["mean-cycle"], 12.3)
    color = joint_colors(25)[24, :3].astype(int)

    def of_the_tail():
        picture = rgb(viewer.picture("Mean angle [°]"))[:, 160:]  # beside the legend
        return int((np.abs(picture - color).max(axis=-1) <= 26).sum())

    assert of_the_tail() == 0
    pictures = []
    for degrees in (0, 180, 360):
        viewer.seek_phase(degrees)
        pictures.append(rgb(viewer.picture("Mean cycle: body")))
    assert of_the_tail() > 300
    still, half, again = pictures
    assert (np.abs(still - half).max(axis=-1) > 40).sum() > 3000
    assert (np.abs(still - again).max(axis=-1) > 40).sum() == 0
