"""Shards of work for several processes or machines: the requested shard, its items, and the items still missing.

A shard takes every n-th item, so it depends on the order of the items alone, and the shards of items sorted by size are
about equal in work. Depends on numbers and sequences; independent of the kind of items.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from stmc.settings.records import SettingError, quote

Item = TypeVar("Item")

ALL = "all"


class Incomplete(ValueError):
    """Results of other shards are missing; the message names the shards."""


@dataclass(frozen=True)
class Shard:
    """The `number`-th of `count` shards, counted from 1; with `number` None, no items, only a view of all shards.

    Raises:
        SettingError: If the number is not from 1 to `count`.

    Examples:
        >>> shard = stmc.Shard(2, 3)
        >>> shard.of(["a", "b", "c", "d", "e"])
        ['b', 'e']
        >>> [motion] = stmc.load().generate(shard.of(["walk # 0 # 1", "jump # 0 # 1"]), seed=shard.of([7, 8]), steps=2)
    """

    number: int | None = 1
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise SettingError(f"shard={self}: the count must be at least 1")
        if self.number is not None and not 1 <= self.number <= self.count:
            valid = f"must be from 1/{self.count} to {self.count}/{self.count}"
            raise SettingError(f"shard={self}: {valid} (for a job array: --array=1-{self.count})")

    def __str__(self) -> str:
        return f"{ALL if self.number is None else self.number}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse a shard such as "3/64", or "all/64". Raises `SettingError` for any other text.

        Examples:
            >>> stmc.Shard.parse("3/64")
            Shard(number=3, count=64)
        """
        match = re.fullmatch(rf"({ALL}|\d{{1,9}})/(\d{{1,9}})", text)
        if match is None:
            raise SettingError(f"shard={quote(text)}: must be like 3/64, the third of 64 shards, or {ALL}/64")
        return cls(None if match[1] == ALL else int(match[1]), int(match[2]))

    @classmethod
    def of_process(cls, environment: Mapping[str, str] = os.environ) -> Shard:
        """Return the shard of this process among those of `accelerate launch` or `torchrun`, by RANK and WORLD_SIZE.

        A single process has the shard 1/1. Raises `SettingError` for values that are not numbers.

        Examples:
            >>> stmc.Shard.of_process({"RANK": "0", "WORLD_SIZE": "4"})
            Shard(number=1, count=4)
        """
        rank, size = environment.get("RANK"), environment.get("WORLD_SIZE")
        if rank is None or size is None:
            return cls()
        if not (rank.isdecimal() and size.isdecimal()):
            raise SettingError(f"RANK={quote(rank)}, WORLD_SIZE={quote(size)}: must be whole numbers")
        return cls(int(rank) + 1, int(size))

    @classmethod
    def read(cls, text: str | None) -> Shard:
        """Return the shard that a text names, or that of this process if there is no text.

        Examples:
            >>> stmc.Shard.read(None)
            Shard(number=1, count=1)
        """
        return cls.of_process() if text is None else cls.parse(text)

    def of(self, items: Sequence[Item]) -> list[Item]:
        """Return every `count`-th item, from the `number`-th on.

        Examples:
            >>> stmc.Shard(3, 64).of(range(200))
            [2, 66, 130, 194]
        """
        return [] if self.number is None else list(items[self.number - 1 :: self.count])

    def count_missing(self, items: Sequence[Item], missing: Collection[Item]) -> dict[Shard, int]:
        """Count the missing items of each shard that has any.

        Examples:
            >>> {str(shard): count for shard, count in stmc.Shard(1, 3).count_missing("abcde", missing="be").items()}
            {'2/3': 2}
        """
        missing = set(missing)
        shards = [Shard(number, self.count) for number in range(1, self.count + 1)]
        counts = {shard: sum(item in missing for item in shard.of(items)) for shard in shards}
        return {shard: count for shard, count in counts.items() if count}


def describe_shards(lacking: Mapping[Shard, int], most: int = 8) -> str:
    """Describe shards and the number of missing items of each: "shards 2/4 (5) and 3/4 (125)"."""
    words = [f"{shard} ({count})" for shard, count in lacking.items()]
    if len(words) > most:
        words = [*words[:most], f"{len(words) - most} more"]
    return f"shard{'s' * (len(words) > 1)} {' and '.join(filter(None, (', '.join(words[:-1]), words[-1])))}"
