"""Messages of raw frames, against the general encoder and a foreign decoder."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from undulog.capture.log.messages import frames as fr
from undulog.capture.log.messages.cdr import encode
from undulog.capture.log.messages.definitions import message_type

RECORDS = st.integers(0, 300).flatmap(
    lambda count: st.binary(min_size=32 * count, max_size=32 * count)
)


@pytest.mark.slow
@given(RECORDS)
def test_the_bytes_are_those_of_the_general_encoder(data):
    count, size = len(data) // 32, len(data)
    dimensions = [
        {"label": "frame", "size": count, "stride": size},
        {"label": fr.FRAME_LAYOUT, "size": 32, "stride": 32},
    ]
    values = {"layout": {"dim": dimensions}, "data": np.frombuffer(data, np.uint8)}
    message = fr.frame_message(fr.frames_from_bytes(data))
    assert message == encode(message_type(fr.FRAMES_TYPE), values)
    at, records = fr.records_at(message)
    assert (message[at:], records) == (data, count)
    decoded = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(message, fr.FRAMES_TYPE)
    assert decoded.data.tobytes() == data
    assert [d.size for d in decoded.layout.dim] == [count, 32]


@given(RECORDS, st.integers(0, 400), st.integers(0, 7))
def test_a_damaged_head_is_never_taken_for_a_whole_one(data, place, bit):
    message = bytearray(fr.frame_message(fr.frames_from_bytes(data)))
    place %= len(message) - len(data)
    message[place] ^= 1 << bit
    assert fr.records_at(bytes(message)) is None


@pytest.mark.parametrize("cut", [1, 31, 32, 33])
def test_a_message_cut_short_is_none(cut):
    assert fr.records_at(fr.frame_message(np.zeros(3, fr.FRAME_DTYPE))[:-cut]) is None
