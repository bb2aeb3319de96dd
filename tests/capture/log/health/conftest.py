"""A session without a fault."""

import pytest

from support.checked_sessions import write


@pytest.fixture(scope="session")
def clean(tmp_path_factory):
    return write(tmp_path_factory.mktemp("clean") / "clean.mcap", verdict="good")
