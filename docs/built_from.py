"""What the long parts of the manual were built from, as digests in ``built-from.txt``.

``make pages`` builds each part, then runs ``python docs/built_from.py DATA``, which notes the
SHA-256 of what determines it: product, locked packages, scripts, and recordings in ``DATA``; and of
the page itself, so that one edited by hand is found. A test builds a part again only if any of that
has changed since. ``tutorials`` are those that take minutes. ``tables`` are long tests that hold
what the manual's tables say, with fewer draws: a file of tests is among their inputs if it marks
one ``built("tables")``.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
NOTED = DOCS / "built-from.txt"
PRODUCT = ("capture", "sim", "analysis", "replay", "undulog", "requirements.lock")
SCRIPTS = [f"docs/{path.name}" for path in DOCS.glob("*.py")]


def _marked(part: str) -> list[str]:
    """Return the files that mark a test as one of a part."""
    mark = f'mark.built("{part}")'
    files = (ROOT / "tests").rglob("test_*.py")
    return [str(path.relative_to(ROOT)) for path in files if mark in path.read_text()]


PARTS = {
    "real-robots": (
        *("docs/real_robots.py", "docs/real-robots.txt", "docs/explanation/real-robots.md"),
        "tests/docs/test_real_robots.py",
    ),
    "study": ("docs/study", "docs/study.md", "tests/docs/test_study.py"),
    "scripts": (*SCRIPTS, "tests/docs/test_scripts.py"),
    "tutorials": (
        *("docs/tutorials", "tests/support"),
        *("tests/conftest.py", "tests/docs/test_tutorials.py"),
    ),
    "tables": (
        *SCRIPTS,
        *("bench/target_following.py", "bench/measuring.py", "bench/records.py"),
        *("tests/conftest.py", "tests/support"),
        "tests/zoo",
        *_marked("tables"),
    ),
}
RECORDINGS = ("so101", "go2", "arcsnake")


def digest(part: str, data: Path) -> str:
    """Return the SHA-256 of a part's inputs [hex].

    Raises:
        KeyError: If there is no such part.
    """
    sources = {name: ROOT / name for name in (*PRODUCT, *PARTS[part])}
    if part == "real-robots":
        sources |= {f"DATA/{name}": data / name for name in RECORDINGS}
    total = hashlib.sha256()
    for name, source in sorted(sources.items()):
        for path in [source] if source.is_file() else sorted(source.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                total.update(f"{name} {path.relative_to(source)} {content}\n".encode())
    return total.hexdigest()


def is_current(part: str, data: Path) -> bool:
    """Return whether a part was built from what is here now."""
    noted = dict(line.split() for line in NOTED.read_text().splitlines())
    return noted.get(part) == digest(part, data)


if __name__ == "__main__":
    NOTED.write_text("".join(f"{part} {digest(part, Path(sys.argv[1]))}\n" for part in PARTS))
