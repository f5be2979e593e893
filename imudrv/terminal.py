"""What every command shares: errors in plain words, exit codes, and a progress bar where somebody looks."""

import argparse
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeAlias

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from imudrv.errors import InputError

OK, OUR_FAULT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes."""


_PATIENCE_S = 1.0


Command: TypeAlias = Callable[[argparse.Namespace], int | None]


class CommandLine:
    """A program with commands, each a function of its arguments.

    Parameters
    ----------
    program, description : str
        As help tells them.
    """

    def __init__(self, program: str, description: str) -> None:
        self._parser = argparse.ArgumentParser(prog=program, description=description)
        self._commands = self._parser.add_subparsers(required=True, metavar="COMMAND")

    def add(self, name: str, command: Command, text: str) -> argparse.ArgumentParser:
        """Add a command; gives the parser that its arguments are added to."""
        parser = self._commands.add_parser(name, help=text, description=text)
        parser.set_defaults(command=command)
        return parser

    def run(self, argv: Sequence[str] | None) -> int:
        """Run the command that the arguments name, those of the process if None; gives the exit code."""
        arguments = self._parser.parse_args(argv)
        command: Command = arguments.command
        return guarded(lambda: command(arguments))


def guarded(command: Callable[[], int | None]) -> int:
    """Run a command; what goes wrong becomes one message and an exit code.

    Parameters
    ----------
    command : callable
        The work; an exit code of its own goes before 0.

    Returns
    -------
    int
        0; 2 for what the user gave; 130 after Ctrl-C; 1 for a defect of ours, with the place of it.
    """
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        code = command()
        if sys.stdout is not None:  # as it is in a process that was started with it closed
            sys.stdout.flush()
    except InputError as error:
        console.print(f"error: {error}", markup=False)
        return BAD_INPUT
    except KeyboardInterrupt:
        console.print("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has left, as `head` does; Python must not try to flush it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except Exception as error:
        console.print(f"internal error, please report it: {type(error).__name__}: {error}", markup=False)
        console.print("".join(traceback.format_tb(error.__traceback__)[-2:]), markup=False)
        return OUR_FAULT
    return code or OK


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on a terminal for what takes longer than a second; elsewhere nothing.

    Parameters
    ----------
    title : str
        What is going on.
    total : int
        How much there is.

    Yields
    ------
    callable
        To be told how much more is done.
    """
    console = Console(stderr=True)
    bar = Progress(
        TextColumn(title),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )
    task = bar.add_task(title, total=total)
    begun = time.monotonic()

    def advance(amount: int) -> None:
        bar.advance(task, amount)
        if not bar.live.is_started and console.is_terminal and time.monotonic() - begun > _PATIENCE_S:
            bar.start()

    try:
        yield advance
    finally:
        if bar.live.is_started:
            bar.stop()
