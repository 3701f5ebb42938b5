"""Parts that a server knows: those with names, until they are deleted, and the last ones that came with a scan."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict

from kmn_jax.errors import InputError
from kmn_jax.objects import Part

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def check_name(name: str) -> str:
    """Return a name that a part may have, or raise InputError."""
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{name[:80]!r} cannot name a part: use up to 64 letters, digits, dots, dashes and underscores, beginning"
            " with a letter or digit"
        )
    return name


class PartStore:
    """Named parts, at most so many, and as many nameless ones, of which the least used are forgotten.

    It may be used by several threads.
    """

    def __init__(self, most: int, named: dict[str, Part]) -> None:
        """Begin with named parts. Raises InputError if they are too many."""
        self._most, self._lock = most, threading.Lock()
        self._named: dict[str, Part] = {}
        self._sent: OrderedDict[str, Part] = OrderedDict()
        for name, part in named.items():
            self.add(name, part)

    def add(self, name: str, part: Part) -> bool:
        """Keep a part under a name; tell whether it is a new one. Raises InputError if there are too many."""
        with self._lock:
            is_new = check_name(name) not in self._named
            if is_new and len(self._named) >= self._most:
                raise InputError(f"there are {self._most} parts already: delete one first")
            self._named[name] = part
            return is_new

    def remember(self, digest: str, part: Part) -> None:
        """Keep a part that came with a scan, by the digest of its file."""
        with self._lock:
            self._sent[digest] = part
            self._sent.move_to_end(digest)
            while len(self._sent) > self._most:
                self._sent.popitem(last=False)

    def find(self, name: str) -> Part | None:
        """Return the part of a name or digest."""
        with self._lock:
            if name in self._sent:
                self._sent.move_to_end(name)
                return self._sent[name]
            return self._named.get(name)

    def remove(self, name: str) -> bool:
        """Forget a named part; tell whether there was one."""
        with self._lock:
            return self._named.pop(name, None) is not None

    def named(self) -> dict[str, Part]:
        """Return all that have names, in the order of these."""
        with self._lock:
            return dict(sorted(self._named.items()))
