"""A small robot, and what it is to do."""

import tempfile
from contextlib import closing
from pathlib import Path

import pytest

from support import gate_stage


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """Robot file and scenario."""
    return gate_stage.robot_files(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="session")
def session(small, tmp_path_factory):
    """A minute of commands."""
    return gate_stage.commanded(tmp_path_factory.mktemp("session") / "wave.mcap", small[0], 60.0)


@pytest.fixture
def driving(small, session, tmp_path):
    """Drives of the small robot: a context that gives a :class:`Driving`."""

    def started(*faults, scenario=small[1], recorded=session, plain=False, disk=None, **more):
        def start(running):
            folder = Path(tempfile.mkdtemp(dir=tmp_path))  # a test may drive several times
            path = Path(tempfile.mkdtemp(dir=disk)) / "a.mcap" if disk else folder / "a.mcap"
            stage = running.enter_context(gate_stage.staged(folder, scenario, *faults))
            if plain:  # python-can's own socketcand: the robot isn't asked who it is
                stage.on += "&plain=yes"
            return stage, running.enter_context(stage.replay(recorded, path)), path

        return closing(gate_stage.Driving(start, **more))

    return started
