"""The published JSON Schemas: of the dataclasses, and of what the commands print."""

import copy
import json
from importlib.resources import files

import pytest
import reference_pages
from jsonschema import Draft202012Validator
from result_schemas import RESULTS, result_schema

from support import linear_chain
from support.paths import ROOT, SHARED

GOLDEN = ROOT / "tests/replay/golden/session.mcap"


def published(name):
    file = reference_pages.schema_file(result_schema(name))
    folder = files("undulog.analysis.results").joinpath("schemas")
    return json.loads(folder.joinpath(file).read_text())


def closed(schema):
    """Return a schema that allows no key besides those that it describes."""
    strict = copy.deepcopy(schema)
    for record in (strict, *strict["$defs"].values()):
        record["additionalProperties"] = False
    return strict


def faults(name, result):
    errors = Draft202012Validator(closed(published(name))).iter_errors(result)
    return [f"{error.json_path}: {error.message[:200]}" for error in errors]


@pytest.mark.parametrize("name", RESULTS)
def test_what_ships_is_made_from_the_dataclasses(name):
    assert published(name) == result_schema(name), "run make schemas"
    Draft202012Validator.check_schema(published(name))


@pytest.mark.parametrize("name", RESULTS)
def test_every_reference_has_its_record_and_every_record_is_used(name):
    schema = result_schema(name)
    text = json.dumps(schema)
    used = {part.partition('"')[0] for part in text.split('"#/$defs/')[1:]}
    assert used == set(schema["$defs"])


@pytest.mark.nightly
def test_a_session_of_the_twin(report_of):
    result = report_of("analyse", GOLDEN)
    assert faults("analysis", result) == []
    assert result["joints"][0]["gain_ci95"] is not None
    assert result["energy"] is not None


@pytest.mark.slow
def test_a_result_that_lacks_a_key_or_has_another_type_is_none(report_of):
    result = report_of("analyse", GOLDEN)
    result["joints"][0]["gain"] = "high"
    del result["session"]["path"]
    assert len(faults("analysis", result)) == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "experiment",
    ["swept", *(pytest.param(x, marks=pytest.mark.nightly) for x in ("both_ways", "kicked"))],
)
def test_an_experiment_of_each_kind(experiment, tmp_path, report_of):
    result = report_of("analyse", *getattr(linear_chain, experiment)(tmp_path))
    assert faults("experiment", result) == []


@pytest.mark.nightly
def test_a_comparison(tmp_path, report_of):
    before, _, after, *_ = linear_chain.both_ways(tmp_path)
    assert faults("comparison", report_of("compare", before, after)) == []
    assert faults("comparison", report_of("compare", GOLDEN, GOLDEN)) == []


@pytest.mark.nightly
def test_a_prediction(tmp_path, report_of):
    runs = linear_chain.kicked(tmp_path)
    assert (
        faults("prediction", report_of("predict", *runs, "--eps", "0.3", "--kick", "j1=0.1")) == []
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "data",
    [
        "so101/multisine",
        *(
            pytest.param(x, marks=pytest.mark.nightly)
            for x in ("so101/coupled_joints", "go2/traj_0.pt")
        ),
    ],
)
def test_a_real_recording(data, tmp_path, command, report_of):
    if not SHARED.is_dir():
        pytest.skip(f"the real recordings {SHARED.name} are not beside this checkout")
    command("import", SHARED / data, "-o", tmp_path / "real.mcap")
    assert faults("analysis", report_of("analyse", tmp_path / "real.mcap")) == []
