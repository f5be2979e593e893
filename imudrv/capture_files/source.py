"""An open capture file: unpacked if it is compressed, read in bounded pieces and lines."""

import gzip
import io
import os
import weakref
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self, cast

import zstandard

from imudrv.capture_files.recognise import GZIP, ZSTANDARD, Kind
from imudrv.errors import InputError

CHUNK_BYTES: Final = 1 << 17
"""Bytes read at once: few enough for the cache, many enough that Python's overhead does not matter."""
LONGEST_LINE: Final = 1 << 16
"""Maximum length of a line, bytes."""
_PACKED_BYTES: Final = 1 << 8
"""Bytes unpacked at once; at most 2^15 times as many come out of them."""
_LARGEST_WINDOW: Final = 1 << 25
"""Memory for the unpacking of Zstandard, bytes; above that of `zstd --ultra -20`."""
_KEPT_BYTES: Final = 1 << 20
"""Beginning of a pipe that can be read again, bytes; what the file is takes less to find out."""

DAMAGED: Final = (EOFError, gzip.BadGzipFile, zlib.error, zstandard.ZstdError)
"""What a damaged archive raises."""


class Pipe:
    """A pipe as a capture file: its beginning can be read any number of times, the rest once.

    Parameters
    ----------
    path : Path
        The pipe; opening it waits for its other end.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        weakref.finalize(self, os.close, self._descriptor)
        self._kept = bytearray()
        self._taken = 0

    def read_at(self, offset: int, size: int) -> bytes:
        """Return up to so many bytes from an offset on; none at the end."""
        if offset < len(self._kept):
            return bytes(self._kept[offset : offset + size])
        if offset < self._taken:
            raise InputError(f"{self._path}: a pipe can be read once; write the data to a file first")
        data = os.read(self._descriptor, size)
        if self._taken < _KEPT_BYTES:
            self._kept += data
        self._taken += len(data)
        return data


class _PipeReader(io.RawIOBase):
    """One reading of a pipe."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self._offset = 0

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._offset

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        data = self._pipe.read_at(self._offset, len(buffer))
        buffer[: len(data)] = data
        self._offset += len(data)
        return len(data)


class Source:
    """An open capture file.

    Parameters
    ----------
    path : Path
        The file.
    archive : Kind or None
        How it is compressed.
    pipe : Pipe or None
        The pipe that the path names.

    Attributes
    ----------
    path : Path
    lines : int
        Number of lines read so far.
    """

    def __init__(self, path: Path, archive: Kind | None, pipe: Pipe | None = None) -> None:
        self.path = path
        self.lines = 0
        with ExitStack() as stack:
            packed = path.open("rb") if pipe is None else io.BufferedReader(_PipeReader(pipe))
            self._packed = cast(BinaryIO, stack.enter_context(packed))
            self._file: BinaryIO = self._packed
            if archive is GZIP:
                self._file = cast(BinaryIO, stack.enter_context(gzip.open(self._packed)))
            elif archive is ZSTANDARD:
                unpacked = io.BufferedReader(_ZstandardFile(self._packed))
                self._file = cast(BinaryIO, stack.enter_context(unpacked))
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def position(self) -> int:
        """Number of bytes of the file, as it is stored, that have been read."""
        return self._packed.tell()

    def read(self, size: int) -> bytes:
        """Return so many bytes of the content; fewer at its end only."""
        return self._file.read(size)

    def pieces(self) -> Iterator[bytes]:
        """Yield the content in large pieces."""
        while data := self._file.read(CHUNK_BYTES):
            yield data

    def __iter__(self) -> Iterator[bytes]:
        """Yield the lines of the content.

        Raises
        ------
        ValueError
            A line is longer than `LONGEST_LINE`.
        """
        while line := self._file.readline(LONGEST_LINE + 1):
            self.lines += 1
            if len(line) > LONGEST_LINE:
                raise ValueError(f"expected lines of up to {LONGEST_LINE} characters, got a longer one")
            yield line


class _ZstandardFile(io.RawIOBase):
    """Content of a Zstandard archive of one or more frames.

    The stream reader of the package does not notice that an archive is truncated.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._frame: zstandard.ZstdDecompressionObj | None = None
        self._packed = b""
        self._ready = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        while not self._ready and self._unpack():
            pass
        count = min(len(buffer), len(self._ready))
        buffer[:count] = self._ready[:count]
        self._ready = self._ready[count:]
        return count

    def _unpack(self) -> bool:
        """Unpack a little more; return False at the end of the archive."""
        self._packed = self._packed or self._file.read(_PACKED_BYTES)
        if not self._packed:
            if self._frame is not None:
                raise EOFError("the last frame has no end")
            return False
        if self._frame is None:
            self._frame = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW).decompressobj()
        self._ready = memoryview(self._frame.decompress(self._packed))
        self._packed = b""
        if self._frame.eof:
            self._packed, self._frame = self._frame.unused_data, None
        return True
