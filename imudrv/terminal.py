"""Command lines: commands loaded when called, error messages, exit codes, progress bar."""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version

from imudrv.errors import InputError

OK, OUR_FAULT, BAD_INPUT, NOT_GOOD, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit codes."""


def run_program(
    package: str, description: str, commands: Mapping[str, str], argv: Sequence[str] | None
) -> int:
    """Run a program whose commands are modules of a package.

    Module ``new_thing`` of the package is the command ``new-thing``: ``add_arguments(parser)`` declares its
    arguments, ``run(arguments)`` does the work and may return an exit code, ``EXAMPLE`` is shown by its help.
    Only the module of the command that is called is imported, so that help costs no numerical library.

    Parameters
    ----------
    package : str
        Name of the package, such as ``imudrv.cli``; its first part is the name of the program.
    description : str
        What the program does, for its help.
    commands : mapping of str to str
        What each command does, by its name.
    argv : sequence of str or None
        Arguments; those of the process if None.

    Returns
    -------
    int
        Exit code, see `guarded`.
    """
    return guarded(lambda: _run(package, description, commands, sys.argv[1:] if argv is None else argv))


def _run(package: str, description: str, commands: Mapping[str, str], arguments: Sequence[str]) -> int | None:
    name = next((argument for argument in arguments if not argument.startswith("-")), None)
    program = package.partition(".")[0]
    parser = argparse.ArgumentParser(
        prog=program, description=description, epilog=f"example: {program} {next(iter(commands))} --help"
    )
    parser.add_argument("--version", action="version", version=f"{program} {version('imu50')}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    module = None
    for command, text in commands.items():
        subparser = subparsers.add_parser(command, help=text, description=text)
        if command == name:
            module = import_module(f"{package}.{command.replace('-', '_')}")
            subparser.epilog = f"example: {program} {command} {module.EXAMPLE}".rstrip()
            module.add_arguments(subparser)
    parsed = parser.parse_args(arguments)
    code: int | None = module.run(parsed) if module else None
    return code


def guarded(command: Callable[[], int | None]) -> int:
    """Run a command; an error becomes one message and an exit code.

    Parameters
    ----------
    command : callable
        The work; may return an exit code.

    Returns
    -------
    int
        The command's exit code, 0 if it has none or stops because nobody reads its output; 2 for an error
        of the user; 130 after Ctrl-C; 1 for a defect of this product, reported with its place in the code.
    """
    code = OK
    try:
        code = command() or OK
        if sys.stdout is not None:  # None: the process was started with it closed
            sys.stdout.flush()
    except InputError as error:
        _complain(f"error: {error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        _complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of the output has gone, as `head` does; Python must not flush it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        from traceback import format_tb

        place = "".join(format_tb(error.__traceback__)[-2:])
        _complain(f"internal error, please report it: {type(error).__name__}: {error}\n{place}")
        return OUR_FAULT
    return code


def _complain(text: str) -> None:
    if sys.stderr is not None:
        sys.stderr.write(f"{text}\n")


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on a terminal; elsewhere nothing.

    Parameters
    ----------
    title : str
        Name of the work.
    total : int
        Amount of work, in any unit.

    Yields
    ------
    callable
        Called with the amount done since the last call.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda amount: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn(title), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda amount: bar.advance(task, amount)
