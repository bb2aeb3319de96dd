"""Command ``report``: answer on the terminal, page on disk, nothing overwritten by accident."""

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


@pytest.mark.slow
def test_it_prints_the_answer_and_writes_the_page(page, recorded, command):
    first, second = command("report", recorded, "-o", page, "--force").out.splitlines()
    # Planted lag 7.46 + 6.2 sin(pi place): the middle five joints lie at 1/3, 5/12, 1/2, 7/12, 2/3,
    # so they lag 6.2 (2 sin 60 + 2 sin 75 + 1)/5 = 5.783 degrees more than the ends.
    assert first.startswith("The segments do not move alike: the middle joints lag 5.78° [")
    assert second.startswith(f"{page}: ")
    assert first.partition(":")[0] in page.read_text(encoding="utf-8")
    assert list(page.parent.iterdir()) == [page], "no half-written file is left"


@pytest.mark.nightly
def test_json_names_page_and_answer_and_the_page_is_the_same(page, recorded, tmp_path, report_of):
    again = tmp_path / "run.html"
    result = report_of("report", recorded, "-o", again)
    assert (result["page"], result["bytes"]) == (str(again), again.stat().st_size)
    assert [a["verdict"] for a in result["answers"]] == ["unlike"]
    assert again.read_bytes() == page.read_bytes()


@pytest.mark.nightly
def test_several_sessions_are_one_experiment(both_ways_files, tmp_path, command, report_of):
    page = tmp_path / "both.html"
    files = [str(path) for path in both_ways_files]
    first, second = command("report", *files, "-o", page).out.splitlines()
    order = "j2 answers less than its mirror j4 (p = 0.002)"
    assert first.startswith(f"12 sessions: the modules differ: {order}")
    assert second.startswith(f"{page}: ")
    text = page.read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
    assert f"The modules differ: {order}" in text
    result = report_of("report", *files, "-o", page, "--force")
    assert (result["answer"], [answer["path"] for answer in result["answers"]]) == (first, files)


def test_an_existing_page_stays_without_force(recorded, tmp_path, command):
    page = tmp_path / "run.html"
    page.write_text("mine")
    assert "--force" in command("report", recorded, "-o", page, code=2).err
    assert page.read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["-o", "x.html"], "at least one session"),
        (["run.mcap", "-o", "x.txt"], "end its name in .html"),
        (["run.mcap", "-o", "x.html", "--pdf", "x.ps"], "in .pdf"),
        (["run.mcap", "-o", "x.pdf", "--pdf", "y.pdf"], "ends in .html"),
        (["run.mcap", "-o", "x.html", "--browser", "chromium"], "add --pdf"),
        (["run.mcap", "--pdf", "x.pdf", "--browser", "/no/browser"], "no program /no/browser"),
        (["run.mcap"], "--output"),
    ],
)
def test_wrong_usage_exits_2_and_says_why(arguments, complaint, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    assert complaint in command("report", *arguments, code=2).err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_session_exits_1_and_leaves_nothing(tmp_path, command):
    words = ("report", tmp_path / "no.mcap", "-o", tmp_path / "run.html")
    assert "no.mcap" in command(*words, code=1).err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_a_real_ramp_gets_its_page_without_invented_numbers(tmp_path, command):
    if not REAL.is_file():
        pytest.skip(f"no real recording at {REAL}")
    session, page = tmp_path / "real.mcap", tmp_path / "real.html"
    command("import", REAL, "-o", session, "--robot", "arcsnake-joint")
    printed = command("report", session, "-o", page).out
    assert printed.startswith("No gait: the commands are of the kind broadband; ")
    text = page.read_text(encoding="utf-8")
    assert "Command and response of joint01" in text
    assert "No gait: the best rhythm" in text


@pytest.mark.nightly
def test_the_paper_s_claim_from_the_twin_to_the_browser(browser, tmp_path, command):
    session, page = tmp_path / "weak.mcap", tmp_path / "weak.html"
    command("sim", "run", "weak-servo-pi3", "-o", session)
    printed = command("report", session, "-o", page).out
    assert printed.startswith("The segments do not move alike: the middle yaw joints lag ")
    browser.open(page.as_uri())
    assert (browser.requests(), browser.complaints()) == ([page.as_uri()], [])
    titles = browser.evaluate(
        "[...document.querySelectorAll('svg > defs > title')].map(t => t.textContent)"
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
