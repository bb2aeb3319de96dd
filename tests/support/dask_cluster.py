"""A Dask scheduler and two worker processes on loopback."""

import socket
import sys
from contextlib import contextmanager

from support.processes import listening, process, wait_for


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@contextmanager
def scheduler(port):
    words = (sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1")
    with process(*words, "--port", port, "--no-dashboard", "--no-jupyter") as running:
        wait_for(lambda: listening(port), "the scheduler", alive=[running])
        yield running


def workers(port, folder, count=2):
    """Worker processes of one thread, restarted if they are killed."""
    words = (sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://127.0.0.1:{port}")
    options = ("--nthreads", "1", "--nworkers", count, "--no-dashboard")
    place = ("--host", "127.0.0.1", "--local-directory", folder)
    return process(*words, *options, *place)
