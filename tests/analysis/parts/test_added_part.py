"""The part of the manual, in a package of its own: in text, JSON, page, data frames and CSV."""

import json
import os
import re
import subprocess
import sys

import pytest

from support.paths import ROOT
from support.written_sessions import write_session

PAGE = (ROOT / "docs/reference/parts.md").read_text()
CODE = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]
POINT = 'following_error = "undulog_error:PART"'


@pytest.fixture
def session(tmp_path):
    path = tmp_path / "run.mcap"
    write_session(path)
    return path


def package(folder, code=CODE, point=POINT):
    """Lay out what an installed package is."""
    info = folder / "undulog_error-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "undulog_error.py").write_text(code)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: undulog-error\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[undulog.parts]\n{point.replace(chr(34), '')}\n")
    return folder


def run(*words, packages, code=0):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *map(str, packages)])}
    result = subprocess.run(
        [sys.executable, "-m", "undulog", *map(str, words)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert result.returncode == code, result.stderr
    return result.stdout if code == 0 else result.stderr


def test_it_takes_at_most_forty_lines():
    lines = [line for line in CODE.splitlines() if line.strip()]
    assert len(lines) <= 40


def test_it_stands_in_text_json_page_and_csv(session, tmp_path):
    with_part, without = [package(tmp_path / "part")], []
    text = run("analyse", session, packages=with_part)
    assert "Following error" in text
    assert "error [rad]" in text
    assert "Following error" not in run("analyse", session, packages=without)
    result = json.loads(run("analyse", session, "--json", packages=with_part))
    errors = {row["joint"]: row["rms_rad"] for row in result["following_error"]["joints"]}
    assert errors
    run("analyse", session, "--csv", tmp_path / "tables", packages=with_part)
    rows = (tmp_path / "tables/following_error.csv").read_text().splitlines()
    assert rows[0].startswith("joint,rms_rad")
    assert [row.split(",")[0] for row in rows[1:]] == list(errors)
    page = tmp_path / "page.html"
    run("report", session, "-o", page, packages=with_part)
    html = page.read_text()
    assert 'id="part-following_error"' in html
    assert "Root mean square of the error, head to tail." in html
    file = tmp_path / "result.json"
    run("analyse", session, "-o", file, packages=with_part)
    again = "import sys; from undulog.analysis import load; print(sorted(load(sys.argv[1]).more))"
    for packages in (with_part, without):
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), *map(str, packages)]),
        }
        words = [sys.executable, "-c", again, str(file)]
        output = subprocess.run(words, capture_output=True, text=True, env=environment, check=True)
        assert output.stdout == "['following_error']\n"


def test_a_folder_beside_the_others_is_enough(session, tmp_path):
    """A part of undulog itself is found in its folder: nothing else names it."""
    folder = tmp_path / "more/following_error"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "part.py").write_text(f"{CODE}\n\nPARTS = (PART,)\n")
    (tmp_path / "sitecustomize.py").write_text(
        "import undulog.analysis.parts as parts\n"
        f"parts.__path__.append({str(tmp_path / 'more')!r})\n"
    )
    assert "error [rad]" in run("analyse", session, packages=[tmp_path])
    result = json.loads(run("analyse", session, "--json", packages=[tmp_path]))
    assert result["following_error"]["joints"]
    run("analyse", session, "--csv", tmp_path / "tables", packages=[tmp_path])
    assert (tmp_path / "tables/following_error.csv").exists()
    run("report", session, "-o", tmp_path / "page.html", packages=[tmp_path])
    assert 'id="part-following_error"' in (tmp_path / "page.html").read_text()


UNUSABLE = {
    "no part": ("PART = 3\n", POINT, "is no undulog.analysis.parts.part.Part"),
    "no import": ("import nowhere\n", POINT, "can't be loaded: No module named 'nowhere'"),
    "name taken": (
        CODE.replace('"following_error", measure', '"gait", measure'),
        'gait = "undulog_error:PART"',
        "claims a key that is taken",
    ),
    "other name": (CODE, 'other = "undulog_error:PART"', "the name of its entry point"),
    "no such need": (CODE.replace('("artefacts",)', '("effects",)'), POINT, "the part 'effects'"),
}
FAILING = {
    "hidden need": (CODE.replace('("artefacts",)', "()"), "name it in its 'needs'"),
    "nan": (CODE.replace("Estimate(rms)", "np.nan"), "Out of range float values"),
    "other result": (CODE.replace("FollowingError(tuple(errors)) if", "(1,) if"), "it is a tuple"),
    "measure": (CODE.replace("errors = []", "1 / 0"), "failed: ZeroDivisionError"),
    "show": (CODE.replace("caption =", "1 / 0 #"), "failed: ZeroDivisionError"),
}


@pytest.mark.parametrize(("code", "point", "message"), list(UNUSABLE.values()), ids=UNUSABLE)
def test_a_part_that_can_not_be_used_is_named(code, point, message, session, tmp_path):
    trouble = run("analyse", session, packages=[package(tmp_path / "part", code, point)], code=2)
    assert message in trouble
    assert "Traceback" not in trouble


@pytest.mark.parametrize(("code", "message"), list(FAILING.values()), ids=FAILING)
def test_a_part_that_fails_is_named(code, message, session, tmp_path):
    trouble = run("analyse", session, packages=[package(tmp_path / "part", code)], code=1)
    assert "'following_error'" in trouble
    assert message in trouble
    assert "Traceback" not in trouble
