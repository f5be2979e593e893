"""Files of pulses and increments by their suffix: `.csv`, `.npz`, `.parquet`, or `.i50n` datagrams.

A file appears complete or not at all. All are written piece by piece, so that a capture of any length
needs little memory.
"""

import shutil
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.outputs import is_standard_output
from imudrv.records import INCREMENTS, Records, Source
from imudrv.wire.datagram import encode
from imudrv.wire.layout import Layout

Columns = Mapping[str, NDArray[np.generic]]

_PULSES: Final = ("counter", "interval_ns", "gyro", "accelerometer", "temperature_degc", "status", "flags")
_INCREMENTS: Final = ("counter", "interval_ns", "t_ns", "dtheta_b", "dv_b", "flags")
_AXES: Final = ("x", "y", "z")
_ROW_GROUP: Final = 1 << 16
_STANDARD_OUTPUT: Final = 1  # its file descriptor


def pulse_columns(pulses: Records, layout: Layout) -> Columns:
    """Return the columns of decoded pulses.

    Parameters
    ----------
    pulses : ndarray of PULSES
        Decoded.
    layout : Layout
        Layout of the profile, with the number of temperatures.

    Returns
    -------
    mapping of str to ndarray
        One row a sample.
    """
    columns = {name: pulses[name] for name in _PULSES}
    columns["temperature_degc"] = columns["temperature_degc"][:, : len(layout.temperature_names)]
    return columns


def increment_columns(increments: Records) -> Columns:
    """Return the columns of compensated increments, body axes.

    Parameters
    ----------
    increments : ndarray of INCREMENTS
        Compensated.

    Returns
    -------
    mapping of str to ndarray
        One row a sample.
    """
    return {name.removesuffix("_b"): increments[name] for name in _INCREMENTS}


class Table(Protocol):
    """A file that rows are appended to."""

    def write(self, columns: Columns) -> None:
        """Append the rows of one piece."""

    def finish(self) -> None:
        """Complete the file."""


class CsvTable:
    """Text with a header line; numbers are read back to the same bits.

    Parameters
    ----------
    file : binary file
        Open for writing.
    parts : mapping of str to sequence of str
        Names of the parts of a column, where they are not x, y, z.
    """

    def __init__(self, file: IO[bytes], parts: Mapping[str, Sequence[str]]) -> None:
        self._file = file
        self._parts = parts
        self._begun = False

    def write(self, columns: Columns) -> None:
        """Append rows; the first call writes the header."""
        flat = _flat(columns, self._parts)
        if not self._begun:
            self._begun = True
            self._file.write((",".join(flat) + "\n").encode())
        values = [column.tolist() for column in flat.values()]
        text = "".join(",".join(map(repr, row)) + "\n" for row in zip(*values, strict=True))
        self._file.write(text.replace("nan", "").encode())  # numbers only: NaN is an absent one

    def finish(self) -> None:
        """Do nothing: all rows are written."""


class ParquetTable:
    """Table of Apache Parquet with the columns of `CsvTable`; needs the package pyarrow.

    Parameters
    ----------
    file : binary file
        Open for writing.
    parts : mapping of str to sequence of str
        See `CsvTable`.

    Raises
    ------
    InputError
        The package is absent.
    """

    def __init__(self, file: IO[bytes], parts: Mapping[str, Sequence[str]]) -> None:
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise InputError(".parquet: expected the package pyarrow: pip install imu50[parquet]") from error
        self._arrow = pyarrow
        self._file, self._parts = file, parts
        self._writer: Any = None
        self._pieces: list[Columns] = []
        self._rows = 0

    def write(self, columns: Columns) -> None:
        """Append rows."""
        self._pieces.append(_flat(columns, self._parts))
        self._rows += len(next(iter(columns.values())))
        if self._rows >= _ROW_GROUP:
            self._write_group()

    def finish(self) -> None:
        """Write the last rows and the end of the file."""
        self._write_group()
        self._writer.close()

    def _write_group(self) -> None:
        group = self._arrow.table(
            {name: np.concatenate([piece[name] for piece in self._pieces]) for name in self._pieces[0]}
        )
        if self._writer is None:
            self._writer = self._arrow.parquet.ParquetWriter(self._file, group.schema)
        self._writer.write_table(group)
        self._pieces, self._rows = [_none_of(self._pieces[0])], 0


class NpzTable:
    """Archive of numpy, one array a column; columns are collected in temporary files.

    Parameters
    ----------
    file : binary file
        Open for writing.
    folder : Path
        Folder of the temporary files.
    opened : ExitStack
        Closes the temporary files.
    """

    def __init__(self, file: IO[bytes], folder: Path, opened: ExitStack) -> None:
        self._file = file
        self._folder = folder
        self._open = opened
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
        """Write the archive."""
        with zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED) as archive:
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
        Origin of the samples.
    """

    def __init__(self, file: IO[bytes], source: Source) -> None:
        self._file = file
        self._source = source

    def write(self, columns: Columns) -> None:
        """Append increments."""
        increments = np.zeros(len(columns["counter"]), INCREMENTS)
        for name in _INCREMENTS:
            increments[name] = columns[name.removesuffix("_b")]
        self._file.write(encode(increments, self._source))

    def finish(self) -> None:
        """Do nothing: all rows are written."""


def _flat(columns: Columns, parts: Mapping[str, Sequence[str]]) -> Columns:
    """Return columns of numbers: a vector becomes one column for each of its parts."""
    flat: dict[str, NDArray[np.generic]] = {}
    for name, column in columns.items():
        if column.ndim == 1:
            flat[name] = column
        else:
            flat |= {f"{name}_{part}": column[:, k] for k, part in enumerate(parts.get(name, _AXES))}
    return flat


def _none_of(columns: Columns) -> Columns:
    """Return the same columns without a row."""
    return {name: column[:0] for name, column in columns.items()}


@contextmanager
def table(path: Path, kinds: Sequence[str], parts: Mapping[str, Sequence[str]]) -> Iterator[Table]:
    """Open a file for rows, of the kind of its suffix; it appears at the end, complete, or not at all.

    Parameters
    ----------
    path : Path
        The file; standard output takes ``.csv``, piece by piece.
    kinds : sequence of str
        Suffixes that are possible for these rows.
    parts : mapping of str to sequence of str
        See `CsvTable`.

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
    with writing(path) as file, ExitStack() as opened:
        rows: Table
        if suffix == ".csv":
            rows = CsvTable(file, parts)
        elif suffix == ".parquet":
            rows = ParquetTable(file, parts)
        elif suffix == ".npz":
            rows = NpzTable(file, Path(file.name).parent, opened)
        else:
            rows = DatagramTable(file, Source.REPLAY)
        yield rows
        rows.finish()


@contextmanager
def writing(path: Path) -> Iterator[IO[bytes]]:
    """Open standard output if the name means that, or else a file as `atomic_write` does.

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
        The reader of standard output has closed it.
    """
    if not is_standard_output(path):
        with atomic_write(path) as file:
            yield file
        return
    if sys.stdout is None:
        raise InputError("standard output: cannot be written: it is closed")
    try:
        # Its own buffer: data that a full disk does not take must not be written again at exit.
        with open(_STANDARD_OUTPUT, "wb", closefd=False) as file:
            yield file
    except BrokenPipeError:
        raise
    except OSError as error:
        raise InputError(f"standard output: cannot be written: {error.strerror or error}") from error
