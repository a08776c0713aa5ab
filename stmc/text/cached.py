"""Embeddings on disk: each text is encoded once. Knows one file per encoder; see `protocol` for what an encoder is."""

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
"""Texts encoded between two visits to the disk: what a kill can lose."""

_DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""What SQLite raises for a damaged file; its own message may be of damaged bytes."""

_OF_THE_PLACE = (
    sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_PERM,
)  # fmt: skip
"""Codes of a full disk, no permission, or too long a wait: the file itself may be whole."""

_PATIENCE = 300.0
"""Seconds for which a process waits until another has written."""


class Cached:
    """Another encoder, with every text's words kept in `folder`, in one file per encoder, so that each is encoded once.

    Safe with several processes on one folder, and with kills: the file is an SQLite database. Words that are damaged,
    or those of another text, are made anew, and so is a file that is no database. The weights are loaded only if a text
    is missing.
    """

    def __init__(self, encoder: TextEncoder, folder: str | Path) -> None:
        self.encoder, self.folder = encoder, Path(folder).expanduser()

    @property
    def name(self) -> str:
        """The encoder's."""
        return self.encoder.name

    @property
    def width(self) -> int:
        """The encoder's."""
        return self.encoder.width

    @property
    def file(self) -> Path:
        """Where the encoder's words are kept."""
        digest = hashlib.sha256(self.name.encode()).hexdigest()[:8]  # not every file system tells all names apart
        return self.folder / f"{re.sub(r'[^A-Za-z0-9-]+', '_', self.name)[:60]}_{digest}.sqlite"

    def encode(self, texts: Sequence[str]) -> tuple[Float[Tensor, "batch words width"], Int[Tensor, " batch"]]:
        """See `TextEncoder`; always on the CPU."""
        check(texts)
        words = self._read(texts)
        missing = [text for text in dict.fromkeys(texts) if text not in words]
        if missing:
            logger.info("encoding %d texts with %s; %d are known", len(missing), self.name, len(words))
        for start in range(0, len(missing), AT_ONCE):
            chunk = missing[start : start + AT_ONCE]
            rows, lengths = self.encoder.encode(chunk)
            fresh = {text: row[:length].cpu() for text, row, length in zip(chunk, rows, lengths, strict=True)}
            self._write(fresh)
            words |= fresh
            logger.info("encoded %d of %d texts", start + len(chunk), len(missing))
        return pad([words[text] for text in texts])

    def missing(self, texts: Sequence[str]) -> list[str]:
        """Those of the texts, each once, whose words are not kept yet."""
        words = self._read(texts)
        return [text for text in dict.fromkeys(texts) if text not in words]

    def _read(self, texts: Sequence[str]) -> dict[str, Float[Tensor, "_ width"]]:
        """The words of those texts that are there and whole."""
        if not self.file.exists():
            return {}
        words = {}
        try:
            with self._opened("rw") as database:
                for text in dict.fromkeys(texts):
                    row = database.execute("SELECT words, sha256 FROM texts WHERE text = ?", (_key(text),)).fetchone()
                    if row and row[1] == self._digest(text, row[0]):
                        words[text] = load(row[0])["words"]
        except (*_DAMAGED, SafetensorError, TypeError) as error:
            logger.warning("%s cannot be read (%s); what is missing is encoded again", self.file, error)
        return {text: found for text, found in words.items() if found.shape[-1] == self.width}

    def _write(self, words: dict[str, Float[Tensor, "_ width"]]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self._insert(words)
            damaged = not self._read(list(words)[:1])
        except _DAMAGED as error:
            if self._is_kept_away(error):
                raise OSError(f"{self.file} cannot be written: {error}") from error
            damaged = True
        if damaged:
            logger.warning("%s is damaged, and made anew", self.file)
            for path in (self.file, self.file.with_name(f"{self.file.name}-journal")):
                path.unlink(missing_ok=True)
            self._insert(words)

    def _is_kept_away(self, error: Exception) -> bool:
        """Whether the place refuses to be written, not the file; a damaged file may say that it is read-only."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        return code in _OF_THE_PLACE or (code == sqlite3.SQLITE_READONLY and not os.access(self.file, os.W_OK))

    def _insert(self, words: dict[str, Float[Tensor, "_ width"]]) -> None:
        rows = [(_key(text), save({"words": found.contiguous()})) for text, found in words.items()]
        digests = [self._digest(text, content) for text, (_, content) in zip(words, rows, strict=True)]
        with self._opened("rwc") as database:
            database.execute("CREATE TABLE IF NOT EXISTS texts (text BLOB PRIMARY KEY, words BLOB, sha256 BLOB)")
            database.executemany(
                "INSERT OR REPLACE INTO texts VALUES (?, ?, ?)",
                [(*row, digest) for row, digest in zip(rows, digests, strict=True)],
            )

    @contextmanager
    def _opened(self, mode: str) -> Iterator[sqlite3.Connection]:
        """The database, for one transaction. After a kill also a reader has to write: it undoes what was half done."""
        place = f"{self.file.absolute().as_uri()}?mode={mode}"
        database = sqlite3.connect(place, timeout=_PATIENCE, uri=True)
        try:
            with database:
                yield database
        finally:
            database.close()

    def _digest(self, text: str, content: bytes) -> bytes:
        # SQLite notices much that is damaged, but not a flipped bit within the numbers.
        return hashlib.sha256(f"{self.name}\0{len(text)}\0{text}".encode(errors="surrogatepass") + content).digest()


def _key(text: str) -> bytes:
    return text.encode(errors="surrogatepass")
