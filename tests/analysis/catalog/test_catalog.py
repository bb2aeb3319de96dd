"""The catalogue against the sessions themselves, the mcap package and many writers at once."""

import json
import os
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from support import durable_child as recorder
from support.analysed import analysed as analysed_session
from support.bucket import s3_bucket
from support.bus_robots import HEAD, LINK
from support.kills import killed_after
from support.linear_chain import CHAIN, WAVE, write_run
from support.written_sessions import joint_state, write_foreign, write_session
from undulog.analysis.catalog.catalog import Catalog
from undulog.analysis.catalog.sources import FOLDER
from undulog.capture import Session
from undulog.capture.common.errors import InputFileError, NotALogError, UsageError
from undulog.capture.common.part_files import unfinished_path
from undulog.capture.log.read.facts import MOST_REQUESTS, read_facts
from undulog.capture.robot.description import parse_robot


def facts_of(path, requests=None):
    data = path.read_bytes()

    def read(start, stop):
        assert 0 <= start <= stop <= len(data)
        if requests is not None:
            requests.append((start, stop))
        return data[start:stop]

    return read_facts(str(path), len(data), read)


@pytest.fixture(scope="module")
def analysed(tmp_path_factory):
    """A session with a gait, and its result."""
    folder = tmp_path_factory.mktemp("analysed")
    path = write_run(folder / "gait.mcap", WAVE, CHAIN @ WAVE, 1, 0.003)
    return path, analysed_session(path)


@pytest.fixture
def lab(tmp_path, analysed):
    """Sessions in a folder and one below, one of them analysed."""
    path, result = analysed
    (tmp_path / "day1").mkdir()
    shutil.copy(path, tmp_path / "day1" / "gait.mcap")
    result.save(tmp_path / "day1" / "gait.json")
    write_session(tmp_path / "plain.mcap", metadata={"operator": "Ada"})
    (tmp_path / "notes.json").write_text('{"answer": 42}')
    return tmp_path


