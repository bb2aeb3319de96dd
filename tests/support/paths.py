"""Folders of the repository, and the recordings of real robots beside it."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
STUDIES = ROOT / "studies"
SHARED = ROOT.parent / "shared" / "data"
ARCSNAKE = SHARED / "arcsnake"
TRACE = ARCSNAKE / "linear_trajectory.candump.log"
