"""A listener that only this computer can reach."""

from __future__ import annotations

import ipaddress
import socket

from undulog.capture.common.errors import UsageError


def listen_on_loopback(host: str, port: int) -> socket.socket:
    """Listen on loopback.

    Args:
        host: A name or address of the loopback interface.
        port: TCP port; 0 for any that is free.

    Returns:
        The listener, non-blocking.

    Raises:
        UsageError: If the host is not loopback, or nobody can listen there.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, OverflowError) as error:
        raise UsageError(f"{host}:{port} is no address to serve at: {error}") from error
    family, _, _, _, address = found[0]
    if not ipaddress.ip_address(address[0]).is_loopback:
        raise UsageError(
            f"{host} is not this computer's loopback; a virtual robot is served there only, e.g. "
            f"at 127.0.0.1:{port}"
        )
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise UsageError(f"can't serve at {host}:{port}: {error.strerror}") from error
    return listener
