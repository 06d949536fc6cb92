"""The command line: `generate` and `data` make and check data sets, `learn` trains; each command
calls one function."""

# The order of the commands in --help.
from articugen.cli import generate, data, fetch, view, export, discover, learn  # noqa: F401, I001
from articugen.cli.app import app, main

__all__ = ["app", "main"]
