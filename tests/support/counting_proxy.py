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
    with suppress(OSError):
        sink.shutdown(socket.SHUT_WR)


@contextmanager
def counting_proxy(port):
    """Relay connections to a port of this computer until the end of the block."""
    lock, ends, threads = threading.Lock(), [], []
    listener = socket.create_server(("127.0.0.1", 0))
    counted = Counted(listener.getsockname()[1])

    def count(size):
        with lock:
            counted.sent += size

    def serve():
        with suppress(OSError):
            while True:
                client, _ = listener.accept()
                server = socket.create_connection(("127.0.0.1", port))
                ends.extend((client, server))
                for pair in ((client, server, lambda _: None), (server, client, count)):
                    threads.append(threading.Thread(target=_pump, args=pair))
                    threads[-1].start()

    accepting = threading.Thread(target=serve)
    accepting.start()
    try:
        yield counted
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        accepting.join()
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()
        for end in (*ends, listener):
            end.close()
