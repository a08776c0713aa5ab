"""Sessions: addresses that work once, and the keys that pages hold afterwards.

Each request carries the key in its own header, not in a cookie: browsers send cookies to every port of a host.
"""

from __future__ import annotations

import hashlib
import secrets
from threading import Lock


class Sessions:
    """Tokens that can be exchanged once for a key. Both are lost when the server ends.

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

    def knows(self, key: str) -> bool:
        """Return whether a page holds this key."""
        return _digest(key) in self._keys


def _digest(secret: str) -> bytes:
    """Hash a secret, so that the time of a comparison reveals nothing about it."""
    return hashlib.sha256(secret.encode("utf-8", "replace")).digest()
