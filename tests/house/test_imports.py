"""No import circle: not between files, not between folders; imports in functions count, too."""

from graphlib import TopologicalSorter

import grimp
import pytest

PACKAGES = {"undulog", *(f"undulog.{name}" for name in ("analysis", "capture", "replay", "sim"))}
"""These import names when they are used."""


@pytest.fixture(scope="module")
def graph():
    """Module to the modules of ours that it imports, those for type checkers among them."""
    whole = grimp.build_graph("undulog", cache_dir=None)
    imports = {
        name: whole.find_modules_directly_imported_by(name) - PACKAGES
        for name in whole.modules - PACKAGES
    }
    assert sum(map(len, imports.values())) > 1000
    return imports


def test_no_circle_of_files(graph):
    assert list(TopologicalSorter(graph).static_order())  # CycleError names a circle


def test_no_circle_of_folders(graph):
    parents = {name.rpartition(".")[0] for name in graph}

    def folder(name):
        return name if name in parents else name.rpartition(".")[0]

    folders = {}
    for name, targets in graph.items():
        others = {folder(target) for target in targets} - {folder(name)}
        folders.setdefault(folder(name), set()).update(others)
    assert list(TopologicalSorter(folders).static_order())
