"""A TCP relay on loopback that counts the bytes that a server sends."""

import socket
import threading
from contextlib import contextmanager, suppress
from dataclasses import dataclass


@dataclass
class Counted:
    """Address of the relay, and what came from the server, heads of answers included."""

    port: int
    sent: int = 0


def _pump(source, sink, count):
    with suppress(OSError):
        while data := source.recv(1 << 16):
            count(len(data))
            sink.sendall(data)
    for end, how in ((source, socket.SHUT_RD), (sink, socket.SHUT_WR)):
        with suppress(OSError):
            end.shutdown(how)


@contextmanager
def counting_proxy(port):
    """Relay connections to a port of this computer until the end of the block."""
    lock = threading.Lock()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        counted = Counted(listener.getsockname()[1])

        def count(size):
            with lock:
                counted.sent += size

        def serve():
            while True:
                try:
                    client, _ = listener.accept()
                except OSError:
                    return
                server = socket.create_connection(("127.0.0.1", port))
                pairs = ((client, server, lambda _: None), (server, client, count))
                for pair in pairs:
                    threading.Thread(target=_pump, args=pair, daemon=True).start()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield counted
        listener.shutdown(socket.SHUT_RDWR)
    thread.join()
