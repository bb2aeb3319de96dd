"""Logs with thousands of topics of joints: each chunk is decompressed once, or a sentence."""

from campaign.hostile import many_channels
from undulog.capture import Session
from undulog.capture.log.mcap.payloads import McapPayloads
from undulog.capture.log.read.joint_topics import JointTopicFinder, joint_names


def test_the_joints_of_many_topics_are_found_in_one_pass(tmp_path, monkeypatch):
    path = tmp_path / "x.mcap"
    path.write_bytes(many_channels(200, joints=True))
    read, original = [], McapPayloads.inflate_into
    with Session.open(path) as session:
        topics = session._log.topics
        finder = JointTopicFinder(path, topics)

        def counted(payloads, block, room):
            read.append(block)
            original(payloads, block, room)

        monkeypatch.setattr(McapPayloads, "inflate_into", counted)
        names = joint_names(topics)
        finder.find()
    assert names == {f"/t{k}": ("a",) for k in range(1, 201)}
    assert len(read) <= 4


def test_more_topics_of_joints_than_any_robot_has_are_refused_and_can_be_cut(tmp_path, command):
    path = tmp_path / "x.mcap"
    path.write_bytes(many_channels(2100, joints=True))
    shown = command("analyse", path, code=1).err
    assert "2100 topics of joints, over 2000" in shown
    assert "log cut --topics" in shown
    command("log", "info", path)
    command("log", "cut", path, "--topics", "/t1", "/t2", "-o", tmp_path / "cut.mcap")
    with Session.open(tmp_path / "cut.mcap") as session:
        assert set(joint_names(session._log.topics)) == {"/t1", "/t2"}