def test_facts_are_those_of_the_mcap_package_within_few_requests(tmp_path):
    write_session(tmp_path / "long.mcap", count=20_000)
    requests = []
    facts = facts_of(tmp_path / "long.mcap", requests)
    with (tmp_path / "long.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    counted = summary.statistics
    assert (facts.start_ns, facts.messages) == (counted.message_start_time, counted.message_count)
    assert facts.end_ns == counted.message_end_time
    assert facts.topics == tuple(sorted({channel.topic for channel in summary.channels.values()}))
    assert facts.metadata == {name: metadata[name] for name in facts.metadata}
    assert {"undulog", "undulog.health"} <= facts.metadata.keys()
    assert len(requests) <= MOST_REQUESTS
    assert sum(stop - start for start, stop in requests) < 300_000


def test_facts_of_cut_and_lying_files(tmp_path):
    write_session(tmp_path / "whole.mcap")
    whole = (tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    for size in (8, 9, 40, 700, len(whole) // 2, len(whole) - 9, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert "recover" in facts_of(path).damage
    path.write_bytes(b"no log")
    with pytest.raises(NotALogError):
        facts_of(path)
    random = np.random.default_rng(3)
    for _ in range(300):  # any answer, but no error of another kind and nothing beyond the file
        data = bytearray(whole)
        for at in random.integers(max(8, len(whole) - 3000), len(whole) - 8, 4):
            data[at] = random.integers(256)
        path.write_bytes(data)
        facts_of(path)


@pytest.mark.slow
def test_a_row_a_session_with_the_results_beside_it(lab, analysed):
    _, result = analysed
    catalog = Catalog(str(lab))
    report = catalog.scan()
    assert (report.sessions, report.read, report.damaged, report.complete) == (2, 4, 0, True)
    rows = catalog.find().set_index("path")
    assert rows.index.to_list() == ["day1/gait.mcap", "plain.mcap"]
    with Session.open(lab / "plain.mcap") as session:
        plain = rows.loc["plain.mcap"]
        assert (plain.duration_s, plain.start_ns) == (session.duration_s, session.start_ns)
        assert plain.start == pd.Timestamp(session.start_ns)  # UTC
        assert (plain.verdict, plain.operator, plain.session_id) == ("good", "Ada", "s1")
        assert plain.messages == sum(channel.count for channel in session.channels.values())
    assert rows.status.to_list() == ["analysed", "not analysed"]
    assert pd.isna(rows.lag_sd["plain.mcap"])
    gait = rows.loc["day1/gait.mcap"]
    assert gait.sentence == result.answer.sentence
    assert gait.lag_sd == result.heterogeneity["lag_sd"].value
    assert (gait.lag_sd_low, gait.lag_sd_high) == result.heterogeneity["lag_sd"].ci95
    joints = catalog.find(joints=True)
    assert joints.joint.to_list() == [joint.name for joint in result.joints]
    assert joints.gain.to_list() == [joint.gain.value for joint in result.joints]
    assert joints.lag_rad_high.to_list() == [joint.lag_rad.ci95[1] for joint in result.joints]
    assert set(joints.path) == {"day1/gait.mcap"}
    assert len(catalog.find(f"lag_sd > {gait.lag_sd / 2} and duration_s > 5")) == 1
    assert len(catalog.find("operator = 'Ada' and status = 'not analysed'")) == 1
    assert catalog.sql("select count(*) as n from joints").n[0] == len(result.joints)


@pytest.mark.slow
def test_only_new_and_changed_files_are_read(lab, monkeypatch):
    Catalog(str(lab)).scan()
    opened = []
    monkeypatch.setattr(Catalog, "_read_file", lambda self, file: opened.append(file))
    assert Catalog(str(lab)).scan().read == 0
    assert opened == []
    monkeypatch.undo()
    write_session(lab / "plain.mcap", count=10, force=True)
    write_session(lab / "new.mcap", count=20)
    (lab / "day1" / "gait.mcap").unlink()
    report = Catalog(str(lab)).scan()
    assert (report.read, report.removed, report.sessions) == (2, 1, 2)
    rows = Catalog(str(lab)).find()
    assert rows.path.to_list() == ["new.mcap", "plain.mcap"]
    assert rows.duration_s.to_list() == [0.19, 0.09]
    write_session(lab / "day1" / "gait.mcap", count=5)  # and it comes back
    Catalog(str(lab)).scan()
    assert "day1/gait.mcap" in Catalog(str(lab)).find().path.to_list()


@pytest.mark.nightly
def test_analyses_are_made_on_request_and_again_when_the_session_changes(lab, analysed):
    _, result = analysed
    (lab / "day1" / "gait.json").unlink()
    catalog = Catalog(str(lab))
    catalog.scan()
    assert catalog.analyse() == {}
    rows = catalog.find().set_index("path")
    assert rows.sentence["day1/gait.mcap"] == result.answer.sentence
    assert (rows.status == "analysed").all()
    assert catalog.analyse() == {}
    (lab / "day1" / "gait.mcap").unlink()
    write_run(lab / "day1" / "gait.mcap", WAVE, CHAIN @ WAVE, 2, 0.002)
    catalog.scan()
    assert catalog.find("path = 'day1/gait.mcap'").status.to_list() == ["not analysed"]


@pytest.mark.nightly
def test_a_session_that_can_t_be_analysed_has_its_reason(tmp_path):
    write_foreign(tmp_path / "text.mcap", [("/a", 1, {"data": "x"})], "std_msgs/msg/String")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "no.mcap").write_text("no log")
    catalog = Catalog(str(tmp_path))
    assert catalog.scan().damaged == 1
    assert catalog.find("damage is not null").path.to_list() == ["other/no.mcap"]
    assert catalog.analyse().keys() == {"text.mcap"}
    assert "/joint_commands" in catalog.analyse()["text.mcap"]


@pytest.mark.slow
def test_a_damaged_copy_has_none_of_the_results_of_the_whole_session(lab):
    whole = (lab / "day1" / "gait.mcap").read_bytes()
    (lab / "copy.mcap").write_bytes(whole[: len(whole) // 2])
    catalog = Catalog(str(lab))
    catalog.scan()
    rows = catalog.find("path in ('copy.mcap', 'day1/gait.mcap')")
    assert rows.session_id.nunique() == 1
    assert rows.status.to_list() == ["not analysed", "analysed"]
    assert set(catalog.find(joints=True).path) == {"day1/gait.mcap"}
    (lab / "day1" / "gait.mcap").unlink()  # alone, it is the session that the result names
    catalog.scan()
    assert catalog.find("path = 'copy.mcap'").status.to_list() == ["analysed"]


@pytest.mark.slow
@pytest.mark.parametrize("left", [None, b""], ids=["missing", "empty"])
def test_a_session_that_has_only_its_write_ahead_log(tmp_path, left, opened):
    path = tmp_path / "run.mcap"
    killed_after([sys.executable, recorder.__file__, str(path), "{}"], 300)
    part = unfinished_path(path)
    part.unlink(missing_ok=True)  # what a power failure can leave of a file that is not synced
    if left is not None:
        part.write_bytes(left)
    catalog = Catalog(str(tmp_path))
    assert (catalog.scan().damaged, Catalog(str(tmp_path)).scan().read) == (1, 0)
    (row,) = catalog.find().itertuples()
    assert (row.path, row.session_id, row.status) == ("run.mcap", "killed", "not analysed")
    assert row.damage.endswith("undulog log recover run.mcap")
    assert [*row.topics] == sorted(recorder.TOPICS)
    assert opened(path).session_id == row.session_id
    (tmp_path / "run.mcap.wal" / "def-000001.seg").write_bytes(b"no segment")
    for segment in (tmp_path / "run.mcap.wal").glob("0*.seg"):
        segment.unlink()
    assert catalog.scan().damaged == 1
    assert "no readable header" in catalog.find().damage[0]
    shutil.rmtree(tmp_path / "run.mcap.wal")
    part.unlink(missing_ok=True)
    assert catalog.scan().removed == 1
    assert not len(catalog.find())


@pytest.mark.slow
def test_parts_of_a_session_are_one_row(tmp_path):
    sink = recorder.open_sink(tmp_path / "run.mcap")
    for number in range(900):
        if number in (300, 600):
            sink.split()
        recorder.write(sink, number)
    sink.close(())
    write_session(tmp_path / "other.mcap")
    catalog = Catalog(str(tmp_path))
    assert catalog.scan().sessions == 4
    rows = catalog.find().set_index("path")
    assert rows.parts.to_dict() == {"other.mcap": 1, "run.mcap": 3}
    with Session.open(tmp_path / "run.mcap") as session:
        assert rows.messages["run.mcap"] == sum(
            channel.count for channel in session.channels.values()
        )
        assert rows.duration_s["run.mcap"] == session.duration_s
        assert rows.start_ns["run.mcap"] == session.start_ns


@pytest.mark.slow
def test_the_id_of_a_foreign_log_is_of_its_content(tmp_path, opened):
    logs = [
        [
            ("/joint_states", 10**18 + k * 10**7, joint_state(0, ["a"], [k * step]))
            for k in range(99)
        ]
        for step in (1.0, 2.0)
    ]
    for place, messages in zip(("0", "1", "2"), (*logs, logs[0]), strict=True):
        (tmp_path / place).mkdir()
        write_foreign(tmp_path / place / f"run{place if place == '2' else ''}.mcap", messages)
    catalog = Catalog(str(tmp_path))
    catalog.scan()
    ids = catalog.find().set_index("path").session_id
    assert ids["0/run.mcap"] == ids["2/run2.mcap"] != ids["1/run.mcap"]
    assert opened(tmp_path / "2/run2.mcap").session_id == ids["2/run2.mcap"]


def test_the_serial_number_is_that_of_the_description_or_of_the_metadata(tmp_path):
    worm = parse_robot(f'serial = "0007"{HEAD}{LINK}', "worm.toml", {})
    assert worm.serial == "0007"
    write_session(tmp_path / "a.mcap", robot=worm)
    write_session(tmp_path / "b.mcap", robot=worm, metadata={"serial": "0008"})
    write_session(tmp_path / "c.mcap")
    catalog = Catalog(str(tmp_path))
    catalog.scan()
    serials = catalog.find().set_index("path").serial
    assert serials[["a.mcap", "b.mcap"]].to_list() == ["0007", "0008"]
    assert pd.isna(serials["c.mcap"])
    assert len(catalog.find("serial = '0007'")) == 1


@pytest.mark.nightly
def test_a_catalogue_of_an_earlier_version_is_read_anew_and_keeps_its_results(lab):
    catalog = Catalog(str(lab))
    catalog.scan()
    for path in (lab / FOLDER / "sources").iterdir():
        table = pq.read_table(path).drop_columns("version")
        pq.write_table(table, path.with_name("rows-1790000000000000000-0123abcd.parquet"))
        path.unlink()
    before = catalog.find()
    assert catalog.scan().read == 4
    pd.testing.assert_frame_equal(catalog.find(), before)
    assert catalog.scan().read == 0


def _write_many(arguments):
    folder, number, results = arguments
    catalog = Catalog(folder)
    result = json.loads((Path(folder) / "day1" / "gait.json").read_text())
    for k in range(results):
        changed = result | {"session": result["session"] | {"id": f"{number}-{k}"}}
        catalog.add_result(f"{number}-{k}", changed)
    catalog.scan()
    return number


@pytest.mark.slow
@pytest.mark.parametrize(
    ("writers", "results"), [(3, 22), pytest.param(16, 20, marks=pytest.mark.nightly)]
)
def test_many_writers_at_once_lose_no_row(writers, results, lab):
    # Each imports all by itself: libraries that have threads can't be forked safely.
    with ProcessPoolExecutor(writers, get_context("spawn")) as pool:
        words = [(str(lab), number, results) for number in range(writers)]
        assert list(pool.map(_write_many, words, timeout=600)) == [*range(writers)]
    catalog = Catalog(str(lab))
    names = catalog.sql("select session_id from analyses where source not like '%.json'").session_id
    assert sorted(names) == sorted(f"{n}-{k}" for n in range(writers) for k in range(results))
    assert catalog.find().path.to_list() == ["day1/gait.mcap", "plain.mcap"]
    count = catalog.sql("select count(*) as n from all_joints where source not like '%.json'").n[0]
    assert count == writers * results * catalog.sql("select max(joints) as n from analyses").n[0]
    catalog.scan()  # puts the files together
    assert len(list((lab / FOLDER / "analyses").iterdir())) <= 64  # one put together, and 63
    assert len(catalog.sql("select * from analyses")) == writers * results + 1


@pytest.mark.slow
def test_rows_that_were_put_together_but_not_removed_count_once(lab, monkeypatch):
    monkeypatch.setattr("undulog.analysis.catalog.files._MOST_FILES", 2)
    catalog = Catalog(str(lab))
    catalog.scan()
    write_session(lab / "new.mcap", count=20)
    before = {path: path.read_bytes() for path in (lab / FOLDER).rglob("rows-*.parquet")}
    catalog.scan()
    assert len(list((lab / FOLDER / "sessions").iterdir())) == 1
    for path, data in before.items():  # as if killed before they were removed
        path.write_bytes(data)
    assert len(Catalog(str(lab)).find()) == 3
    assert Catalog(str(lab)).scan().read == 0


@pytest.mark.slow
def test_wrong_places_and_conditions_are_refused(lab):
    with pytest.raises(InputFileError, match="no such folder"):
        Catalog(str(lab / "none"))
    catalog = Catalog(str(lab))
    assert catalog.find().empty  # before the first scan
    with pytest.raises(UsageError, match="lag_sdd"):
        catalog.find("lag_sdd > 2")
    with pytest.raises(UsageError, match="DuckDB"):
        catalog.sql("selct 1")


@pytest.mark.slow
def test_the_command(lab, command, report_of):
    report = report_of("catalog", lab, "--where", "status = 'analysed'")
    assert [row["path"] for row in report["rows"]] == ["day1/gait.mcap"]
    assert report["scan"]["read"] == 4
    text = command("catalog", lab).out
    assert "plain.mcap" in text
    assert "2 rows; 2 sessions, 0 files read now" in text
    command("catalog", lab, "--joints", "-o", lab / "joints.csv")
    assert len(pd.read_csv(lab / "joints.csv")) > 1
    query = "select robot, count(*) as n from catalog group by robot"
    command("catalog", lab, "--sql", query)
    command("catalog", lab, "--sql", query, "--joints", code=2)
    command("catalog", lab / "none", code=1)


@pytest.mark.nightly
def test_a_bucket_has_the_catalogue_of_a_folder(lab, monkeypatch):
    local = Catalog(str(lab))
    local.scan()
    with s3_bucket(monkeypatch) as client:
        for path in lab.rglob("*"):
            if path.is_file() and FOLDER not in path.parts:
                client.upload_file(os.fspath(path), "robots", path.relative_to(lab).as_posix())
        catalog = Catalog("s3://robots")
        assert catalog.scan().read == 4
        pd.testing.assert_frame_equal(catalog.find(), local.find(), check_dtype=False)
        assert (catalog.scan().read, catalog.analyse()) == (0, {})
        assert (catalog.find().status == "analysed").all()


@pytest.mark.nightly
def test_a_foreign_log_has_the_same_id_on_a_server(tmp_path, monkeypatch):
    messages = [("/a", 10**18 + k, joint_state(k, ["a"], [k * 0.1])) for k in range(30_000)]
    path = write_foreign(tmp_path / "run.mcap", messages)
    local = Catalog(str(tmp_path))
    local.scan()
    with s3_bucket(monkeypatch) as client:
        client.upload_file(os.fspath(path), "robots", "other.mcap")
        catalog = Catalog("s3://robots")
        catalog.scan()
        assert catalog.find().session_id[0] == local.find().session_id[0]
        with Session.open("s3://robots/other.mcap") as session:
            assert session.session_id == local.find().session_id[0]
