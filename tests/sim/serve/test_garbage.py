"""What clients of a served bus may send: cut anywhere, and anything at all."""

import itertools
import socket
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undulog.capture.log.messages.frames import empty_frames
from undulog.sim.serve.socketcand_protocol import ClientText
from undulog.sim.serve.socketcand_server import SocketcandServer

WORDS = (
    b"< open can0 >",
    b"< rawmode >",
    b"< bcmmode >",
    b"< echo >",
    b"< undulog >",
    b"< send 123 2 11 F1 >",
    b"< send 1AAAAAAA 0 >",
    b"< sendrtr 123 4 >",
    b"< send 123 8 1 >",
    b"<>",
    b"<<>>",
    b"> <",
)
anything = st.lists(st.one_of(st.sampled_from(WORDS), st.binary(max_size=60)), max_size=30)


@given(pieces=anything, seed=st.integers(0, 2**32 - 1))
def test_any_way_of_cutting_what_a_client_sends_gives_the_same(pieces, seed):
    stream = b"".join(pieces)[:300]  # short enough for no end to be missed
    whole = ClientText().feed(stream)
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.integers(0, len(stream) + 1, rng.integers(0, 20))).tolist()
    text = ClientText()
    parsed = []
    for start, stop in itertools.pairwise([0, *cuts, len(stream)]):
        parsed += text.feed(stream[start:stop])
    assert parsed == whole


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(pieces=anything)
def test_nothing_that_a_client_sends_harms_the_others(pieces):
    notes = []
    server = SocketcandServer("127.0.0.1", 0, "can0", lambda *words: notes.append(words))
    frames = empty_frames(3)
    try:
        with (
            socket.create_connection(server.address) as mad,
            socket.create_connection(server.address) as good,
        ):
            mad.setblocking(False)
            good.settimeout(0.001)
            received = b""
            good.sendall(b"< open can0 >< rawmode >")
            for piece in [*pieces, b"", b""]:
                with suppress(OSError):  # it may have been let go
                    mad.sendall(piece)
                server.pump(0.001)
                server.broadcast(frames)
                while server.take() is not None:
                    pass
            good.sendall(b"< echo >")
            for _ in range(1000):
                server.pump(0.001)
                try:
                    received += good.recv(65536)
                except TimeoutError:
                    continue
                if received.endswith(b"< echo >"):
                    break
            assert received.startswith(b"< hi >< ok >< ok >")
            assert received.endswith(b"< echo >")
    finally:
        server.close()
