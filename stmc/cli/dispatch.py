"""The program `stmc COMMAND …` and the list of its commands, which imports neither torch nor a command."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import stmc
from stmc.cli.exit_codes import run_guarded
from stmc.settings.records import check_name

COMMANDS = (
    "abilities",
    "actions",
    "analyse_study",
    "attention",
    "baselines",
    "benchmark",
    "benchmark_length",
    "benchmark_scale",
    "embed",
    "evaluate",
    "import_checkpoint",
    "open_mtt",
    "prepare",
    "sample",
    "stream",
    "studio",
    "study",
    "train",
    "train_tmr",
)
"""Modules of this package that define a command."""
SHORT = {"import": "import_checkpoint"}
"""Commands whose names differ from their modules'."""


def program(arguments: Sequence[str] | None = None) -> int:
    """Run `stmc` with `arguments` (by default those of the process) and return the exit code.

    The first argument names the command and the others belong to it. Without arguments, list all commands.
    """
    name, *others = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    code = 0

    def run() -> None:
        nonlocal code
        if name in ("--help", "-h", "help"):
            sys.stdout.write(list_commands())
        elif name == "--version":
            sys.stdout.write(f"stmc {stmc.__version__}\n")
        else:
            code = find_command(name)(others)

    return run_guarded(run) or code


def find_command(name: str) -> Callable[[Sequence[str]], int]:
    """Import a command by its name. Raises `SettingError` for an unknown one."""
    script = SHORT.get(name, name).replace("-", "_")
    if script not in module_summaries():
        check_name(name, command_summaries(), "command")
    main: Callable[[Sequence[str]], int] = import_module(f"stmc.cli.{script}").main
    return main


def module_summaries() -> dict[str, str]:
    """Return every command's module with the first line of its docstring, without importing it."""
    texts = {name: (Path(__file__).parent / f"{name}.py").read_text(encoding="utf-8") for name in COMMANDS}
    return {name: (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0] for name, text in texts.items()}


def command_summaries() -> dict[str, str]:
    """Return every command's name with the first line of its module's docstring."""
    names = {script: short for short, script in SHORT.items()}
    return {names.get(script, script): summary for script, summary in module_summaries().items()}


def list_commands() -> str:
    """Return the text that `stmc --help` prints."""
    rows = [f"  {name:<18}{summary.partition(':')[0].rstrip('.')}" for name, summary in command_summaries().items()]
    usage, hint = "Usage: stmc COMMAND [SETTING=VALUE …]", "See stmc COMMAND --help for the settings of a command."
    return "\n".join([usage, "", *rows, "", hint, ""])
