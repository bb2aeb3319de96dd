"""The page on recordings of real robots has the numbers that its commands give."""

import sys

import pytest

from support.paths import DOCS, SHARED, STUDIES
from support.processes import run


@pytest.mark.slow
@pytest.mark.built("real-robots")
def test_the_page_is_what_its_script_writes(tmp_path):
    if not SHARED.is_dir():
        pytest.skip(f"the real recordings {SHARED.name} are not beside this checkout")
    script = STUDIES / "real_robots.py"
    run(sys.executable, str(script), str(SHARED), "-o", str(tmp_path), timeout=1800, code=0)
    page = "explanation/real-robots.md"
    assert (tmp_path / page).read_text() == (DOCS / page).read_text()
    for picture in (tmp_path / "images").iterdir():
        assert (DOCS / "images" / picture.name).stat().st_size > 1000
