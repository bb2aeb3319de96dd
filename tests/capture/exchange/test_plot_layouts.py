"""Layouts: read by json and ElementTree; each curve leads to the samples of its joint."""

import json
import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from support.written_sessions import joint_state, write_foreign
from support.written_topics import write_topics
from undulog.capture.common.errors import DataError, MissingChannelError
from undulog.capture.exchange.formats.foxglove import export_foxglove_layout, foxglove_layout
from undulog.capture.exchange.formats.plotjuggler import export_plotjuggler_layout
from undulog.capture.exchange.joint_plots import JointPlot, TopicCurve

T0 = 1_700_000_000 * 10**9
NAMES = [f"j{k}" for k in range(8)]
FOXGLOVE = re.compile(r'"?(?P<topic>[^".]+)"?\.position\[(?P<place>\d+)\]')


@pytest.fixture
def run(tmp_path):
    """Commands and states whose messages have the joints in different orders."""
    commands, states = np.random.default_rng(4).normal(size=(2, 20, 8))
    topics = {"/joint_commands": (NAMES, "rad", commands)}
    topics["/joint_states"] = (NAMES[::-1], "rad", states)
    return write_topics(tmp_path / "run.mcap", T0 + np.arange(20) * 10**8, topics, epoch_ns=T0)


def panels_of(layout):
    """Return the panels that a tree of a layout shows, in order."""
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column")
    assert 0 < layout["splitPercentage"] < 100
    return [*panels_of(layout["first"]), *panels_of(layout["second"])]


def test_each_path_of_foxglove_leads_to_its_joint(run, tmp_path, command):
    line = ("log", "export", run, "--to", "foxglove-layout", "-o", tmp_path / "x.json")
    assert "plots of 8 joints" in command(*line).out
    layout = json.loads((tmp_path / "x.json").read_text())
    tabs = layout["configById"][layout["layout"]]["tabs"]
    shown = [name for tab in tabs for name in panels_of(tab["layout"])]
    assert [tab["title"] for tab in tabs] == ["j0 to j5", "j6 to j7"]
    assert sorted([*shown, layout["layout"]]) == sorted(layout["configById"])
    with run.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        first = {
            decoded.channel.topic: decoded.decoded_message
            for decoded in reader.iter_decoded_messages()
        }
    for joint, name in zip(NAMES, shown, strict=True):
        panel = layout["configById"][name]
        assert panel["title"] == f"{joint} [rad]"
        matches = [FOXGLOVE.fullmatch(path["value"]) for path in panel["paths"]]
        assert [match["topic"] for match in matches] == ["/joint_commands", "/joint_states"]
        for match in matches:
            assert first[match["topic"]].name[int(match["place"])] == joint


def test_plotjuggler_has_a_plot_for_each_joint(run, tmp_path, opened):
    report = export_plotjuggler_layout(run, tmp_path / "x.xml")
    assert report.facts["joints"] == NAMES
    root = ET.parse(tmp_path / "x.xml").getroot()
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))
    plots = [area.find("plot") for area in root.iter("DockArea")]
    names = [[curve.get("name") for curve in plot.iter("curve")] for plot in plots]
    topics = ("/joint_commands", "/joint_states")
    assert names == [[f"{topic}/{joint}/position" for topic in topics] for joint in NAMES]
    session = opened(run)
    for joint, plot in zip(NAMES, plots, strict=True):
        edges = {name: float(edge) for name, edge in plot.find("range").items()}
        values = np.hstack([session.joints(topic).signal(joint).values for topic in topics])
        assert edges["bottom"] < values.min() < values.max() < edges["top"]
        assert (edges["left"], edges["right"]) == (0.0, 1.9)


def test_a_joint_whose_place_changes_is_not_plotted_by_place(tmp_path):
    names = [["a", "b", "c"], ["b", "a", "c"]]
    messages = [
        ("/joint_states", T0 + k, joint_state(T0 + k, names[k % 2], [0.1, 0.2, 0.3]))
        for k in range(6)
    ]
    write_foreign(tmp_path / "run.mcap", messages)
    report = export_foxglove_layout(tmp_path / "run.mcap", tmp_path / "x.json")
    assert report.facts["joints"] == ["c"]
    assert report.warnings[-1].endswith("these have no curve: a, b")
    report = export_plotjuggler_layout(tmp_path / "run.mcap", tmp_path / "x.xml")
    assert report.facts["joints"] == ["a", "b", "c"]
    orders = [["a", "b", "c"], ["b", "c", "a"]]
    messages = [
        ("/joint_states", T0 + k, joint_state(T0 + k, order, [0.1, 0.2, 0.3]))
        for k, order in enumerate(orders)
    ]
    write_foreign(tmp_path / "run.mcap", messages)
    with pytest.raises(DataError, match="whose places change"):
        export_foxglove_layout(tmp_path / "run.mcap", tmp_path / "y.json")


def test_odd_names_and_topics(tmp_path):
    names = ["<b>&\"'", "\x1b[2J", "é"]
    messages = [("/a b/x", T0 + k, joint_state(T0 + k, names, [k, np.nan, 0.0])) for k in (0, 1)]
    write_foreign(tmp_path / "run.mcap", messages)
    report = export_plotjuggler_layout(tmp_path / "run.mcap", tmp_path / "x.xml", topics=["/a b/x"])
    assert report.facts["joints"] == [names[0], names[2]]
    assert report.warnings[-1].startswith("names that XML can't hold, left out")
    curves = [curve.get("name") for curve in ET.parse(tmp_path / "x.xml").getroot().iter("curve")]
    assert curves == [f"/a b/x/{name}/position" for name in report.facts["joints"]]
    export_foxglove_layout(tmp_path / "run.mcap", tmp_path / "x.json", topics=["/a b/x"])
    layout = json.loads((tmp_path / "x.json").read_text())
    assert layout["configById"]["Plot!joint1"]["paths"][0]["value"] == '"/a b/x".position[0]'
    with pytest.raises(MissingChannelError, match="no /joint_commands and no /joint_states"):
        export_foxglove_layout(tmp_path / "run.mcap", tmp_path / "y.json")


@given(st.integers(1, 40))
def test_panels_share_the_height_of_a_tab(count):
    curve = TopicCurve("/joint_states", 0, "#000000", 0.0, 1.0)
    layout = foxglove_layout([JointPlot(f"j{k}", (curve,)) for k in range(count)])
    for tab in layout["configById"]["Tab!joints"]["tabs"]:
        height, shares, tree = 100.0, [], tab["layout"]
        while not isinstance(tree, str):
            shares.append(height * tree["splitPercentage"] / 100)
            height -= shares[-1]
            tree = tree["second"]
        np.testing.assert_allclose([*shares, height], 100 / (len(shares) + 1))


def test_the_suffix_and_an_existing_file_are_checked(run, tmp_path, command):
    line = ("log", "export", run, "--to", "plotjuggler-layout", "-o")
    assert "end the name of this layout in .xml" in command(*line, tmp_path / "x.json", code=2).err
    command(*line, tmp_path / "x.xml")
    assert "exists already" in command(*line, tmp_path / "x.xml", code=2).err
    command(*line, tmp_path / "x.xml", "--force")
