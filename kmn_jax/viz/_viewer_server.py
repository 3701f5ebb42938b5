"""The server of a page, on this machine only unless another host is named, and on the port that was asked for."""

from __future__ import annotations

import contextlib
import io
import os
import socket
from typing import Any

from kmn_jax.errors import InputError


def start_server(host: str, port: int) -> Any:
    """Return a running server; it would take another port by itself if this one is in use."""
    if not 0 <= port <= 65535:
        raise InputError(f"port {port} is not one: choose 1 to 65535, or 0 for any that is free")
    try:
        family, *_, address = socket.getaddrinfo(host or None, port, flags=socket.AI_PASSIVE)[0]
        socket.create_server(address[:2], family=family).close()
    except (socket.gaierror, UnicodeError):
        raise InputError(f"host {host!r} is not known: 127.0.0.1 shows the page on this machine only") from None
    except OSError as error:
        why = os.strerror(error.errno or 0)
        raise InputError(f"port {port} of {host} cannot be used ({why}): choose another one, or 0 for any") from None
    try:
        import viser
    except ImportError:
        raise InputError("the page needs a package that is not installed: pip install 'kmn_jax[view]'") from None
    with contextlib.redirect_stdout(io.StringIO()):  # our caller says where the page is
        server = viser.ViserServer(host=host, port=port, verbose=False)
    # The page could ask for a public address by a server elsewhere; scans stay here.
    server.request_share_url = lambda verbose=True: None
    if port not in (0, server.get_port()):
        stop_server(server)
        raise InputError(f"port {port} has just come into use: choose another one, or 0 for any that is free")
    return server


def stop_server(server: Any) -> None:
    """Stop a server and its threads; pages that are open lose their connection."""
    with contextlib.redirect_stdout(io.StringIO()):  # it says so otherwise
        server.stop()
