"""The tutorials: short enough, and every command gives what the page shows, in an empty home."""

import socket

import pytest

from support import manual_pages
from support.paths import DOCS
from undulog.capture import Session

PAGES = sorted(path.stem for path in DOCS.glob("tutorials/[a-z]*.md") if path.stem != "index")
MINUTES = 10
PORT = "29536"
LONG = {"body-or-module", "match-the-twin", "measure-coupling"}
"""Twin runs of minutes: walked as ``make pages`` builds the manual."""
FIRST = "first-bag"
"""A stranger's first page, walked each time; the others each night."""


def when(name):
    """Return the mark of the walk through a page."""
    if name in LONG:
        return pytest.mark.built("tutorials")
    return () if name == FIRST else pytest.mark.nightly


def page_of(name: str) -> str:
    return manual_pages.read_page(f"tutorials/{name}.md")


@pytest.mark.parametrize("name", PAGES)
def test_a_page_takes_at_most_ten_minutes(name):
    taken = manual_pages.minutes(page_of(name))
    assert taken <= MINUTES, f"{name}: {taken:.1f} minutes"


@pytest.mark.parametrize("name", PAGES)
def test_every_command_is_of_undulog_or_a_shell(name):
    commands = [s.line for s in manual_pages.steps(page_of(name)) if hasattr(s, "line")]
    assert len(commands) >= 4
    for line in commands:
        assert line.split()[0] in {"undulog", "sed", "mkdir", "for"}, line


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=when(name)) for name in PAGES],
)
def test_a_stranger_gets_from_an_empty_home_to_the_end_of_the_page(name, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    # On a busy computer, as tests make it, the twin has to wait for its controller.
    page = page_of(name).replace(f"{PORT} --wait", f"{PORT} --lockstep").replace(PORT, port)
    manual_pages.walk(page, tmp_path)
    if PORT in page_of(name):
        with Session.open(tmp_path / "home/run.mcap") as session:
            commanded, measured = (session.joints(f"/joint_{w}") for w in ("commands", "states"))
            assert commanded.names == measured.names == session.robot.joint_names
            # How many there are depends on what else the computer has to do.
            assert min(len(series.values[0]) for series in (commanded, measured)) > 20
            assert session.channels["/gait"].count > 20


def test_dots_stand_for_anything_and_the_rest_is_exact():
    assert manual_pages.shows("a: ...\nb", "a: 1\n c\n\nb \n")
    assert not manual_pages.shows("a: 1\nb", "a: 2\nb")
    assert not manual_pages.shows("a", "a\nb")
