"""The tree in CONTRIBUTING: every folder of the packages with the first line of its docstring.

``make schemas`` writes it; a test holds it to the folders.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PACKAGES = ("undulog", "capture", "sim", "analysis", "replay")
OTHERS = {
    "tests": "the same four, folder by folder; support: helpers; house: rules of the tree; zoo: "
    "planted faults",
    "docs": "the manual, and what Sphinx runs to build it",
    "studies": "the scripts behind its tables and figures; study: the study of body couplings",
    "bench": "speed, beside named peers",
}
WIDTH = 24

_BLOCK = re.compile(r"(?<=<!-- the tree -->\n```\n).*?(?=```\n<!-- end of the tree -->)", re.DOTALL)


def tree() -> str:
    """Return the tree, a folder a line."""
    lines: list[str] = []
    for package in PACKAGES:
        for folder in _folders(ROOT / package):
            depth = len(folder.relative_to(ROOT).parts) - 1
            name = "  " * depth + folder.name + ("/" if depth == 0 else "")
            lines.append(f"{name:{WIDTH}}{_first_line(folder / '__init__.py')}")
    lines += [f"{name + '/':{WIDTH}}{text}" for name, text in OTHERS.items()]
    return "\n".join(lines) + "\n"


def _folders(folder: Path) -> list[Path]:
    """Return a package and its packages, each before those in it; links are not followed."""
    inside = sorted(path for path in folder.iterdir() if (path / "__init__.py").is_file())
    return [
        folder,
        *(below for path in inside if not path.is_symlink() for below in _folders(path)),
    ]


def _first_line(file: Path) -> str:
    text = ast.get_docstring(ast.parse(file.read_text())) or ""
    line = re.sub(r":\w+:`([^`]*)`", r"\1", text.partition("\n")[0])
    return line.rstrip(".")


def with_tree(text: str) -> str:
    """Return the text of CONTRIBUTING with the tree as it is now."""
    return _BLOCK.sub(lambda _: tree(), text)


if __name__ == "__main__":
    CONTRIBUTING.write_text(with_tree(CONTRIBUTING.read_text()))
