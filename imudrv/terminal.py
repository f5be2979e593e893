"""Command lines: commands loaded when called, error messages, exit codes, progress bar."""

import argparse
import errno
import gc
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import version
from io import TextIOWrapper
from typing import TYPE_CHECKING, Any, Final, NoReturn, TextIO

from imudrv.compilation import compile_all_at_first_miss
from imudrv.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

OK, OUR_FAULT, BAD_INPUT, NOT_GOOD, FAILED, INTERRUPTED = 0, 1, 2, 3, 4, 130
"""Exit codes, see `EXIT_CODES`."""

EXIT_CODES: Final = """exit codes of every command:
  0    done
  1    defect of this product
  2    bad input, or a damaged file
  3    done, but the result is not good or not finished: no certificate, a bad verdict, a unit that moved,
       an unfinished session, a status with warnings
  4    failure in a status; not signed by a trusted key
  130  interrupted
"""

SHELLS: Final = ("bash", "zsh", "tcsh")
"""Shells whose completion is printed."""

_BYTES: Final = re.compile("[\udc80-\udcff]+")
"""Bytes that Python could not decode."""


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
    if len(arguments) == 2 and arguments[0] == "--print-completion" and arguments[1] in SHELLS:
        _print_completion(_parser(package, description, commands, commands), arguments[1])
        return OK
    name = next((argument for argument in arguments if not argument.startswith("-")), None)
    parsed = _parser(package, description, commands, [name]).parse_args(arguments)
    compile_all_at_first_miss()
    code: int | None = _module(package, name).run(parsed) if name else None
    return code


def _parser(
    package: str, description: str, commands: Mapping[str, str], loaded: Collection[str | None]
) -> argparse.ArgumentParser:
    """Return the parser of a program, with the arguments of some of its commands."""
    program = package.partition(".")[0]
    parser = _Parser(
        prog=program,
        description=description,
        epilog=f"{EXIT_CODES}\nexample: {program} {next(iter(commands))} --help",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{program} {version('imu50')}")
    text = "print the completion of a shell, alone; needs imu50[completion]"
    parser.add_argument("--print-completion", choices=SHELLS, default=argparse.SUPPRESS, help=text)
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for command, text in commands.items():
        subparser = subparsers.add_parser(command, help=text, description=text)
        if command in loaded:
            module = _module(package, command)
            subparser.epilog = f"example: {program} {command} {module.EXAMPLE}".rstrip()
            module.add_arguments(subparser)
    return parser


def _module(package: str, command: str) -> Any:
    gc.disable()  # modules stay: searching them for garbage takes a seventh of the start
    try:
        return import_module(f"{package}.{command.replace('-', '_')}")
    finally:
        gc.enable()


def _print_completion(parser: argparse.ArgumentParser, shell: str) -> None:
    try:
        import shtab
    except ImportError:
        raise InputError(
            "--print-completion: expected the package shtab: pip install 'imu50[completion]'"
        ) from None
    sys.stdout.write(f"{shtab.complete(parser, shell)}\n")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(printable(message))


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
    _prepare_streams()
    code = OK
    try:
        code = command() or OK
        if sys.stdout is not None:  # None: the process was started with it closed
            sys.stdout.flush()
    except InputError as error:
        return _refused(str(error))
    except KeyboardInterrupt:
        _complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        _drop_output()  # its reader has gone, as `head` does
    except OSError as error:
        if error.filename is not None:
            return _refused(f"{os.fsdecode(error.filename)}: {error.strerror}")
        if _drop_output() or error.errno == errno.ENOSPC:  # files are reported with their names
            return _refused(f"standard output: cannot be written: {error.strerror}")
        return _defect(error)
    except Exception as error:
        return _defect(error)
    return code


def _prepare_streams() -> None:
    """Let standard streams take any text, and no other file take the place of a closed one."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free descriptor
    if sys.stderr is None:  # closed, as in 2>&-
        sys.stderr = os.fdopen(2, "w", closefd=False)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _drop_output() -> bool:
    """Discard text that standard output does not take, or Python writes it again at exit; return if any."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _refused(text: str) -> int:
    _complain(f"error: {text}")
    return BAD_INPUT


def _defect(error: Exception) -> int:
    from traceback import format_tb

    place = "".join(format_tb(error.__traceback__)[-2:])
    _complain(f"internal error, please report it: {type(error).__name__}: {error}\n{place}")
    return OUR_FAULT


def _complain(text: str) -> None:
    with suppress(OSError):
        say(text, sys.stderr)


def printable(text: str) -> str:
    """Return text with all that is not printable as escapes, such as the control sequences in a file's name.

    Of a name that is not in the encoding of the locale, UTF-8 is shown as such.

    Parameters
    ----------
    text : str
        Any text; its line breaks stay.

    Returns
    -------
    str
    """
    text = _BYTES.sub(
        lambda found: found[0].encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace"), text
    )
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def say(text: str, stream: TextIO | None = None) -> None:
    """Print a message, with the names in it in `printable` form.

    Parameters
    ----------
    text : str
        One line or several.
    stream : text file, optional
        Default: standard output, if that is open.
    """
    print(printable(text), file=stream)


def console(stderr: bool = False) -> "Console":
    """Return a console of `rich` that shows text as it is, in `printable` form: nothing in a name is markup.

    Parameters
    ----------
    stderr : bool
        On standard error instead of standard output.

    Returns
    -------
    Console
    """
    from rich.console import Console

    class PlainConsole(Console):
        def render_str(self, text: str, **options: Any) -> "Text":
            return super().render_str(printable(text), **options)

    return PlainConsole(stderr=stderr, markup=False, emoji=False, highlight=False)


@contextmanager
def progress(title: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on a terminal; elsewhere nothing.

    Parameters
    ----------
    title : str
        Name of the work.
    total : int or None
        Amount of work, bytes or samples; None if it is not known before the end.

    Yields
    ------
    callable
        Called with the amount done since the last call.
    """
    if not sys.stderr.isatty():
        yield lambda amount: None
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    name, amount = TextColumn("{task.description}", markup=False), TextColumn("{task.completed:,}")
    done = (amount,) if total is None else (TaskProgressColumn(), TimeRemainingColumn())
    with Progress(name, BarColumn(), *done, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(printable(title), total=total)
        yield lambda amount: bar.advance(task, amount)
