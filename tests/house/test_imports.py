"""No import circle: not between files, not between folders; imports in functions count, too."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

from support.paths import ROOT

PACKAGES = ("analysis", "capture", "replay", "sim")
FILES = {
    path.relative_to(ROOT).with_suffix("").as_posix().removesuffix("/__init__"): path
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
}


def imports(name: str, path: Path) -> Iterator[str]:
    """Modules of ours that a file imports, those for type checkers among them."""
    folder = name if path.name == "__init__.py" else name.rpartition("/")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom):
            continue
        words = (node.module or "").split(".") if node.module else []
        if node.level:
            parts = folder.split("/")
            base = parts[: len(parts) - node.level + 1] + words
        elif words[:1] == ["undulog"]:
            base = words[1:]
        else:
            continue
        for alias in node.names:
            whole = "/".join([*base, alias.name])
            target = whole if whole in FILES else "/".join(base)
            if target in FILES and target not in PACKAGES:  # these import names when used
                yield target


def graph() -> dict[str, set[str]]:
    names = {name: path for name, path in FILES.items() if name not in PACKAGES}
    return {name: set(imports(name, path)) - {name} for name, path in names.items()}


def test_no_circle_of_files() -> None:
    assert list(TopologicalSorter(graph()).static_order())  # CycleError names a circle


def test_no_circle_of_folders() -> None:
    def folder(name: str) -> str:
        return FILES[name].parent.relative_to(ROOT).as_posix()

    folders: dict[str, set[str]] = {}
    for name, targets in graph().items():
        found = {folder(target) for target in targets} - {folder(name)}
        folders.setdefault(folder(name), set()).update(found)
    assert list(TopologicalSorter(folders).static_order())
