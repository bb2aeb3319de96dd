"""What the viewer really draws: every view of a recording, by a viewer without a window."""

import numpy as np
import pytest
import rerun.blueprint as rrb

from support.golden_pictures import glowing, marked
from undulog.capture import Session
from undulog.capture.common.palette import joint_colors
from undulog.replay.feed.recording import write_recording
from undulog.replay.layout import build_views

pytestmark = pytest.mark.slow

VERMILION = (255, 84, 48)
VIOLET = (150, 124, 230)
SECONDS = 1.6


def pixels(picture, color, within=26):
    """How many pixels are close to a colour."""
    return int((np.abs(picture - np.array(color)).max(axis=-1) <= within).sum())


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


def test_no_view_complains(grid):
    assert len(grid.views) >= 12
    assert grid.complaints() == []


def test_every_view_shows_something(grid, rgb):
    for name in grid.views:
        assert marked(rgb(grid.picture(name))) > 200, f"the view {name!r} is empty"


def test_pictures_are_the_same_every_time(grid):
    assert grid.picture("Lag [°]") == grid.picture("Lag [°]")


def test_head_middle_and_tail_are_plotted_in_their_joints_colours(grid, rgb):
    picture = rgb(grid.picture("Head, middle, tail [°]"))
    for joint in (0, 12, 24):
        assert pixels(picture, joint_colors(25)[joint, :3]) > 40


def test_power_is_plotted(grid, rgb):
    picture = rgb(grid.picture("Power [W]"))
    assert pixels(picture, VERMILION) > 100
    assert pixels(picture, VIOLET) > 100


def test_the_layout_fits_a_laptop(window, rgb):
    assert window.complaints() == []
    assert rgb(window.picture()).shape[:2] == (900, 1440)
    sizes = []
    for name in window.views:
        try:
            sizes.append(rgb(window.picture(name)).shape[:2])
        except ConnectionError:  # behind a tab
            continue
    assert len(sizes) >= 6
    assert min(height for height, _ in sizes) > 60  # the lane of gait modes
    assert min(width for _, width in sizes) > 180


def test_the_body_glows_in_the_middle_of_its_view(window, rgb):
    (name,) = (name for name in window.views if name.startswith("Body"))
    picture = rgb(window.picture(name))
    red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    drives = glowing(picture)
    driven = (blue > 1.5 * red) & (green > 1.3 * red) & (blue > 60)
    assert drives.sum() > 1000
    assert driven.sum() > 200
    place = np.mean(np.nonzero(drives), axis=1) / picture.shape[:2]
    assert (np.abs(place - 0.5) < 0.25).all()


def test_there_is_a_bar_for_every_driven_joint(window, rgb):
    picture = rgb(window.picture("Lag [°]"))
    columns = (picture.max(axis=-1) > 80).sum(axis=0) > 0.1 * picture.shape[0]
    assert np.count_nonzero(np.diff(columns.astype(int)) == 1) == 13


def test_a_session_without_a_robot_is_drawn_too(show, rgb, write, tmp_path):
    with Session.open(write(tmp_path / "a.mcap", robot=False)) as session:
        write_recording(session, tmp_path / "a.rrd")
    window = show(tmp_path / "a.rrd", SECONDS)
    assert window.complaints() == []
    assert not any(name.startswith("Body") for name in window.views)
    picture = rgb(window.picture("Head, middle, tail [°]"))
    assert pixels(picture, joint_colors(25)[24, :3]) > 100
