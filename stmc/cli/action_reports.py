"""The tables that `stmc actions` prints: success by action, by distance from the training, and of MTT's texts.

Knows results and consoles; knows no model and no motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean

from rich.console import Console
from rich.table import Table

from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.benchmarks.calibrating import SHOWN
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, mirror_words
from stmc.evaluation.benchmarks.novelty import success_by_distance
from stmc.text import MiniLM

CONFUSED = 0.2
"""The share of motions of one text that pass the check of another, from which on it is named."""


def report(results: dict, console: Console) -> None:
    """How often the samples show each content, beside how often real motion of it does, and real motion of others; how
    often the evaluator finds it; how far feet slide in them, and in real motion."""
    shares = ("shown", "ceiling", "chance", "found", "real_found")
    table = Table("content", "success", "real motion", "chance", "found", "real motion", "slide, cm", "real motion")
    for name, row in results.items():
        slides = [row[whose]["sliding_cm"] for whose in ("sampled", "real")]
        cells = ["" if slide is None else f"{slide:.1f}" for slide in slides]
        table.add_row(name, *(percent(row[column]) for column in shares), *cells)
    columns = [[row[column] for row in results.values() if row[column] is not None] for column in shares]
    table.add_row("mean", *(percent(fmean(column) if column else None) for column in columns))
    console.print(table)
    for whose in ("sampled", "real"):
        console.print(
            f"largest hand step, {whose}: {max(row[whose]['hand_step_cm'] for row in results.values()):.0f} cm"
        )


def percent(share: float | None) -> str:
    """A share as a table shows it; nothing where it was not judged."""
    return "" if share is None else f"{share:.0%}"


def report_by_distance(results: dict, console: Console) -> None:
    """How often the samples show sentences that are near to one of the training on these contents, and far from all."""
    shares = {text: share for row in results.values() for text, share in row["sentences"].items()}
    training = [text for name in results for text in CONTENTS[name].sentences]
    table = Table("cosine to the nearest training sentence", "sentences", "success")
    for name, count, success in success_by_distance(shares, training, MiniLM()):
        table.add_row(name, str(count), "" if success is None else f"{success:.0%}")
    console.print(table)


def report_texts(results: Mapping[str, Mapping], samples: int) -> None:
    """Each text with its samples, whether it warns and which others they pass; then how many texts are shown."""
    console, table = Console(), Table("text", "shown", "its side alone", "warns", "passes also")
    for text, row in results.items():
        counts = [f"{samples * row[name]:.0f}/{samples}" for name in ("shown", "sided")]
        name = text if row["words"] == text else f"{text}: {row['words']}"
        warns = {None: "?", True: "warns", False: ""}[row["warned"]]
        table.add_row(name, counts[0], counts[1] if mirror_words(text) != text else "", warns, others_passed(row))
    console.print(table)
    shown = {text: row["sided"] >= SHOWN for text, row in results.items()}
    silent = sum(not shown[text] and row["warned"] is False for text, row in results.items())
    warned = sum(shown[text] and bool(row["warned"]) for text, row in results.items())
    mean = fmean(row["shown"] for row in results.values())
    console.print(
        f"shown: {sum(shown.values())} of {len(results)} texts, in {SHOWN:.0%} of the samples or more; "
        f"mean {mean:.2f}; missed without a warning: {silent}; shown although warned of: {warned}",
        soft_wrap=True,
    )


def others_passed(row: Mapping) -> str:
    """The other texts whose checks are passed most often, above `CONFUSED`."""
    passed = sorted(((row[other], other) for other in MTT_CHECKS if row.get(other, 0) > CONFUSED), reverse=True)
    return ", ".join(f"{other} {share:.0%}" for share, other in passed[:3])
