"""What servers on this machine have in common: where they listen, and which pages of a browser they answer.

A page of another site can make a browser send requests here, and by a name that it lets point to this machine it can
even read the answers. The first always name their Origin; the second name a Host that is not ours.
"""

from __future__ import annotations

import ipaddress
import os
import socket

from kmn_jax.errors import InputError, require


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens; port 0 takes any that is free.

    Raises InputError if the port is in use, or the host is not this machine's.
    """
    require(0 <= port <= 65535, f"port {port} is not one: choose 1 to 65535, or 0 for any that is free")
    try:
        family, *_, place = socket.getaddrinfo(host or None, port, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(place[:2], family=family, backlog=1024)
    except (socket.gaierror, UnicodeError):
        raise InputError(
            f"host {host!r} is not known: 127.0.0.1 answers this machine only, 0.0.0.0 all that reach it"
        ) from None
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise InputError(f"port {port} of {host} cannot be used ({reason}): choose another one, or 0 for any") from None


def address(host: str, port: int) -> str:
    """Return the address of a server as a browser on this machine is told it."""
    if host in ("", "0.0.0.0", "::"):
        host = "localhost"
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def is_allowed_host(host: str, names: tuple[str, ...] = ()) -> bool:
    """Tell whether a Host header names this machine: by an address, as localhost, by its name, or by one of `names`.

    No name of another site can point to an address that is written in digits.
    """
    name, port = host, ""
    if host.startswith("["):
        name, _, port = host[1:].partition("]")
        port = port.removeprefix(":")
    elif ":" in host:
        name, _, port = host.partition(":")
    if port and not (port.isascii() and port.isdecimal()):
        return False
    if name and name.lower() in (allowed.lower() for allowed in ("localhost", socket.gethostname(), *names)):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_same_origin(origin: str | None, host: str) -> bool:
    """Tell whether a request comes from a page of this server, or from no page at all."""
    return origin is None or origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")
