"""The command line: a thin face, each command calls one function.

Exit status: 0 done; 1 an error, said in one sentence on stderr, or a data set that is not what its
recipe asks for, as its manifest says; 2 wrong usage; 3 the data set is complete, but for objects
that were rejected (within the recipe's limit); 130 interrupted; 143 ended by SIGTERM.
"""

import os
import signal
import sys
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Annotated, Any, NoReturn, cast

import typer

from articugen.cli.saying import FAILED, STOPPED, UNHEARD, Stopped, say_error, stdout
from articugen.core.content import VERSION

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Articulated URDF models in, labelled HDF5 training data out.",
    epilog="Exit status: 0 done, 1 error, 2 wrong usage, 3 done but some objects were rejected, "
    "130 interrupted, 143 ended by SIGTERM.",
)


def main() -> None:
    """Run the command line and exit."""
    with suppress(OSError):  # of letters that a terminal lacks
        for stream in (sys.stdout, sys.stderr):
            cast("Any", stream).reconfigure(errors="replace")
    stopped: list[int] = []
    for number in STOPPED:
        signal.signal(number, partial(_stop_once, stopped))
    try:
        app(prog_name="articugen")
    except OSError as error:  # what is meant for the terminal went to a full disk, say
        with suppress(OSError):
            say_error(f"{error.filename or 'output'}: {error.strerror}")
        _drop_output()
        sys.exit(FAILED)
    except SystemExit as left:
        if stopped and left.code:
            _leave_at_once(STOPPED[stopped[0]])
        if isinstance(left.__context__, BrokenPipeError):  # rich and click call that 1
            _drop_output()
            sys.exit(UNHEARD)
        raise


def _stop_once(stopped: list[int], number: int, frame: FrameType | None) -> None:
    """Stop the work at the first Ctrl-C or SIGTERM; a second one does not end the clean-up.

    A module that is just being imported may catch whatever is raised there, as trimesh does around
    what is optional, and the work would go on: then the process ends as if it were killed, after
    which everything can be resumed as well.
    """
    for one in STOPPED:
        signal.signal(one, signal.SIG_IGN)
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _leave_at_once(STOPPED[number])
        frame = frame.f_back
    stopped.append(number)
    raise Stopped(number)


def _leave_at_once(status: int) -> NoReturn:
    """Without waiting for threads that wait for a server: what is to be kept is kept."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def _drop_output() -> None:
    """Have Python not try again, at its end, to write what could not be written."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


def _version(wanted: bool) -> None:
    if wanted:
        stdout.print(f"articugen {VERSION}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Say which and exit."),
    ] = False,
) -> None:
    pass
