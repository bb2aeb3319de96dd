"""The page on recordings of real robots has the numbers that its commands give."""

import runpy
import sys

import pytest

from support.paths import DOCS, SHARED
from support.processes import run


@pytest.mark.slow
def test_the_page_is_what_its_script_writes(tmp_path):
    if not SHARED.is_dir():
        pytest.skip(f"the real recordings {SHARED.name} are not beside this checkout")
    page = (DOCS / "explanation" / "real-robots.md").read_text()
    script = DOCS / "real_robots.py"
    inputs_line = runpy.run_path(str(script))["inputs_line"]
    if page.endswith(inputs_line(SHARED)):
        return  # nothing that it is made of has changed since ``make pages``
    run(sys.executable, str(script), str(SHARED), "--out", str(tmp_path), timeout=1800, code=0)
    made = (tmp_path / "explanation" / "real-robots.md").read_text()
    assert made.rpartition("\n% ")[0] == page.rpartition("\n% ")[0]
    for picture in (tmp_path / "images").iterdir():
        assert (DOCS / "images" / picture.name).stat().st_size > 1000
