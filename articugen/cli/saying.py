"""What all commands say alike: where it goes, our errors in one sentence, and the exit status."""

import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from shutil import which

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.text import Text

from articugen.core.errors import ArticugenError, printable, spelt_out

FAILED, REJECTED = 1, 3
STOPPED: dict[int, int] = {signal.SIGINT: 130, signal.SIGTERM: 143}
"""The exit status after each signal that stops the work in good order."""
UNHEARD = 128 + 13
"""The exit status where whoever reads the output has left, as `head` does: that of SIGPIPE."""
KEPT = "finished work is kept; run the same command to resume"


class Terminal(Console):
    """A console whose terminal obeys us alone: escapes in what is printed are spelt out, whatever
    file it comes from."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                lines = map(spelt_out, segment.text.split("\n"))
                yield Segment("\n".join(lines), segment.style)


stdout = Terminal(highlight=False)
stderr = Terminal(stderr=True, highlight=False)


def say(*pieces: str | tuple[str, str], to: Console = stdout) -> None:
    """Print a line that ends where it ends, of texts as they are, some with a style."""
    to.print(Text.assemble(*pieces), soft_wrap=True)


def say_error(sentence: str) -> None:
    """Print an error to stderr, on one line."""
    say(("error:", "bold red"), f" {printable(sentence)}", to=stderr)


def called_by_make() -> bool:
    """Return whether a target of the Makefile calls: next steps are then printed in make's
    words."""
    return os.environ.get("ARTICUGEN_CALLED_BY") == "make"


def command(*words: object) -> str:
    """Return a command of ours as it can be pasted: `articugen`, or how this process was called
    where no such command is found, as in an environment that is not activated."""
    program, installed = [sys.argv[0]], which("articugen")
    if os.path.basename(program[0]) != "articugen":  # python -m articugen
        program = ["articugen"] if installed else [sys.executable, "-m", "articugen"]
    elif installed and os.path.realpath(installed) == os.path.realpath(program[0]):
        program = ["articugen"]
    return shlex.join([*program, *map(str, words)])


def whole_command(argv: list[str]) -> str:
    """Return the command as it was typed, without its `--shard`: all shares have it in common."""
    words, left = iter(argv[1:]), list[str]()
    for word in words:
        if word == "--shard":
            next(words, None)
        elif not word.startswith("--shard="):
            left.append(word)
    return shlex.join(["articugen", *left])


class Stopped(KeyboardInterrupt):
    """Somebody, or a batch system, wants the work to end: `number` is the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = signal.Signals(number)


@contextmanager
def said(interrupted: str = "interrupted") -> Iterator[None]:
    """Our errors go to stderr without a traceback; others are faults of ours and keep theirs."""
    try:
        yield
    except ArticugenError as error:
        say_error(str(error))
        raise typer.Exit(FAILED) from None
    except KeyboardInterrupt as stop:
        say(printable(interrupted), to=stderr)
        raise typer.Exit(STOPPED[getattr(stop, "number", signal.SIGINT)]) from None


def compile_for(*commands: str) -> None:
    """Compile the kernels of these commands, where that was not done before, and say so."""
    from articugen.core.compiling import compile_kernels  # noqa: PLC0415 - imports numba

    for one in commands:
        compile_kernels(one, notice=stderr.print)


@contextmanager
def loading() -> Iterator[None]:
    """While a large library loads: for seconds Python hears of no signal, and there is nothing to
    be put in order, so that SIGTERM simply ends the process."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def counting_bar() -> Iterator[Callable[[int, int, str], None]]:
    """A bar with the time left, called with what is done, of how many, and what is being done;
    nothing where stderr is no terminal."""
    from rich import progress as rich  # noqa: PLC0415 - takes time

    bar = rich.Progress(
        rich.SpinnerColumn(),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TimeRemainingColumn(compact=True),
        rich.TextColumn("{task.description}"),
        console=stderr,
        disable=not stderr.is_terminal,
        speed_estimate_period=1800.0,  # work may end in lumps, as objects do
        transient=True,
    )
    running = bar.add_task("", total=None)

    def told(done: int, of: int, name: str) -> None:
        bar.update(running, completed=done, total=of, description=escape(printable(name)))

    with bar:
        yield told
