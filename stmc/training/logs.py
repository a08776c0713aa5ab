"""Logs of a run: CSV tables that stay correct after a resume, and TensorBoard."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from stmc.io.files import write_whole
from stmc.settings.renamed import RENAMED_COLUMNS


class Table:
    """A CSV file with one row per logged step. Resuming after `step` drops the rows of later steps.

    Raises `ValueError` if an existing file has other columns.
    """

    def __init__(self, path: Path, columns: tuple[str, ...], step: int) -> None:
        self.path, self.columns = path, ("step", *columns)
        kept = [row for row in self._rows() if int(row["step"]) <= step]

        def write(temporary: Path) -> None:
            with temporary.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, self.columns)
                writer.writeheader()
                writer.writerows(kept)

        write_whole(path, write)

    def _rows(self) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            reader.fieldnames = [RENAMED_COLUMNS.get(name, name) for name in reader.fieldnames or ()]
            if tuple(reader.fieldnames) != self.columns:
                raise ValueError(
                    f"{self.path} has the columns {reader.fieldnames}, but this run writes {list(self.columns)}"
                )
            # A killed run can leave half a row at the end.
            return [row for row in reader if None not in row.values() and None not in row]

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append one row; nine significant digits represent float32 exactly."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.columns).writerow(
                {"step": step} | {name: format(value, ".9g") for name, value in values.items()}
            )


class Board:
    """TensorBoard scalars in a folder. Resuming after `step` hides the values of later steps."""

    def __init__(self, folder: Path, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter  # slow to import, and needed by training runs only

        self._writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)

    def write(self, group: str, step: int, values: Mapping[str, float]) -> None:
        """Write one scalar for each value, named `group/name`."""
        for name, value in values.items():
            self._writer.add_scalar(f"{group}/{name}", value, step)
        self._writer.flush()

    def close(self) -> None:
        """Write the remaining values and close the files."""
        self._writer.close()
