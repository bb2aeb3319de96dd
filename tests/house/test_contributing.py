"""CONTRIBUTING names what is there: every folder in its tree, every file in its text."""

import re

import pytest
import tree

from support.paths import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text()
FILES = sorted(
    set(re.findall(r"`((?:capture|sim|analysis|replay|tests|docs|studies|bench)/\w[\w/.]*)`", TEXT))
)
LINKS = sorted(set(re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", TEXT)))


def test_the_tree_is_that_of_the_folders():
    assert tree.with_tree(TEXT) == TEXT, "run 'make schemas'"


def test_every_folder_says_what_it_is_in_one_line():
    lines = tree.tree().splitlines()
    assert len(lines) > 50
    for line in lines:
        assert len(line.strip().split(maxsplit=1)) == 2, line
        assert len(line) <= 140, line


@pytest.mark.parametrize("name", [*FILES, *LINKS])
def test_what_it_names_is_there(name):
    assert (ROOT / name).exists()
