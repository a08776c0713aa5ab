"""Tables of `stmc actions`: success by action, by distance from the training texts, and by text of MTT."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean

from rich.console import Console
from rich.table import Table

from stmc.cli.action_plausibility import LIVELY, is_lively
from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, mirror_words
from stmc.evaluation.benchmarks.novelty import success_by_distance
from stmc.text import MiniLM
from stmc.text.vocabulary import SHOWN_RATE

FLOATING_CM = 2.5
"""Samples float if their lower toe stays higher than in recordings by more centimetres."""
CONFUSED = 0.2
"""A text is reported as confused with another if a larger share of its motions passes the other's check."""


def print_report(results: dict, console: Console) -> None:
    """Print how well samples show each content.

    One table compares success with that of real motion and of other contents (chance), and has the evaluator's
    retrieval. The other compares the foot sliding and the height of the lower toe with those of real motion, and has
    the energy of samples as a multiple of that of real motion: of the whole motion, of its calmest second, and after
    one-shot actions (of people who stand). Then it names the contents that are less or more alive than recordings by a
    factor of two, or float.
    """
    shares = ("shown", "ceiling", "chance", "found", "real_found")
    success = Table("content", "success", "real", "chance", "found", "real")
    life = Table("content", "slide, cm", "real", "toe, cm", "real", "energy", "calmest", "after")
    ratios = {name: compare_energies(row) for name, row in results.items()}
    for name, row in results.items():
        centimetres = [row[whose][key] for key in ("sliding_cm", "lower_toe_cm") for whose in ("sampled", "real")]
        cells = ["" if value is None else f"{value:.1f}" for value in centimetres]
        factors = ["" if ratio is None else f"{ratio:.2f}" for ratio in ratios[name].values()]
        success.add_row(name, *(format_percent(row[column]) for column in shares))
        life.add_row(name, *cells, *factors)
    columns = [[row[column] for row in results.values() if row[column] is not None] for column in shares]
    success.add_row("mean", *(format_percent(fmean(column) if column else None) for column in columns))
    console.print(success)
    console.print(life)
    for whose in ("sampled", "real"):
        console.print(
            f"largest hand step, {whose}: {max(row[whose]['hand_step_cm'] for row in results.values()):.0f} cm"
        )
    for which in ("whole", "calmest", "after"):
        other = [name for name, each in ratios.items() if (ratio := each[which]) is not None and not is_lively(ratio)]
        console.print(f"energy ({which}) beyond a factor of {LIVELY:g} of recordings: {', '.join(other) or 'none'}")
    expected = sum(row["lively"] or 0 for row in results.values())
    console.print(f"as many recordings, drawn at random, are within this factor in {expected:.0f} of {len(results)}")
    heights = {name: row["sampled"]["lower_toe_cm"] - row["real"]["lower_toe_cm"] for name, row in results.items()}
    floating = [name for name, height in heights.items() if height > FLOATING_CM]
    console.print(f"floating by more than {FLOATING_CM:g} cm: {', '.join(floating) or 'none'}")


def compare_energies(row: Mapping) -> dict[str, float | None]:
    """Return the energies of samples as multiples of those of recordings; None where one is unknown or zero."""
    sampled, real = row["sampled"], row["real"]
    pairs = {"whole": "energy", "calmest": "rest_energy"}
    ratios = {name: sampled[key] / real[key] if real[key] else None for name, key in pairs.items()}
    return {**ratios, "after": row["after"]}


def format_percent(share: float | None) -> str:
    """Format a share for a table; empty if it was not measured."""
    return "" if share is None else f"{share:.0%}"


def print_by_distance(results: dict, console: Console) -> None:
    """Print success by the distance of a sentence to the nearest training sentence on the same contents."""
    shares = {text: share for row in results.values() for text, share in row["sentences"].items()}
    if not shares:
        return  # none of the contents has a geometric check
    training = [text for name in results for text in CONTENTS[name].sentences]
    table = Table("cosine to the nearest training sentence", "sentences", "success")
    for name, count, success in success_by_distance(shares, training, MiniLM()):
        table.add_row(name, str(count), "" if success is None else f"{success:.0%}")
    console.print(table)


def print_texts(results: Mapping[str, Mapping], samples: int) -> None:
    """Print each text with its success, its warning and the other checks that its samples pass; then a summary."""
    console, table = Console(), Table("text", "shown", "on its own side", "warns", "also passes")
    for text, row in results.items():
        counts = [f"{samples * row[name]:.0f}/{samples}" for name in ("shown", "sided")]
        name = text if row["words"] == text else f"{text}: {row['words']}"
        warns = {None: "?", True: "warns", False: ""}[row["warned"]]
        table.add_row(name, counts[0], counts[1] if mirror_words(text) != text else "", warns, name_confusions(row))
    console.print(table)
    shown = {text: row["sided"] >= SHOWN_RATE for text, row in results.items()}
    silent = sum(not shown[text] and row["warned"] is False for text, row in results.items())
    warned = sum(shown[text] and bool(row["warned"]) for text, row in results.items())
    mean = fmean(row["shown"] for row in results.values())
    console.print(
        f"shown: {sum(shown.values())} of {len(results)} texts, in {SHOWN_RATE:.0%} of the samples or more; "
        f"mean {mean:.2f}; missed without a warning: {silent}; shown despite a warning: {warned}",
        soft_wrap=True,
    )


def name_confusions(row: Mapping) -> str:
    """List the three other texts whose checks are passed most often, above `CONFUSED`."""
    passed = sorted(((row[other], other) for other in MTT_CHECKS if row.get(other, 0) > CONFUSED), reverse=True)
    return ", ".join(f"{other} {share:.0%}" for share, other in passed[:3])
