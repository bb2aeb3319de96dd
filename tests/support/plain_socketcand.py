"""A server of socketcand that answers what a test says, in pieces as it says."""

import socket
import threading
from contextlib import contextmanager
from pathlib import Path

from support.processes import wait_for


def unread(sock):
    """Return what the other end of a local connection has received and not read [byte]."""
    ends = sock.getpeername()[1], sock.getsockname()[1]
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, *names, _, queues = line.split()[:5]
        if tuple(int(name.split(":")[1], 16) for name in names) == ends:
            return int(queues.split(":")[1], 16)
    raise ConnectionResetError


@contextmanager
def plain_server(answers, stream=()):
    """A server of one client: answers each message by its first word, then sends a stream."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        taken = []

        def serve():
            client, _ = listener.accept()
            with client:
                client.sendall(b"< hi >")
                while chunk := client.recv(65536):
                    for message in chunk.decode().split(">")[:-1]:
                        word = message.strip(" <").split()[0]
                        taken.append(word)
                        client.sendall(answers.get(word, b""))
                    # python-can takes what comes with "ok" for a refusal
                    for piece in stream if taken[-1] == "rawmode" else ():
                        wait_for(lambda: unread(client) == 0, "the reader")
                        client.sendall(piece)

        thread = threading.Thread(target=serve)
        thread.start()
        port = listener.getsockname()[1]
        yield f"can:socketcand:can0?host=127.0.0.1&port={port}", taken
        thread.join()


SOCKETCAND = {
    "open": b"< ok >",
    "rawmode": b"< ok >",
    "undulog": b"< error unknown command >",  # as socketcand 0.6 answers
}
