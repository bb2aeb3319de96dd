"""Print a page to a PDF file with a browser that is installed (Chromium, Chrome, Edge)."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

from undulog.capture.common.errors import UndulogError, UsageError
from undulog.capture.common.files import part_file

VARIABLE = "UNDULOG_BROWSER"
"""Environment variable that names the browser."""

_NAMES = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "microsoft-edge-stable", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
)

LONGEST_S = 120.0
"""After which a browser is ended [s]."""

_FLAGS = (
    *("--headless", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
    *("--no-default-browser-check", "--disable-extensions", "--disable-default-apps"),
    # No network: neither by the page, whose policy forbids it, nor by the browser itself.
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-domain-reliability", "--disable-features=NetworkTimeServiceQuerying,MediaRouter"),
    *("--host-resolver-rules=MAP * ~NOTFOUND", "--proxy-server=127.0.0.1:9"),  # port 9: discard
    *("--no-pdf-header-footer", "--generate-pdf-document-outline"),
)


def find_browser(given: str | None = None) -> str:
    """Return the path of the browser that prints.

    Args:
        given: Name or path; None for that of ``UNDULOG_BROWSER`` or else the first that is found.

    Raises:
        UsageError: If there is none.
    """
    source = "--browser"
    if given is None:
        given, source = os.environ.get(VARIABLE) or None, VARIABLE
    if given is not None:
        if (path := shutil.which(given)) is None:
            raise UsageError(f"{source}: there is no program {given} to print with")
        return path
    if path := next(filter(None, map(shutil.which, _NAMES)), None):
        return path
    raise UsageError(
        "a PDF needs a browser to print with, and none of Chromium, Google Chrome and Microsoft "
        f"Edge is on the path: install one (Debian: apt-get install chromium), name it by "
        f"--browser or {VARIABLE}, or write the page with -o PAGE.html and print it by hand"
    )


def write_pdf(page: str, output: Path, browser: str, longest_s: float = LONGEST_S) -> None:
    """Print a page; the browser and its processes have ended when this returns or raises.

    Args:
        page: HTML without outside references.
        output: The PDF file, under a partial name until it is complete.
        browser: From :func:`find_browser`.
        longest_s: Time limit [s].

    Raises:
        UndulogError: If the browser fails or exceeds the time limit.
    """
    # Beside the output, since a confined browser reads and writes in no temporary folder.
    with (
        tempfile.TemporaryDirectory(
            prefix="undulog-pdf-", dir=output.parent, ignore_cleanup_errors=True
        ) as scratch,
        part_file(output) as part,
    ):
        folder = Path(scratch).resolve()
        source, printed = folder / "page.html", folder / "page.pdf"
        source.write_text(page, encoding="utf-8")
        flags = [*_FLAGS, f"--user-data-dir={folder / 'profile'}", f"--print-to-pdf={printed}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            flags.append("--no-sandbox")  # Chromium has no sandbox for the superuser
        _run([browser, *flags, source.as_uri()], folder / "messages", longest_s)
        if not printed.is_file() or printed.read_bytes()[:5] != b"%PDF-":
            raise _failure(browser, "wrote no PDF", folder / "messages")
        shutil.copyfile(printed, part)


def _run(command: list[str], messages: Path, longest_s: float) -> None:
    """Run a browser and end the group of its processes, whatever happens."""
    with messages.open("wb") as log:
        process = subprocess.Popen(  # noqa: S603  our own arguments
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=log,
            process_group=0,  # a Ctrl-C ends it through us
        )
        try:
            code = process.wait(longest_s)
        except subprocess.TimeoutExpired:
            why = f"did not print the page within {longest_s:g} s and was ended"
            raise _failure(command[0], why, messages) from None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if code:
        raise _failure(command[0], f"ended with exit code {code}", messages)


def _failure(browser: str, why: str, messages: Path) -> UndulogError:
    lines = messages.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    said = f"; its last message: {lines[-1]}" if lines else ""
    return UndulogError(
        f"{browser} {why}{said}; name another browser by --browser, or write the page with "
        "-o PAGE.html and print it by hand"
    )
