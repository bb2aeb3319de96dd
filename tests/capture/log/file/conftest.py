"""Temporary files."""

import tempfile

import pytest


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """A folder of temporary files, which must be empty after each test."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield
    assert not any(folder.iterdir())
