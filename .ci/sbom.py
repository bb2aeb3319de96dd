"""Bill of materials of a release from the lock: every package, its files, what needs it.

``python .ci/sbom.py OUTPUT`` writes it for the working tree, as CycloneDX 1.6. The same lock and
time give the same bytes; nothing is looked up anywhere.

Specification: https://cyclonedx.org/docs/1.6/json/
"""

from __future__ import annotations

import json
import os
import re
import sys
import tomllib
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
_ENTRY = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)(?:\[[^\]]*\])?==(?P<version>\S+)(?P<rest>.*)$")
_OURS = re.compile(r"undulog(?: \(pyproject\.toml(?::dev)?\))?$")


@dataclass(frozen=True)
class Locked:
    """One package of the lock.

    Attributes:
        marker: Where it is installed, as an environment marker; empty: everywhere.
        hashes: SHA-256 of each of its files.
        needed_by: Packages of the lock that need it.
    """

    name: str
    version: str
    marker: str
    hashes: tuple[str, ...]
    needed_by: tuple[str, ...]

    @property
    def purl(self) -> str:
        """Its package URL, which identifies it among the packages."""
        return f"pkg:pypi/{self.name}@{self.version}"


def read_lock(text: str) -> list[Locked]:
    """Return the packages of a lock as ``uv pip compile --generate-hashes`` writes it."""
    packages: list[Locked] = []
    for block in re.split(r"^(?=[A-Za-z0-9])", text, flags=re.MULTILINE):
        if (entry := _ENTRY.match(block.partition("\n")[0].rstrip("\\ "))) is None:
            continue
        comments = re.findall(r"^ +# +(.*)$", block, re.MULTILINE)
        names = [re.sub(r"^via(\s+|$)", "", line) for line in comments]
        packages.append(
            Locked(
                canonicalize_name(entry["name"]),
                entry["version"],
                entry["rest"].strip(" ;"),
                tuple(re.findall(r"--hash=sha256:([0-9a-f]{64})", block)),
                tuple(name for name in names if name and not _OURS.match(name)),
            )
        )
    return packages


def scopes(packages: Iterable[Locked], project: Mapping[str, Any]) -> dict[str, str]:
    """Return the scope of each package by name.

    ``required`` is what the base install brings, ``optional`` what an extra does, ``excluded`` what
    only development needs.
    """
    needs: dict[str, set[str]] = {}
    for package in packages:
        for parent in package.needed_by:
            needs.setdefault(canonicalize_name(parent), set()).add(package.name)
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    scope_of: dict[str, str] = {package.name: "excluded" for package in packages}
    for scope, lines in (("optional", extras), ("required", project["dependencies"])):
        waiting = [canonicalize_name(Requirement(line).name) for line in lines]
        seen: set[str] = set()
        while waiting:
            name = waiting.pop()
            if name in scope_of and name not in seen:
                seen.add(name)
                scope_of[name] = scope
                waiting += needs.get(name, ())
    return scope_of


def bill(lock: str, project: Mapping[str, Any], time_s: int) -> dict[str, Any]:
    """Return the bill of materials.

    Args:
        lock: Text of ``requirements.lock``.
        project: Table ``project`` of ``pyproject.toml``.
        time_s: Unix time of the release [s].
    """
    packages = sorted(read_lock(lock), key=lambda package: (package.name, package.version))
    scope_of = scopes(packages, project)
    purl = f"pkg:pypi/{project['name']}@{project['version']}"
    direct = [*project["dependencies"]]
    direct += [line for lines in project["optional-dependencies"].values() for line in lines]
    direct_names = {canonicalize_name(Requirement(line).name) for line in direct}
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, purl + lock)}",
        "version": 1,
        "metadata": {
            "timestamp": datetime.fromtimestamp(time_s, UTC).isoformat().replace("+00:00", "Z"),
            "component": {
                "type": "application",
                "bom-ref": purl,
                "name": project["name"],
                "version": project["version"],
                "purl": purl,
                "licenses": [{"license": {"id": project["license"]}}],
            },
        },
        "components": [_component(package, scope_of[package.name]) for package in packages],
        "dependencies": [
            {"ref": purl, "dependsOn": [p.purl for p in packages if p.name in direct_names]},
            *(
                {
                    "ref": package.purl,
                    "dependsOn": [
                        other.purl
                        for other in packages
                        if package.name in map(canonicalize_name, other.needed_by)
                    ],
                }
                for package in packages
            ),
        ],
    }


def _component(package: Locked, scope: str) -> dict[str, Any]:
    component: dict[str, Any] = {
        "type": "library",
        "bom-ref": package.purl,
        "name": package.name,
        "version": package.version,
        "scope": scope,
        "purl": package.purl,
        "externalReferences": [
            {
                "type": "distribution",
                "url": package.purl,
                "comment": "SHA-256 of each file of this version",
                "hashes": [{"alg": "SHA-256", "content": digest} for digest in package.hashes],
            }
        ],
    }
    if package.marker:
        component["properties"] = [{"name": "undulog:marker", "value": package.marker}]
    return component


def write(output: Path, root: Path, time_s: int) -> int:
    """Write the bill of a source tree; return the number of packages."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    document = bill((root / "requirements.lock").read_text(), project, time_s)
    output.write_text(json.dumps(document, indent=1) + "\n")
    return len(document["components"])


if __name__ == "__main__":
    write(Path(sys.argv[1]), ROOT, int(os.environ.get("SOURCE_DATE_EPOCH", "0")))
