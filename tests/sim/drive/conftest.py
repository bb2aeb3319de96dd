"""A small robot, and what it is to do."""

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
