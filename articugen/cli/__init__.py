"""The command line: `data` makes and inspects data sets, `learn` trains; each command calls one
function."""

from articugen.cli.generate import app, main

__all__ = ["app", "main"]
