"""The command line: one module per command, and the machinery that they share.

`command` turns a function and a record of settings into a command; `program` runs `stmc COMMAND …`. This package knows
Hydra, which composes configurations.
"""
