"""Sessions: addresses that work once, the keys that pages hold afterwards, and the token of programs.

Each request carries its key in a header, not in a cookie: browsers send cookies to every port of a host.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
from contextlib import suppress
from pathlib import Path
from threading import Lock

from stmc.io.untrusted import UnreadableError, read_text

TOKEN_FILE = "api_token"
"""Name of the file with the token of programs, in the studio's folder."""

_TOKEN = re.compile(r"[A-Za-z0-9_-]{43}\n?")


class Sessions:
    """Tokens that can be exchanged once for a key. Both are lost when the server ends; the keys of programs are files.

    Examples:
        >>> sessions = stmc.viewing.studio.Sessions()
        >>> token = sessions.invite()
        >>> sessions.knows(sessions.admit(token)), sessions.admit(token)
        (True, None)
    """

    def __init__(self) -> None:
        self._tokens: set[bytes] = set()
        self._keys: set[bytes] = set()
        self._lock = Lock()

    def invite(self) -> str:
        """Make a token for one page."""
        token = secrets.token_urlsafe(18)
        self._tokens.add(_digest(token))
        return token

    def admit(self, token: str) -> str | None:
        """Exchange a token for a key; return None for a used or unknown token."""
        with self._lock:
            if _digest(token) not in self._tokens:
                return None
            self._tokens.remove(_digest(token))
            key = secrets.token_urlsafe(24)
            self._keys.add(_digest(key))
            return key

    def allow(self, key: str) -> None:
        """Accept a key that a program holds."""
        self._keys.add(_digest(key))

    def knows(self, key: str) -> bool:
        """Return whether a page or a program holds this key."""
        return _digest(key) in self._keys


def program_token(folder: Path) -> str:
    """Return the token of programs, which a file in `folder` keeps. Without such a file, make a new token.

    Only the owner can read the file. One that others can read, that belongs to others, or that is no token is replaced.
    """
    path = folder / TOKEN_FILE
    with suppress(FileNotFoundError, UnreadableError):
        if _is_private(path) and _TOKEN.fullmatch(token := read_text(path, 100)):
            return token.strip()
    path.unlink(missing_ok=True)
    token = secrets.token_urlsafe(32)
    with open(path, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
        file.write(f"{token}\n")
    return token


def _is_private(path: Path) -> bool:
    """Return whether a path is a regular file that only this user can read; on Windows, whether it is regular."""
    status = path.lstat()
    if os.name == "nt":
        return stat.S_ISREG(status.st_mode)
    return stat.S_ISREG(status.st_mode) and not status.st_mode & 0o077 and status.st_uid == os.getuid()


def _digest(secret: str) -> bytes:
    """Hash a secret, so that the time of a comparison reveals nothing about it."""
    return hashlib.sha256(secret.encode("utf-8", "replace")).digest()
