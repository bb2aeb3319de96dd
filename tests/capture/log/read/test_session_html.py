"""A session in a notebook: its topics as a table, and nothing of the file as markup."""

import xml.etree.ElementTree as ET

import numpy as np

from support.written_topics import write_topics
from undulog.capture import Session, SessionWriter


def shown(path):
    with Session.open(path) as session:
        html = session._repr_html_()
    return html, ET.fromstring(f"<div>{html}</div>")


def test_topics_are_rows_with_counts_rates_and_units(tmp_path):
    topics = {"/joint_states": (["a", "b"], "rad", np.zeros((11, 2)))}
    path = write_topics(tmp_path / "run.mcap", np.arange(11) * 10**8, topics, epoch_ns=0)
    html, tree = shown(path)
    rows = [[cell.text for cell in row] for row in tree.iter("tr")]
    assert ["/joint_states", "sensor_msgs/msg/JointState", "11", "11", "rad"] in rows
    assert "run.mcap: no robot description, 1.00 s from 1970-01-01 00:00:00 UTC" in html


def test_what_a_file_says_is_text(tmp_path):
    path = tmp_path / "<b>run.mcap"
    with SessionWriter(path, session_id="a", epoch_ns=0) as writer:
        for k in range(60):
            writer.joint_state(f"/<script>{k:02d}", ["a"], unit="</td>\x1b[2J")
    html, tree = shown(path)
    assert "<script" not in html
    assert "\x1b" not in html
    assert "no messages" in html
    assert len(list(tree.iter("tr"))) == 41
    assert "20 more topics" in html
