"""Folders of tests are those of the sources."""

import pytest

from support.paths import ROOT


@pytest.mark.parametrize("package", ["analysis", "capture", "replay", "sim"])
def test_every_folder_of_tests_is_one_of_the_sources(package):
    tests = ROOT / "tests"
    folders = {path.parent.relative_to(tests) for path in (tests / package).rglob("test_*.py")}
    assert folders
    assert [folder for folder in folders if not list((ROOT / folder).glob("*.py"))] == []
