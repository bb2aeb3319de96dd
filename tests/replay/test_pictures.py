"""What the viewer really draws: every view of a recording, by a viewer without a window."""

import numpy as np
import pytest
import rerun.blueprint as rrb

from support.golden_pictures import marked
from undulog.capture import Session
from undulog.capture.common.palette import joint_colors
from undulog.replay.layout import build_views
from undulog.replay.recording import write_recording

pytestmark = pytest.mark.nightly

SECONDS = 1.6


def side_by_side(content):
    """All views at once, since a view behind a tab is not drawn."""
    return rrb.Blueprint(rrb.Grid(*build_views(content).all), collapse_panels=True)


@pytest.fixture(scope="module")
def grid(show, session_file, analysis, tmp_path_factory):
    """A viewer that shows all views, small."""
    path = tmp_path_factory.mktemp("grid") / "grid.rrd"
    with Session.open(session_file) as session:
        write_recording(session, path, analysis=analysis, layout=side_by_side)
    return show(path, SECONDS)


@pytest.fixture(scope="module")
def window(show, recording):
    """A viewer as a user first sees it."""
    return show(recording[0].path, SECONDS)


def test_no_view_complains_or_is_empty(grid, rgb):
    assert len(grid.views) >= 12
    assert grid.complaints() == []
    for name in grid.views:
        assert marked(rgb(grid.picture(name))) > 200, f"the view {name!r} is empty"


def test_the_layout_fits_a_laptop(window, rgb, sizes):
    assert window.complaints() == []
    assert rgb(window.picture()).shape[:2] == (900, 1440)
    shown = sizes(window)
    assert len(shown) >= 6
    assert min(height for height, _ in shown) > 60  # the lane of gait modes
    assert min(width for _, width in shown) > 180


def test_a_session_without_a_robot_is_drawn_too(show, rgb, write, tmp_path, opened):
    write_recording(opened(write(tmp_path / "a.mcap", robot=False)), tmp_path / "a.rrd")
    window = show(tmp_path / "a.rrd", SECONDS)
    assert window.complaints() == []
    assert not any(name.startswith("Body") for name in window.views)
    picture = rgb(window.picture("Head, middle, tail [°]"))
    assert (np.abs(picture - joint_colors(25)[24, :3]).max(axis=-1) <= 26).sum() > 100
