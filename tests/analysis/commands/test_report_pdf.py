"""``report --pdf``: the page on paper by a real browser, without network, nothing left behind."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.linear_chain import CHAIN, WAVE, write_run
from support.paths import ROOT
from support.processes import wait_for

GOLDEN = ROOT / "tests/replay/golden/session.mcap"
UNDULOG = Path(sys.executable).with_name("undulog")


def pages(pdf):
    """Number of pages of a PDF file."""
    return len(re.findall(rb"/Type /Page\b", pdf.read_bytes()))


def processes_of(folder):
    """Running processes whose command line names a folder."""
    numbers = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if str(folder).encode() in (entry / "cmdline").read_bytes():
                    numbers.append(entry.name)
            except OSError:
                continue
    return numbers


def script(folder, text):
    """A program in place of the browser."""
    path = folder / "browser"
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A session that is analysed soon."""
    return write_run(tmp_path_factory.mktemp("short") / "run.mcap", WAVE, CHAIN @ WAVE, 1, 0.003)


@pytest.mark.nightly
def test_a_session_on_paper(chromium, tmp_path, command):
    pdf = tmp_path / "run.pdf"
    printed = command("report", GOLDEN, "--pdf", pdf).out.splitlines()
    assert printed[-1].startswith(f"{pdf}: ")
    assert pdf.read_bytes().startswith(b"%PDF-")
    assert pages(pdf) > 3
    assert list(tmp_path.iterdir()) == [pdf], "no page, profile or part is left"
    assert processes_of(tmp_path) == []
    assert "--force" in command("report", GOLDEN, "--pdf", pdf, code=2).err
    pdf.write_text("mine")
    command("report", GOLDEN, "-o", pdf, "--force")
    assert pages(pdf) > 3


@pytest.mark.nightly
def test_page_and_paper_together(chromium, tmp_path, report_of):
    html, pdf = tmp_path / "run.html", tmp_path / "run.pdf"
    result = report_of("report", GOLDEN, "-o", html, "--pdf", pdf)
    assert (result["page"], result["pdf"]) == (str(html), str(pdf))
    assert result["bytes"] == html.stat().st_size
    assert sorted(tmp_path.iterdir()) == [html, pdf]


@pytest.mark.nightly
def test_the_browser_asks_no_network(chromium, tmp_path, command):
    log = tmp_path / "net.json"
    with_log = script(tmp_path, f'exec {chromium} --log-net-log={log} "$@"')
    command("report", GOLDEN, "--pdf", tmp_path / "run.pdf", "--browser", with_log)
    # Chromium's own log of its network stack.
    netlog = json.loads(log.read_text())
    names = {number: name for name, number in netlog["constants"]["logEventTypes"].items()}
    events = [(names[event["type"]], event.get("params", {})) for event in netlog["events"]]
    assert events
    kinds = {name for name, _ in events}
    assert not kinds & {"UDP_BYTES_SENT", "SOCKET_BYTES_SENT", "HOST_RESOLVER_DNS_TASK"}
    tried = {str(facts) for name, facts in events if name == "TCP_CONNECT_ATTEMPT"}
    assert all("127.0.0.1:9" in request for request in tried if "address" in request)


def test_without_a_browser_the_message_says_what_to_do(tmp_path, monkeypatch, command):
    monkeypatch.setenv("PATH", str(tmp_path))
    error = command("report", GOLDEN, "--pdf", tmp_path / "run.pdf", code=2).err
    assert all(word in error for word in ("chromium", "--browser", "UNDULOG_BROWSER", "by hand"))
    monkeypatch.setenv("UNDULOG_BROWSER", "no-such-browser")
    error = command("report", GOLDEN, "--pdf", tmp_path / "run.pdf", code=2).err
    assert "UNDULOG_BROWSER: there is no program no-such-browser" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("echo no display >&2; exit 3", "exit code 3; its last message: no display"),
        ("exit 0", "wrote no PDF"),
    ],
)
def test_a_browser_that_fails_leaves_nothing(text, expected, short, tmp_path, command):
    out = tmp_path / "out"
    out.mkdir()
    failing = script(tmp_path, text)
    error = command("report", short, "--pdf", out / "x.pdf", "--browser", failing, code=1).err
    assert expected in error
    assert list(out.iterdir()) == []


def test_a_browser_that_hangs_is_ended_with_its_children(tmp_path):
    from undulog.analysis.present.page import write_pdf
    from undulog.capture.common.errors import UndulogError

    out = tmp_path / "out"
    out.mkdir()
    hanging = script(tmp_path, f"bash -c 'sleep 600; # {tmp_path}' & wait")
    with pytest.raises(UndulogError, match="within 1 s and was ended"):
        write_pdf("<!doctype html>", out / "x.pdf", str(hanging), longest_s=1.0)
    assert list(out.iterdir()) == []
    assert processes_of(tmp_path) == []


@pytest.mark.nightly
def test_ctrl_c_ends_the_browser(short, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    started = tmp_path / "started"
    hanging = script(tmp_path, f"touch {started}; bash -c 'sleep 600; # {tmp_path}' & wait")
    words = [UNDULOG, "report", short, "--pdf", out / "x.pdf", "--browser", hanging]
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    wait_for(started.exists, "the browser", alive=[running])
    os.kill(running.pid, signal.SIGINT)
    errors = running.communicate()[1].decode()
    assert (running.returncode, "interrupted" in errors) == (1, True)
    assert list(out.iterdir()) == []
    wait_for(lambda: processes_of(hanging) == [], "what was killed")


@pytest.mark.nightly
def test_several_sessions_by_themselves_on_paper(chromium, tmp_path, command):
    pdf = tmp_path / "both.pdf"
    done = command("report", GOLDEN, GOLDEN, "--each", "--pdf", pdf, "--json").out
    assert json.loads(done)["pdf"] == str(pdf)
    pages_dir = tmp_path / "pages"
    pages_dir.mkdir()
    words = ("report", GOLDEN, GOLDEN, "-o", pages_dir, "--pdf", tmp_path / "x.pdf")
    assert "no folder" in command(*words, code=2).err
