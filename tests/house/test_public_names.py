"""The public names of the four packages: what a release may not lose without a word."""

import ast
import importlib
import re

import pytest

from support.paths import ROOT

PUBLIC = {
    "analysis": (
        "Analysis Catalog Choices Comparison Estimate Experiment Fleet Index JointResult "
        "LinearCoupling LocalCoupling Margins Options Picture Reversal analyse_experiment "
        "analyse_fleet analyse_session compare_sessions load render"
    ),
    "capture": (
        "Channel JointSignals Robot Session SessionView SessionWriter Signal load_robot robot_names"
    ),
    "replay": ("Content Recording write_recording"),
    "sim": (
        "AccelerometerModel BatchRun Box CompassModel Cylinder FrictionLaw Gait GaitTick Ground "
        "InfraredModel Noise ObstacleMaterial PlaneGait RandomField Readings Scenario "
        "SensorModels Serpentine SerpentineGait ServoPolling SonarModel Target Twin Wall Wave "
        "World load_scenario parse_scenario record run_batch scenario_names"
    ),
}


@pytest.mark.parametrize("package", sorted(PUBLIC))
def test_public_names_are_these_and_can_be_imported(package):
    module = importlib.import_module(f"undulog.{package}")
    assert sorted(module.__all__) == sorted(PUBLIC[package].split())
    assert all(hasattr(module, name) for name in module.__all__)


@pytest.mark.nightly
def test_examples_in_docstrings_import_what_exists():
    lines = [
        (path, line.strip())
        for package in PUBLIC
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        for line in (ast.get_docstring(node) or "").splitlines()
        if re.match(r"\s+from \S+ import \w", line)
    ]
    assert len(lines) > 10
    for path, line in lines:
        assert not line.startswith("from ."), path
        exec(line, {})
