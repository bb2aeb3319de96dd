"""A format of logs is one file or folder, and hardly anything else names it."""

import io
import re
import tokenize
from collections import defaultdict

import pytest

from support.paths import ROOT
from undulog.capture.exchange.registry.registry import FORMATS

FORMATS_FOLDER = ROOT / "capture/exchange/formats"
PACKAGES = ("undulog", "capture", "sim", "analysis", "replay")
MOST_FOLDERS = 3
COMMON = {"csv", "parquet", "mat", "pt"}
"""Formats of results, catalogues and sweeps, too, and words of their own."""


@pytest.fixture(scope="module")
def folders():
    """Word of an identifier, or of a module's name, to the folders that it stands in."""
    places = defaultdict(set)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            if path.parts[len(ROOT.parts)] == "undulog" and len(path.parts) > len(ROOT.parts) + 2:
                continue  # a link
            tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
            names = {token.string for token in tokens if token.type == tokenize.NAME}
            for name in {*names, path.stem, path.parent.name}:
                apart = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower()
                for word in {*apart.split("_"), apart}:
                    places[word].add(path.parent.relative_to(ROOT))
    assert len(places) > 1000
    return places


def test_each_format_is_a_file_or_a_folder_of_its_own():
    modules = {path.stem for path in FORMATS_FOLDER.glob("*.py")} - {"__init__", "format"}
    modules |= {path.name for path in FORMATS_FOLDER.iterdir() if (path / "format.py").is_file()}
    assert len(modules) == len(FORMATS)


@pytest.mark.parametrize("name", [form.name for form in FORMATS if form.name not in COMMON])
def test_the_names_of_a_format_stand_in_few_folders(name, folders):
    word = re.sub(r"(-layout|\d)$", "", name) if name != "mf4" else name
    assert 1 <= len(folders[word]) <= MOST_FOLDERS, folders[word]
