"""Embeddings on disk: each text is encoded once. One file per encoder; `text_encoder` defines the interface."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from jaxtyping import Float, Int
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from stmc.diffusion.tensors import pad
from stmc.text.text_encoder import TextEncoder, check

logger = logging.getLogger(__name__)

AT_ONCE = 512
"""Number of texts encoded between two writes to disk: the most that a kill can lose."""

_DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""Exceptions of SQLite for a damaged file; its own message may consist of damaged bytes."""

_LOCATION_ERRORS = (
    sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_PERM,
)  # fmt: skip
"""Codes of a full disk, a missing permission, or too long a wait: the file itself may be intact."""

_TIMEOUT = 300.0
"""Seconds for which a process waits for another process to finish writing."""


class Cached:
    """Wrap an encoder so that each text is encoded once and its words are stored in `folder`, in one file per encoder.

    The file is an SQLite database, safe with several processes on one folder and with kills. Words that are damaged or
    belong to another text are encoded again; a file that is not a database is rebuilt. The weights are loaded only if a
    text is missing.
    """

    def __init__(self, encoder: TextEncoder, folder: str | Path) -> None:
        self.encoder, self.folder = encoder, Path(folder).expanduser()

    @property
    def name(self) -> str:
        """The name of the wrapped encoder."""
        return self.encoder.name

    @property
    def width(self) -> int:
        """The width of the wrapped encoder."""
        return self.encoder.width

    @property
    def file(self) -> Path:
        """The file with the words of the encoder."""
        digest = hashlib.sha256(self.name.encode()).hexdigest()[:8]  # names may differ in case only
        return self.folder / f"{re.sub(r'[^A-Za-z0-9-]+', '_', self.name)[:60]}_{digest}.sqlite"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """Encode texts, always to the CPU; see `TextEncoder`."""
        check(texts)
        words = self._read(texts)
        missing = [text for text in dict.fromkeys(texts) if text not in words]
        if missing:
            logger.info("encoding %d texts with %s; %d are in the cache", len(missing), self.name, len(words))
        for start in range(0, len(missing), AT_ONCE):
            chunk = missing[start : start + AT_ONCE]
            rows, lengths = self.encoder.encode(chunk)
            fresh = {text: row[:length].cpu() for text, row, length in zip(chunk, rows, lengths, strict=True)}
            self._write(fresh)
            words |= fresh
            logger.info("encoded %d of %d texts", start + len(chunk), len(missing))
        return pad([words[text] for text in texts])

    def missing(self, texts: Sequence[str]) -> list[str]:
        """Return the texts, without duplicates, whose words are not stored yet."""
        words = self._read(texts)
        return [text for text in dict.fromkeys(texts) if text not in words]

    def _read(self, texts: Sequence[str]) -> dict[str, Float[Tensor, "_ width"]]:
        """Read the words of the texts that are stored and intact."""
        if not self.file.exists():
            return {}
        words = {}
        try:
            with self._open("rw") as database:
                for text in dict.fromkeys(texts):
                    row = database.execute("SELECT words, sha256 FROM texts WHERE text = ?", (_key(text),)).fetchone()
                    if row and row[1] == self._digest(text, row[0]):
                        words[text] = load(row[0])["words"]
        except (*_DAMAGED, SafetensorError, TypeError) as error:
            logger.warning("%s cannot be read (%s); missing texts are encoded again", self.file, error)
        return {text: row for text, row in words.items() if row.shape[-1] == self.width}

    def _write(self, words: dict[str, Float[Tensor, "_ width"]]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self._insert(words)
            damaged = not self._read(list(words)[:1])
        except _DAMAGED as error:
            if self._is_location_error(error):
                raise OSError(f"{self.file} cannot be written: {error}") from error
            damaged = True
        if damaged:
            logger.warning("%s is damaged and is rebuilt", self.file)
            for path in (self.file, self.file.with_name(f"{self.file.name}-journal")):
                path.unlink(missing_ok=True)
            self._insert(words)

    def _is_location_error(self, error: Exception) -> bool:
        """Return whether the location refuses the write, not the file; a damaged file may claim to be read-only."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        return code in _LOCATION_ERRORS or (code == sqlite3.SQLITE_READONLY and not os.access(self.file, os.W_OK))

    def _insert(self, words: dict[str, Float[Tensor, "_ width"]]) -> None:
        rows = [(_key(text), save({"words": row.contiguous()})) for text, row in words.items()]
        digests = [self._digest(text, content) for text, (_, content) in zip(words, rows, strict=True)]
        with self._open("rwc") as database:
            database.execute("CREATE TABLE IF NOT EXISTS texts (text BLOB PRIMARY KEY, words BLOB, sha256 BLOB)")
            database.executemany(
                "INSERT OR REPLACE INTO texts VALUES (?, ?, ?)",
                [(*row, digest) for row, digest in zip(rows, digests, strict=True)],
            )

    @contextmanager
    def _open(self, mode: str) -> Iterator[sqlite3.Connection]:
        """Open the database for one transaction. A reader needs write access too: it rolls back what a kill left
        behind.
        """
        uri = f"{self.file.absolute().as_uri()}?mode={mode}"
        database = sqlite3.connect(uri, timeout=_TIMEOUT, uri=True)
        try:
            with database:
                yield database
        finally:
            database.close()

    def _digest(self, text: str, content: bytes) -> bytes:
        # SQLite detects most damage, but not a flipped bit within the numbers.
        return hashlib.sha256(f"{self.name}\0{len(text)}\0{text}".encode(errors="surrogatepass") + content).digest()


def _key(text: str) -> bytes:
    return text.encode(errors="surrogatepass")
