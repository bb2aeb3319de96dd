"""Damaged files of a catalogue: found before they are read, set aside, and made again."""

import json
import shutil

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from support.analysed import analysed
from support.linear_chain import CHAIN, WAVE, write_run
from support.written_sessions import write_session
from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.files import CatalogFiles
from undulog.analysis.catalog.sources import FOLDER
from undulog.capture.common.errors import DamagedFileError

pytestmark = pytest.mark.slow

KINDS = ("sessions", "analyses", "joints", "sources")


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """A folder of sessions with its catalogue; one result from a file, one made for it."""
    folder = tmp_path_factory.mktemp("scanned")
    path = write_run(folder / "gait.mcap", WAVE, CHAIN @ WAVE, 1, 0.003)
    result = analysed(path)
    result.save(folder / "gait.json")
    write_session(folder / "plain.mcap")
    write_session(folder / "gone.mcap", count=20)
    catalog = Catalog(str(folder))
    catalog.scan()
    (folder / "gone.mcap").unlink()
    catalog.scan()
    plain = catalog.find().set_index("path").session_id["plain.mcap"]
    facts = result.to_dict()
    renamed = facts | {"session": facts["session"] | {"id": plain}}
    catalog.add_result("analysis of plain.mcap", json.loads(json.dumps(renamed)))
    return folder


@pytest.fixture
def lab(scanned, tmp_path):
    shutil.copytree(scanned, tmp_path / "lab")
    return tmp_path / "lab"


def status_of(catalog):
    return catalog.find().set_index("path").status.to_dict()


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x40
    path.write_bytes(data)


def as_folder(path):
    path.unlink()
    path.mkdir()


DAMAGES = {
    "flipped": flip,
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-30]),
    "empty": lambda path: path.write_bytes(b""),
    "folder": as_folder,
    "foreign": lambda path: pq.write_table(pa.table({"x": [1]}), path),
}


TRIED = {("empty", "analyses"), ("flipped", "sessions")}


def when(damage, kind):
    """Return the mark of a damage: two of them are tried in every integration."""
    return () if (damage, kind) in TRIED else pytest.mark.nightly


@pytest.mark.parametrize(
    ("damage", "kind"),
    [pytest.param(damage, kind, marks=when(damage, kind)) for damage in DAMAGES for kind in KINDS],
)
def test_a_damaged_file_is_set_aside_and_its_rows_are_read_again(lab, kind, damage):
    """Whichever file of a kind it is, also that of what was removed."""
    before = Catalog(str(lab)).find()
    for number in range(len(list((lab / FOLDER / kind).iterdir()))):
        path = sorted((lab / FOLDER / kind).iterdir())[number]
        whole = shutil.copytree(lab, lab.parent / f"lab{number}")
        DAMAGES[damage](whole / path.relative_to(lab))
        catalog = Catalog(str(whole))
        if kind != "sources":  # which only scans read
            with pytest.raises(DamagedFileError, match="a scan of the catalogue sets it aside"):
                catalog.find()
        report = catalog.scan()
        assert len(report.set_aside) == 1
        assert "damaged/" in report.set_aside[0]
        assert len(list((whole / FOLDER / "damaged").iterdir())) == 1
        columns = ["path", "session_id", "robot", "messages", "start"]
        pd.testing.assert_frame_equal(catalog.find()[columns], before[columns])
        statuses = status_of(catalog)
        assert statuses["gait.mcap"] == "analysed"  # its result is a file
        joints = catalog.find("path = 'plain.mcap'", joints=True)
        assert (statuses["plain.mcap"] == "analysed") == (len(joints) > 0)
        assert Catalog(str(whole)).scan().set_aside == ()
        assert Catalog(str(whole)).scan().read == 0


def test_a_file_that_vanishes_after_the_listing_is_listed_anew(lab, monkeypatch):
    before = Catalog(str(lab)).find()
    listed, stale = CatalogFiles.names, ["rows-1-another-process-removed-it.parquet"]

    def names(self, kind):
        gone = [f"{FOLDER}/{kind}/{stale.pop()}"] if stale and kind == "joints" else []
        return listed(self, kind) + gone

    monkeypatch.setattr(CatalogFiles, "names", names)
    rows = Catalog(str(lab)).sql_here("select * from catalog order by path")
    assert not stale
    pd.testing.assert_frame_equal(rows, before)


def test_a_scan_that_was_interrupted_leaves_the_damage_to_be_found(lab):
    (path, *_) = (lab / FOLDER / "sources").iterdir()
    flip(path)

    class Stopped:
        requested = True

    report = Catalog(str(lab)).scan(stop=Stopped())
    assert (report.complete, report.set_aside) == (False, ())
    report = Catalog(str(lab)).scan()
    assert (report.complete, report.read, len(report.set_aside)) == (True, 3, 1)


def test_two_that_find_the_same_damage(lab):
    (path, *_) = (lab / FOLDER / "sessions").iterdir()
    flip(path)
    first, second = Catalog(str(lab)), Catalog(str(lab))
    first._files.find_damaged()
    second._files.find_damaged()
    assert len(first._files.set_damaged_aside()) == 1
    assert second._files.set_damaged_aside() == []


def test_the_command_reports_the_damage(lab, command):
    (path, *_) = (lab / FOLDER / "sessions").iterdir()
    flip(path)
    assert "checksum" in command("catalog", lab, "--no-scan", code=1).err
    shown = command("catalog", lab)
    assert "moved to .undulog-catalog/damaged/" in shown.err
    assert "2 rows" in shown.out
    (lab / FOLDER / "lock").unlink(missing_ok=True)
    assert command("catalog", lab).err == ""


def test_files_of_an_earlier_version_are_read_and_replaced_by_whole_ones(lab):
    before = Catalog(str(lab)).find()
    for path in (lab / FOLDER).rglob("*.parquet"):
        path.rename(path.with_name(path.name.rpartition("-")[0] + ".parquet"))
    pd.testing.assert_frame_equal(Catalog(str(lab)).find(), before)
    assert Catalog(str(lab)).scan().read == 0
    names = [path.name for path in (lab / FOLDER).rglob("*.parquet")]
    assert len(names) == len(KINDS)
    assert all(name.startswith("all-") and name.count("-") == 3 for name in names)
    pd.testing.assert_frame_equal(Catalog(str(lab)).find(), before)


def test_rows_of_a_sweep_that_are_none_are_a_fault_of_that_file(lab):
    (lab / "sweep" / "rows").mkdir(parents=True)
    rows = [
        {"status": "done", "session_id": "a", "joint": ["j", "k"], "gain": [1.0]},
        {"status": "done", "session_id": "a", "joint": ["j"], "frequency_hz": "fast"},
        {"status": 1, "session_id": 2.0, "joint": [3]},
    ]
    for number, row in enumerate(rows):
        pq.write_table(pa.Table.from_pylist([row]), lab / "sweep" / "rows" / f"{number}.parquet")
    (lab / "sweep" / "rows" / "cut.parquet").write_bytes(b"PAR1")
    report = Catalog(str(lab)).scan()
    assert report.damaged == 3
    assert report.set_aside == ()
