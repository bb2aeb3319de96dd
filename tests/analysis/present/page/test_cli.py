"""Command ``report``: answer on the terminal, page on disk, nothing overwritten by accident."""

import json

import pytest

import undulog
from support.paths import SHARED

REAL = SHARED / "arcsnake" / "linear_trajectory.candump.log"


@pytest.fixture(scope="module")
def page(recorded, tmp_path_factory):
    """The page on the recorded session."""
    path = tmp_path_factory.mktemp("page") / "run.html"
    assert undulog.run(["report", str(recorded), "-o", str(path)]) == 0
    return path


def test_it_prints_the_answer_and_writes_the_page(page, recorded, capsys):
    assert undulog.run(["report", str(recorded), "-o", str(page), "--force"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    # Planted lag 7.46 + 6.2 sin(pi place): the middle five joints lie at 1/3, 5/12, 1/2, 7/12, 2/3,
    # so they lag 6.2 (2 sin 60 + 2 sin 75 + 1)/5 = 5.783 degrees more than the ends.
    assert first.startswith("The segments do not move alike: the middle joints lag 5.78° [")
    assert second.startswith(f"{page}: ")
    assert first.partition(":")[0] in page.read_text(encoding="utf-8")
    assert list(page.parent.iterdir()) == [page], "no half-written file is left"


def test_json_names_page_and_answer_and_the_page_is_the_same(page, recorded, tmp_path, capsys):
    again = tmp_path / "run.html"
    assert undulog.run(["report", str(recorded), "-o", str(again), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["page"] == str(again)
    assert said["bytes"] == again.stat().st_size
    assert [a["verdict"] for a in said["answers"]] == ["unlike"]
    assert again.read_bytes() == page.read_bytes()


def test_several_sessions_are_one_experiment(both_ways_files, tmp_path, capsys):
    page = tmp_path / "both.html"
    files = [str(path) for path in both_ways_files]
    assert undulog.run(["report", *files, "-o", str(page)]) == 0
    first, second = capsys.readouterr().out.splitlines()
    order = "j2 answers less than its mirror j4 (p = 0.002)"
    assert first.startswith(f"12 sessions: the modules differ: {order}")
    assert second.startswith(f"{page}: ")
    told = page.read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
    assert f"The modules differ: {order}" in told
    assert undulog.run(["report", *files, "-o", str(page), "--force", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["answer"] == first
    assert [one["path"] for one in said["answers"]] == files


def test_an_existing_page_stays_without_force(recorded, tmp_path, capsys):
    page = tmp_path / "run.html"
    page.write_text("mine")
    assert undulog.run(["report", str(recorded), "-o", str(page)]) == 2
    assert "--force" in capsys.readouterr().err
    assert page.read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["-o", "x.html"], "at least one session"),
        (["run.mcap", "-o", "x.pdf"], "end its name in .html"),
        (["run.mcap", "-o", "x.html", "--start", "5", "--stop", "4"], "not after --start 5"),
        (["run.mcap"], "--output"),
    ],
)
def test_wrong_usage_exits_2_and_says_why(arguments, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert undulog.run(["report", *arguments]) == 2
    assert complaint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_session_exits_1_and_leaves_nothing(tmp_path, capsys):
    page = tmp_path / "run.html"
    assert undulog.run(["report", str(tmp_path / "no.mcap"), "-o", str(page)]) == 1
    assert "no.mcap" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_real_ramp_gets_its_page_without_invented_numbers(tmp_path, capsys):
    if not REAL.is_file():
        pytest.skip(f"no real recording at {REAL}")
    session, page = tmp_path / "real.mcap", tmp_path / "real.html"
    imported = ["import", str(REAL), "-o", str(session), "--robot", "arcsnake-joint"]
    assert undulog.run(imported) == 0
    capsys.readouterr()
    assert undulog.run(["report", str(session), "-o", str(page)]) == 0
    assert capsys.readouterr().out.startswith("No gait was found in this session")
    text = page.read_text(encoding="utf-8")
    assert "Command and response of joint01" in text
    assert "No gait: the best rhythm" in text


@pytest.mark.slow
def test_the_paper_s_claim_from_the_twin_to_the_browser(browser, tmp_path, capsys):
    session, page = tmp_path / "weak.mcap", tmp_path / "weak.html"
    assert undulog.run(["sim", "run", "weak-servo-pi3", "-o", str(session)]) == 0
    capsys.readouterr()
    assert undulog.run(["report", str(session), "-o", str(page)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("The segments do not move alike: the middle yaw joints lag ")
    browser.open(page.as_uri())
    assert browser.requests() == [page.as_uri()]
    assert browser.complaints() == []
    titles = browser.evaluate(
        "[...document.querySelectorAll('svg > title')].map(t => t.textContent)"
    )
    assert titles == [
        "Gain, lag and energy of every joint, head to tail",
        "Command and response of joint01, joint13, joint25",
        "Gain of every joint in every cycle",
        "Lag [°] of every joint in every cycle",
        "Mean mechanical power [mW] of every joint in every cycle",
        "Motion of head, middle, tail over one gait cycle",
    ]
    assert page.stat().st_size < 3_000_000
