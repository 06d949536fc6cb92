"""The command line, in this process."""

from typing import Any

from click.testing import Result
from typer.testing import CliRunner

from articugen.cli import app


def run(*arguments: object, **options: Any) -> Result:
    """Run a command, and return its exit status and what it printed."""
    return CliRunner().invoke(app, list(map(str, arguments)), **options)
