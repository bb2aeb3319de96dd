"""A release: its notes and its bill of materials, against the lock and the changelog."""

import json
import re
import sys
from collections import Counter
from datetime import datetime

import pytest
from packaging.requirements import Requirement

from support import processes
from support.paths import ROOT


@pytest.fixture(scope="module")
def bill(tmp_path_factory):
    path = tmp_path_factory.mktemp("bill") / "bill.json"
    processes.run(
        *(sys.executable, ".ci/sbom.py", path), cwd=ROOT, env={"SOURCE_DATE_EPOCH": "86400"}, code=0
    )
    return json.loads(path.read_text())


def pins():
    """Package and version of each line of the lock that begins one, read by a foreign parser."""
    text = (ROOT / "requirements.lock").read_text().replace("\\\n", " ")
    lines = [line.partition(" --hash")[0] for line in text.splitlines() if line[:1].isalnum()]
    return [Requirement(line) for line in lines]


def test_the_bill_has_every_package_of_the_lock_with_its_files(bill):
    counter = Counter((component["name"], component["version"]) for component in bill["components"])
    assert counter == Counter(
        (re.sub(r"[._]", "-", pin.name), next(iter(pin.specifier)).version) for pin in pins()
    )
    files = [component["externalReferences"][0]["hashes"] for component in bill["components"]]
    assert sum(map(len, files)) == (ROOT / "requirements.lock").read_text().count("--hash=sha256:")
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert datetime.fromisoformat(bill["metadata"]["timestamp"]).timestamp() == 86400


def test_the_bill_tells_base_extras_and_development_apart(bill):
    scopes = {component["name"]: component["scope"] for component in bill["components"]}
    expected = {"numpy": "required", "wrapt": "required", "pybullet": "optional"}
    expected |= {"kiwisolver": "optional", "pytest": "excluded"}
    assert {name: scopes[name] for name in expected} == expected
    needs = {
        dependency["ref"].partition("@")[0]: dependency["dependsOn"]
        for dependency in bill["dependencies"]
    }
    assert {ref.partition("@")[0] for ref in needs["pkg:pypi/mcap"]} == {
        "pkg:pypi/lz4",
        "pkg:pypi/zstandard",
    }
    refs = {component["bom-ref"] for component in bill["components"]}
    assert {ref for refs_ in needs.values() for ref in refs_} <= refs


@pytest.mark.nightly
def test_a_release_is_whole_and_its_builds_are_the_same_bytes(tmp_path):
    if processes.run("git", "rev-parse", "HEAD", cwd=ROOT).returncode:
        pytest.skip("not a git checkout: there is no last commit")
    done = processes.run(sys.executable, ".ci/release.py", tmp_path, cwd=ROOT, code=0)
    assert "built twice, the same bytes" in done.stdout
    for pattern in ("*.whl", "*.tar.gz", "*-notes.md", "*.cdx.json", "SHA256SUMS"):
        assert len(list(tmp_path.glob(pattern))) == 1
    processes.run("sha256sum", "--check", "--strict", "SHA256SUMS", cwd=tmp_path, code=0)
