"""Which folders are recordings of rosbag2, against YAML itself."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from support.ros_bags import Filler, filling, write_bag
from undulog.capture import Session
from undulog.capture.commands.sessions import sessions_of
from undulog.capture.common.errors import LogError
from undulog.capture.log.file.bag_metadata import is_rosbag2

KEY = "rosbag2_bagfile_information"
RECORDINGS = [
    f"{KEY}:\n  version: 9\n",
    f"{KEY}: {{}}",
    f"\ufeff# a comment\n%YAML 1.2\n---\n\n'{KEY}' :\r\n  version: 9\n",
    f'{{"{KEY}": {{"version": 9}}}}',
    f"  {KEY}:\n    version: 9\n",
    f"first: 1\n{KEY}:\n  version: 9\n",
    f"{KEY}: [",
]
OTHERS = [
    "",
    "a: [",
    "name: a tool\n",
    f"# {KEY}:\nname: 1\n",
    f"name:\n  {KEY}: 1\n",
    f"- {KEY}\n",
    f"{KEY}_2: 1\n",
    f"name: {KEY}\n",
    f"x_{KEY}: 1\n",
    "\0" * 1000,
]


@pytest.mark.parametrize(
    ("text", "expected"),
    [*((text, True) for text in RECORDINGS), *((text, False) for text in OTHERS)],
)
def test_a_folder_is_a_recording_by_the_key(text, expected, tmp_path):
    (tmp_path / "metadata.yaml").write_bytes(text.encode())
    assert is_rosbag2(tmp_path) is expected


VALUES = st.recursive(
    st.text(max_size=20) | st.integers(),
    lambda of: st.dictionaries(st.text(max_size=20) | st.just(KEY), of, max_size=3),
    max_leaves=8,
)


@pytest.mark.slow
@given(tree=st.dictionaries(st.text(max_size=20) | st.just(KEY), VALUES, max_size=4))
def test_written_yaml_is_seen_as_it_is_read(tree, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag")
    with (folder / "metadata.yaml").open("w", encoding="utf-8") as stream:
        YAML(pure=True).dump(tree, stream)
    assert is_rosbag2(folder) is (KEY in tree)


def test_a_huge_file_or_a_pipe_is_not_read(tmp_path):
    with (tmp_path / "metadata.yaml").open("wb") as stream:
        stream.write(b"# " + b" " * (1 << 16))
        stream.truncate(1 << 40)
    assert not is_rosbag2(tmp_path)
    (tmp_path / "metadata.yaml").unlink()
    os.mkfifo(tmp_path / "metadata.yaml")
    assert not is_rosbag2(tmp_path)


def test_logs_beside_a_metadata_yaml_of_another_tool_are_found(tmp_path):
    write_bag(tmp_path / "bag", fill := filling(Filler.state, 0.2))
    (tmp_path / "bag/metadata.yaml").rename(tmp_path / "bag/old.yaml")
    (tmp_path / "bag/metadata.yaml").write_text("name: a tool\n")
    (tmp_path / "bag/bag.mcap").rename(tmp_path / "bag/one.mcap")
    with Session.open(tmp_path / "bag") as session:
        assert len(session.joints("/joint_states").t_ns[0]) == 20
    write_bag(tmp_path / "two.bag", fill)
    (tmp_path / "two.bag").rename(tmp_path / "bag/two.bag")
    assert sessions_of([tmp_path / "bag"]) == [tmp_path / "bag/one.mcap", tmp_path / "bag/two.bag"]
    (tmp_path / "bag/one.mcap").unlink()
    with pytest.raises(LogError, match="no session"):
        Session.open(tmp_path / "bag")
