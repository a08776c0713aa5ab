"""Shares of work that several processes or machines do: which one is asked for, what is in it, what is still missing.

A share takes every n-th item in their order, so that it depends on nothing but the order, and all shares of items that
are sorted by size are about as much work. Knows numbers and items; knows nothing of what they are.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from stmc.settings.records import SettingError, shown

Item = TypeVar("Item")

ALL = "all"


class Incomplete(ValueError):
    """Something that other shares should have made is not there; the message says of which shares."""


@dataclass(frozen=True)
class Shard:
    """The `number`-th of `count` shares, counted from 1; with `number` None no share, but a look at all of them.

    Raises:
        SettingError: For a number that is not one of 1 to `count`.

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
            raise SettingError(f"shard={self}: at least one share")
        if self.number is not None and not 1 <= self.number <= self.count:
            counted = f"shares count from 1, here 1/{self.count} to {self.count}/{self.count}"
            raise SettingError(f"shard={self}: {counted} (of a job array: --array=1-{self.count})")

    def __str__(self) -> str:
        return f"{ALL if self.number is None else self.number}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """As it is typed: "3/64", or "all/64". Raises `SettingError`.

        Examples:
            >>> stmc.Shard.parse("3/64")
            Shard(number=3, count=64)
        """
        found = re.fullmatch(rf"({ALL}|\d{{1,9}})/(\d{{1,9}})", text)
        if found is None:
            raise SettingError(f"shard={shown(text)}: a share like 3/64 needed, the third of 64, or {ALL}/64")
        return cls(None if found[1] == ALL else int(found[1]), int(found[2]))

    @classmethod
    def of_process(cls, environment: Mapping[str, str] = os.environ) -> Shard:
        """Of this process among those that `accelerate launch` or `torchrun` started, by RANK and WORLD_SIZE; 1/1 where
        there are no others. Raises `SettingError` for values that are not numbers.

        Examples:
            >>> stmc.Shard.of_process({"RANK": "0", "WORLD_SIZE": "4"})
            Shard(number=1, count=4)
        """
        rank, size = environment.get("RANK"), environment.get("WORLD_SIZE")
        if rank is None or size is None:
            return cls()
        if not (rank.isdecimal() and size.isdecimal()):
            raise SettingError(f"RANK={shown(rank)}, WORLD_SIZE={shown(size)}: whole numbers needed")
        return cls(int(rank) + 1, int(size))

    @classmethod
    def asked(cls, text: str | None) -> Shard:
        """That of the text; of the process where there is none.

        Examples:
            >>> stmc.Shard.asked(None)
            Shard(number=1, count=1)
        """
        return cls.of_process() if text is None else cls.parse(text)

    def of(self, items: Sequence[Item]) -> list[Item]:
        """Every `count`-th of the items, from the `number`-th on.

        Examples:
            >>> stmc.Shard(3, 64).of(range(200))
            [2, 66, 130, 194]
        """
        return [] if self.number is None else list(items[self.number - 1 :: self.count])

    def lacking(self, items: Sequence[Item], missing: Collection[Item]) -> dict[Shard, int]:
        """Of all shares of the items those that have `missing` ones, and how many.

        Examples:
            >>> {str(shard): count for shard, count in stmc.Shard(1, 3).lacking("abcde", missing="be").items()}
            {'2/3': 2}
        """
        missing = set(missing)
        shards = [Shard(number, self.count) for number in range(1, self.count + 1)]
        counts = {shard: sum(item in missing for item in shard.of(items)) for shard in shards}
        return {shard: count for shard, count in counts.items() if count}


def listed(lacking: Mapping[Shard, int], most: int = 8) -> str:
    """Shares and how much is missing of each, in words: "shards 2/4 (5) and 3/4 (125)"."""
    told = [f"{shard} ({count})" for shard, count in lacking.items()]
    if len(told) > most:
        told = [*told[:most], f"{len(told) - most} more"]
    return f"shard{'s' * (len(told) > 1)} {' and '.join(filter(None, (', '.join(told[:-1]), told[-1])))}"
