"""Commands as a user without rights."""

import os
import shutil
import sys

import pytest

NOBODY = 65534


def as_nobody():
    """Return the words before a command that is to run as nobody; skips where that can't be.

    The interpreter and this tree may lie in a folder that is private: nobody may read everything
    here, but writes only what anyone may.
    """
    if os.geteuid() or shutil.which("setpriv") is None:
        pytest.skip("needs root and setpriv")
    ids = (f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")
    rights = ("--inh-caps=-all,+dac_read_search", "--ambient-caps=+dac_read_search")
    return ("setpriv", *ids, *rights)


def environment(folder, **more):
    """Return the environment of a user whose home isn't there."""
    kept = {name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ}
    return kept | {"HOME": "/nonexistent", "TMPDIR": str(folder)} | more


def as_other(program, *words):
    """Return the words that run a Python program as nobody."""
    return (*as_nobody(), sys.executable, "-c", program, *map(str, words))
