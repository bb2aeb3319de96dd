"""The live view's samples of joints that are polled in turn, however a recorder orders them."""

import numpy as np
import pytest
from mcap.reader import make_reader

from support.live_stage import EPOCH_NS
from support.written_topics import write_topics
from undulog.capture.recorder.live_wire import LiveMessage
from undulog.replay.live.decode import LiveLog

ROUNDS = 700
NAMES = ("a", "b", "c")
OFFSET = np.random.default_rng(2).uniform(0.0, 9e-4, (ROUNDS, 3))


@pytest.fixture
def log_and_messages(tmp_path):
    """A log that knows the channels, and the messages of each topic."""
    t_ns = EPOCH_NS + np.arange(ROUNDS) * 1_000_000
    topics = {
        "/joint_sample_offset": (NAMES, "s", OFFSET),
        "/joint_states": (NAMES, "rad", np.random.default_rng(1).normal(size=(ROUNDS, 3))),
    }
    path = write_topics(tmp_path / "turns.mcap", t_ns, topics)
    log, messages = LiveLog(), {topic: [] for topic in topics}
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        for record in (*summary.schemas.values(), *summary.channels.values()):
            log.define(record)
        for _, channel, m in reader.iter_messages():
            if channel.topic in messages:
                fields = (m.channel_id, m.sequence, m.log_time, m.publish_time, 0, m.data)
                messages[channel.topic].append(LiveMessage(*fields))
    return log, messages


@pytest.mark.parametrize("size", [1, 7, ROUNDS])
def test_offsets_of_many_rounds_come_ahead_of_the_samples(log_and_messages, size):
    """A recorder writes what it decoded at once topic by topic."""
    log, messages = log_and_messages
    times = {name: [] for name in NAMES}
    for start in range(0, ROUNDS, size):
        part = slice(start, start + size)
        log.decode(messages["/joint_sample_offset"][part])
        batch = log.decode(messages["/joint_states"][part])
        for track in batch.columns["/joint_states", "position"]:
            times[track.name] += track.t_ns.tolist()
    for k, name in enumerate(NAMES):
        expected = (
            EPOCH_NS + np.arange(ROUNDS) * 1_000_000 + np.round(OFFSET[:, k] * 1e9).astype(int)
        )
        assert np.abs(np.array(times[name]) - expected).max() <= 1
