"""The command line: a script's function becomes a command that knows its settings, and whose user errors are one line.

Knows how settings are given (Hydra composes them), checked, explained, and how a command may end; knows no command.
The scripts are the commands: those of the repository, or those that the wheel carries.
"""

from stmc.commands.dispatch import program
from stmc.commands.entry import Command, command

__all__ = ["Command", "command", "program"]
