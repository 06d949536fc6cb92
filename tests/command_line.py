"""The command line, in this process."""

from typing import Any

from typer.testing import CliRunner, Result

from articugen.cli import app


def run(*arguments: object, **options: Any) -> Result:
    """Run a command, and return its exit status and what it printed."""
    return CliRunner().invoke(app, list(map(str, arguments)), **options)
