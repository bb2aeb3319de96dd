"""Processes of a catalogue that stand still are ended within the limit, with a sentence."""

import multiprocessing
import threading

import pytest

from support.processes import freeze, wait_for
from support.written_sessions import write_session
from undulog.analysis.catalog import catalog
from undulog.analysis.catalog.catalog import Catalog
from undulog.capture.common.errors import NoAnswerError


@pytest.mark.slow
def test_analyses_that_stand_still_are_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(catalog, "STILL_S", 3.0)
    write_session(tmp_path / "plain.mcap")
    sessions = Catalog(str(tmp_path))
    sessions.scan()
    frozen = []

    def freeze_all():
        for child in wait_for(multiprocessing.active_children, "a process that analyses"):
            freeze(child.pid)  # it is importing still
            frozen.append(child)

    thread = threading.Thread(target=freeze_all)
    thread.start()
    with pytest.raises(NoAnswerError, match=r"the analyses of the sessions did not answer within"):
        sessions.analyse(workers=1)
    thread.join()
    assert frozen
    wait_for(lambda: not any(child.is_alive() for child in frozen), "their end")
