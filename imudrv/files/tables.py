"""Pulses and increments into files: `.csv`, `.npz`, and `.i50n` datagrams; the suffix says which.

A file appears whole under its name or not at all: it is written beside it and renamed at the end. All three
are written as the data comes, so that a capture of any length needs little memory.
"""

import shutil
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.outputs import is_standard_output
from imudrv.records import INCREMENTS, Records, Source
from imudrv.wire.datagram import encode
from imudrv.wire.layout import Layout

Columns = Mapping[str, NDArray[np.generic]]


_IN_RECORD: Final = {"dtheta": "dtheta_b", "dv": "dv_b"}


_AXES: Final = ("x", "y", "z")


_STANDARD_OUTPUT: Final = 1  # its file descriptor


def pulse_columns(pulses: Records, layout: Layout) -> Columns:
    """Columns of decoded pulses.

    Parameters
    ----------
    pulses : ndarray of PULSES
        Decoded.
    layout : Layout
        Of the profile: how many temperatures there are.

    Returns
    -------
    mapping of str to ndarray
        Each with one row a sample.
    """
    return {
        "counter": pulses["counter"],
        "interval_ns": pulses["interval_ns"],
        "gyro": pulses["gyro"],
        "accelerometer": pulses["accelerometer"],
        "temperature_degc": pulses["temperature_degc"][:, : len(layout.temperature_names)],
        "status": pulses["status"],
        "flags": pulses["flags"],
    }


def increment_columns(increments: Records) -> Columns:
    """Columns of compensated increments, body axes.

    Parameters
    ----------
    increments : ndarray of INCREMENTS
        Compensated.

    Returns
    -------
    mapping of str to ndarray
        Each with one row a sample.
    """
    return {
        "counter": increments["counter"],
        "interval_ns": increments["interval_ns"],
        "t_ns": increments["t_ns"],
        "dtheta": increments["dtheta_b"],
        "dv": increments["dv_b"],
        "flags": increments["flags"],
    }


class Table(Protocol):
    """A file that rows are appended to."""

    def write(self, columns: Columns) -> None:
        """Append the rows of one piece."""

    def finish(self) -> None:
        """Complete the file."""


class CsvTable:
    """Text with a header line; its numbers read back to the same bits.

    Parameters
    ----------
    file : binary file
        Open for writing.
    parts : mapping of str to sequence of str
        What the parts of a column are called where they are not x, y, z.
    """

    def __init__(self, file: IO[bytes], parts: Mapping[str, Sequence[str]]) -> None:
        self._file = file
        self._parts = parts
        self._begun = False

    def write(self, columns: Columns) -> None:
        """Append rows; the first ones bring the header."""
        names: list[str] = []
        flat: list[list[object]] = []
        for name, column in columns.items():
            if column.ndim == 1:
                names.append(name)
                flat.append(column.tolist())
            else:
                names += [f"{name}_{part}" for part in self._parts.get(name, _AXES)]
                flat += [part.tolist() for part in column.T]
        if not self._begun:
            self._begun = True
            self._file.write((",".join(names) + "\n").encode())
        self._file.write("".join(",".join(map(repr, row)) + "\n" for row in zip(*flat, strict=True)).encode())

    def finish(self) -> None:
        """Nothing is held back."""


class NpzTable:
    """numpy's archive, one array a column; the columns grow in temporary files beside it.

    Parameters
    ----------
    file : binary file
        Open for writing.
    folder : Path
        Where the temporary files may be.
    """

    def __init__(self, file: IO[bytes], folder: Path) -> None:
        self._file = file
        self._folder = folder
        self._open = ExitStack()
        self._columns: dict[str, tuple[IO[bytes], np.dtype[np.generic], tuple[int, ...]]] = {}
        self._rows = 0

    def write(self, columns: Columns) -> None:
        """Append rows."""
        for name, column in columns.items():
            if name not in self._columns:
                grown = self._open.enter_context(TemporaryFile(dir=self._folder))  # noqa: SIM115
                self._columns[name] = (grown, column.dtype, column.shape[1:])
            self._columns[name][0].write(np.ascontiguousarray(column).tobytes())
        self._rows += len(next(iter(columns.values())))

    def finish(self) -> None:
        """Put the columns together."""
        with self._open, zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED) as archive:
            for name, (grown, dtype, shape) in self._columns.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    header = {"descr": dtype.str, "fortran_order": False, "shape": (self._rows, *shape)}
                    np.lib.format.write_array_header_1_0(member, header)
                    grown.seek(0)
                    shutil.copyfileobj(grown, member, 1 << 20)


class DatagramTable:
    """`I50N` datagrams back to back.

    Parameters
    ----------
    file : binary file
        Open for writing.
    source : Source
        Where the samples come from.
    """

    def __init__(self, file: IO[bytes], source: Source) -> None:
        self._file = file
        self._source = source

    def write(self, columns: Columns) -> None:
        """Append increments."""
        increments = np.zeros(len(columns["counter"]), INCREMENTS)
        for name, column in columns.items():
            increments[_IN_RECORD.get(name, name)] = column
        self._file.write(encode(increments, self._source))

    def finish(self) -> None:
        """Nothing is held back."""


@contextmanager
def table(path: Path, kinds: Sequence[str], parts: Mapping[str, Sequence[str]]) -> Iterator[Table]:
    """A file for rows, by the suffix of its name; it appears at the end, whole, or not at all.

    Parameters
    ----------
    path : Path
        Where; standard output takes ``.csv``, as it comes.
    kinds : sequence of str
        The suffixes that make sense for what is written.
    parts : mapping of str to sequence of str
        For `CsvTable`.

    Yields
    ------
    Table
        To write to.

    Raises
    ------
    InputError
        Another suffix, or see `writing`.
    """
    suffix = ".csv" if is_standard_output(path) and ".csv" in kinds else path.suffix
    if suffix not in kinds:
        raise InputError(
            f"{path}: expected a name ending in {', '.join(kinds)}, got {path.suffix or 'no suffix'}"
        )
    with writing(path) as file:
        rows: Table
        if suffix == ".csv":
            rows = CsvTable(file, parts)
        elif suffix == ".npz":
            rows = NpzTable(file, Path(file.name).parent)
        else:
            rows = DatagramTable(file, Source.REPLAY)
        yield rows
        rows.finish()


@contextmanager
def writing(path: Path) -> Iterator[IO[bytes]]:
    """Standard output where the name means that, and a file as of `atomic_write` otherwise.

    Parameters
    ----------
    path : Path
        The name.

    Yields
    ------
    binary file
        To write to, from its beginning to its end.

    Raises
    ------
    InputError
        See `atomic_write`; or standard output is closed or full.
    BrokenPipeError
        The reader of standard output has left.
    """
    if not is_standard_output(path):
        with atomic_write(path) as file:
            yield file
        return
    try:
        # A buffer of its own: what a full disk does not take must not be tried again at exit.
        with open(_STANDARD_OUTPUT, "wb", closefd=False) as file:
            yield file
    except BrokenPipeError:
        raise
    except OSError as error:
        raise InputError(f"standard output: cannot be written: {error.strerror or error}") from error
