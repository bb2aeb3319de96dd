"""Build a release of the last commit: ``python .ci/release.py [FOLDER]``, by default ``dist``.

Wheel and source archive are built twice, from two copies of the commit in folders of different
names and with different umasks, and must be the same bytes. Beside them go the notes of the version
from CHANGELOG.md, the bill of materials, and the SHA-256 of everything.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from io import BytesIO
from pathlib import Path

import sbom

ROOT = Path(__file__).resolve().parent.parent


class ReleaseError(Exception):
    """What keeps a release from being made."""


def git(*words: str) -> bytes:
    """Return what git prints in the repository."""
    return subprocess.run(["git", "-C", ROOT, *words], check=True, capture_output=True).stdout  # noqa: S603, S607


def build(archive: bytes, folder: Path, time_s: int, umask: int) -> dict[str, bytes]:
    """Unpack a commit, build wheel and source archive in it, and return them by name.

    Raises:
        ReleaseError: If the build fails.
    """
    before = os.umask(umask)
    try:
        with tarfile.open(fileobj=BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        done = subprocess.run(
            [sys.executable, "-m", "hatchling", "build", "-d", "dist"],
            cwd=folder,
            check=False,
            capture_output=True,
            text=True,
            env=os.environ | {"SOURCE_DATE_EPOCH": str(time_s)},
        )
    finally:
        os.umask(before)
    if done.returncode:
        raise ReleaseError(f"the build fails: {done.stderr.strip()}")
    return {path.name: path.read_bytes() for path in sorted((folder / "dist").iterdir())}


def notes(changelog: str, version: str) -> str:
    """Return the part of a changelog about a version; of what is unreleased if it has none.

    Raises:
        ReleaseError: If it has neither.
    """
    parts = re.split(r"^## ", changelog, flags=re.MULTILINE)[1:]
    for name in (version, "unreleased"):
        for part in parts:
            head, _, body = part.partition("\n")
            if head.strip("[] ").lower().startswith(name):
                return f"# undulog {version}\n\n{body.strip()}\n"
    raise ReleaseError(f"CHANGELOG.md has neither '## {version}' nor '## Unreleased'")


def faults(lock: Path) -> str:
    """Return the known faults of the locked packages, or why no service was asked."""
    audit = shutil.which("pip-audit", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if audit is None:
        return "not checked: pip-audit is not installed"
    words = [audit, "--requirement", str(lock), "--disable-pip", "--format", "json"]
    try:
        done = subprocess.run(  # noqa: S603 - found on the path
            [*words, "--progress-spinner", "off", "--timeout", "10"],
            check=False,
            capture_output=True,
            text=True,
            timeout=300,
        )
        packages = json.loads(done.stdout)["dependencies"]
    except (subprocess.TimeoutExpired, json.JSONDecodeError):
        return "not checked: no service reachable"
    checked = [package for package in packages if "skip_reason" not in package]
    if not checked:
        return "not checked: no service knows the packages"
    vulnerabilities = [
        f"{package['name']} {v['id']}" for package in checked for v in package["vulns"]
    ]
    return f"{', '.join(vulnerabilities) or 'none'} ({len(checked)} of {len(packages)} checked)"


def release(output: Path) -> list[str]:
    """Make the release and return what to report.

    Raises:
        ReleaseError: If a file is there with other content, or two builds differ.
    """
    time_s = int(git("log", "-1", "--format=%ct"))
    archive = git("archive", "HEAD")
    with tempfile.TemporaryDirectory(prefix="undulog-release-") as work:
        first = Path(work, "a")
        made = build(archive, first, time_s, 0o022)
        again = build(archive, Path(work, "a-longer-name/b"), time_s, 0o077)
        for name in made:
            if made[name] != again.get(name):
                raise ReleaseError(f"{name} differs between two builds of one commit")
        version = tomllib.loads((first / "pyproject.toml").read_text())["project"]["version"]
        stem = f"undulog-{version}"
        made[f"{stem}-notes.md"] = notes((first / "CHANGELOG.md").read_text(), version).encode()
        bill = Path(work, "bill.json")
        count = sbom.write(bill, first, time_s)
        made[f"{stem}.cdx.json"] = bill.read_bytes()
        audit = faults(first / "requirements.lock")
    sums = (f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sorted(made.items()))
    made["SHA256SUMS"] = "".join(sums).encode()
    output.mkdir(parents=True, exist_ok=True)
    for name, data in made.items():
        part = output / f"{name}.part"
        part.write_bytes(data)
        part.replace(output / name)
    lines = [f"{output / name}: {len(data)} bytes" for name, data in made.items()]
    if git("status", "--porcelain"):
        lines.append("changes that are not committed are not in it")
    return [
        *lines,
        f"{git('log', '-1', '--format=%h').decode().strip()}, built twice, the same bytes",
        f"{count} packages in the bill of materials; known faults of them: {audit}",
    ]


if __name__ == "__main__":
    try:
        print("\n".join(release(Path(*sys.argv[1:2] or ["dist"]))))  # noqa: T201
    except ReleaseError as error:
        sys.exit(f"error: {error}")
