"""`stmc COMMAND …`: every script of the repository as a command of one program."""

from __future__ import annotations

import ast
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import stmc
from stmc.cli.commands import SHORT, Command
from stmc.cli.exit_codes import guarded
from stmc.settings.records import check_name

COMMANDS = (
    "abilities",
    "actions",
    "analyse_study",
    "attention",
    "baselines",
    "benchmark",
    "benchmark_length",
    "embed",
    "evaluate",
    "import_checkpoint",
    "open_mtt",
    "prepare",
    "sample",
    "studio",
    "study",
    "train",
    "train_tmr",
)
"""Modules of this package that are commands."""


def program(arguments: Sequence[str] | None = None) -> int:
    """Runs `stmc` with what was typed behind it, and returns the exit code: the first argument names the command, the
    others are the command's; without any, all commands are listed."""
    name, *others = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    code = 0

    def run() -> None:
        nonlocal code
        if name in ("--help", "-h", "help"):
            sys.stdout.write(listed())
        elif name == "--version":
            sys.stdout.write(f"stmc {stmc.__version__}\n")
        else:
            code = found(name)(others)

    return guarded(run) or code


def found(name: str) -> Command:
    """The command of that name. Raises `SettingError`."""
    script = SHORT.get(name, name).replace("-", "_")
    if script not in scripts():
        check_name(name, named_commands(), "command")
    return import_module(f"stmc.cli.{script}").main


def scripts() -> dict[str, str]:
    """Return every command's module with the first line of its docstring, without importing it."""
    texts = {name: (Path(__file__).parent / f"{name}.py").read_text(encoding="utf-8") for name in COMMANDS}
    return {name: (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0] for name, text in texts.items()}


def named_commands() -> dict[str, str]:
    """Every command with the first line of its script's docstring."""
    names = {script: short for short, script in SHORT.items()}
    return {names.get(script, script): told for script, told in scripts().items()}


def listed() -> str:
    """What `stmc --help` prints."""
    rows = [f"  {name:<18}{told.partition(':')[0].rstrip('.')}" for name, told in named_commands().items()]
    return "\n".join(["Usage: stmc COMMAND [SETTING=VALUE …]", "", *rows, "", "stmc COMMAND --help says more.", ""])
