"""A capture file in any form, as wire bytes or as the text of a candump log."""

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path, PurePath
from typing import Final, NamedTuple

from imudrv.capture_files import recognise
from imudrv.capture_files.recognise import Kind
from imudrv.capture_files.source import DAMAGED, Pipe, Source
from imudrv.errors import InputError
from imudrv.files.inputs import is_pipe, reason

_HEAD_BYTES: Final = 1 << 16
_JOINED_BYTES: Final = 1 << 17

_READERS: Final = {
    recognise.HEX_DUMP: "hex_dump.read_hex_dump",
    recognise.CANDUMP_DIFFERENCES: "screen.read_differences",
    recognise.CANDUMP_SCREEN: "screen.read_screen",
    recognise.ASC: "can_logs.read_asc",
    recognise.BLF: "can_logs.read_blf",
    recognise.TRC: "can_logs.read_trc",
    recognise.CSV: "can_logs.read_csv",
    recognise.DATABASE: "can_logs.read_database",
    recognise.MDF: "can_logs.read_mdf",
}
"""Readers by kind, imported at first use; other kinds are read as they are."""
_FILES_ONLY: Final = (recognise.DATABASE, recognise.MDF, recognise.RECORDING)
"""Kinds that are not read from the beginning to the end."""
_UNPACKED_ONLY: Final = (*_FILES_ONLY, recognise.GZIP, recognise.ZSTANDARD)


class Piece(NamedTuple):
    """A piece of a capture.

    Parameters
    ----------
    data : bytes
        Wire bytes, or text of a candump log.
    bytes_read : int
        Bytes of the file, as it is stored, that were read for it.
    """

    data: bytes
    bytes_read: int


class CaptureFile:
    """A capture file, recognised by its name and its content.

    Parameters
    ----------
    path : Path
        The file, or a pipe, whose content can be read once.

    Attributes
    ----------
    path : Path
    size : int
        Size of the file as it is stored, bytes; of a pipe what was read so far.
    kind : Kind or None
        What its content is; None if it is no known form, and may be wire bytes.
    archive : Kind or None
        How it is compressed.

    Raises
    ------
    InputError
        There is no such file, it is a folder or a device, is empty, is named otherwise than it is, or cannot
        be read in this form.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.archive: Kind | None = None
        try:
            self._pipe = Pipe(path) if is_pipe(path) else None
            with self._open() as source:
                self._head = source.read(_HEAD_BYTES)
            self.size = path.stat().st_size  # of a pipe 0
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {reason(error)}") from error
        if not self._head:
            raise InputError(f"{path}: expected a capture, got an empty file")
        self.kind = self._recognised(PurePath(path.name))
        if self.kind is recognise.GZIP or self.kind is recognise.ZSTANDARD:
            self._recognise_content(self.kind)
        if self._pipe is not None and self.kind in _FILES_ONLY:
            raise InputError(f"{path}: expected a file with {self.kind.name}, got a pipe; write a file first")

    @property
    def is_recording(self) -> bool:
        """Whether it is a recording of the service, which `imudrv.Recording` reads."""
        return self.kind is recognise.RECORDING

    @property
    def is_converted(self) -> bool:
        """Whether the pieces are not the bytes of the file."""
        return self.kind in _READERS

    @property
    def description(self) -> str:
        """What the file is, for messages."""
        if self.kind is not None:
            text = self.kind.name
        else:
            text = "text of no known form" if recognise.is_text(self._head) else "binary data"
        return f"{text} in {self.archive.name}" if self.archive else text

    def head(self) -> bytes:
        """Return the beginning of what `pieces` yields."""
        head = b""
        for piece in self.pieces():
            head += piece.data
            if len(head) >= _HEAD_BYTES:
                break
        return head[:_HEAD_BYTES]

    def pieces(self) -> Iterator[Piece]:
        """Yield the content from its beginning.

        Yields
        ------
        Piece

        Raises
        ------
        InputError
            The file cannot be read on, is damaged or truncated; the message says where.
        """
        with self._open() as source:
            begin = 0
            chunks = self._chunks(source)
            while True:
                try:
                    data = b"".join(_some(chunks))
                except InputError:
                    raise
                except Exception as error:  # a reader may raise anything
                    raise self._explained(error, source) from error
                # A reader need not read to the end.
                end = source.position if data or self._pipe is not None else self.size
                self.size = max(self.size, end)
                yield Piece(data, end - begin)
                begin = end
                if not data:
                    return

    def _open(self) -> Source:
        try:
            return Source(self.path, self.archive, self._pipe)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror}") from error

    def _chunks(self, source: Source) -> Iterator[bytes]:
        if self.kind not in _READERS:
            return source.pieces()
        module, _, name = _READERS[self.kind].partition(".")
        read: Callable[[Source], Iterator[bytes]]
        read = getattr(import_module(f"imudrv.capture_files.{module}"), name)
        return read(source)

    def _recognised(self, name: PurePath) -> Kind | None:
        return recognise.recognise(self.path, name if self._pipe is None else None, self._head)

    def _recognise_content(self, archive: Kind) -> None:
        """Recognise what is in the archive."""
        self.archive, self.kind = archive, None
        self._head = self.head()
        if not self._head:
            raise InputError(f"{self.path}: expected a capture, got an empty file in {archive.name}")
        self.kind = self._recognised(PurePath(self.path.stem))
        if self.kind in _UNPACKED_ONLY:
            raise InputError(f"{self.path}: expected a log or wire bytes, got {self.description}; unpack it")

    def _explained(self, error: Exception, source: Source) -> InputError:
        """Return the error of a reader in words."""
        if self.archive is not None and isinstance(error, DAMAGED):
            return InputError(
                f"{self.path}: {self.archive.name}, damaged or truncated at byte {source.position} of "
                f"{self.size}: {error}; get the file again, or unpack what is whole of it"
            )
        place = f", line {source.lines}" if source.lines else ""
        text = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return InputError(f"{self.path}: {self.description}{place}: cannot be read: {text}")


def _some(chunks: Iterator[bytes]) -> Iterator[bytes]:
    """Yield chunks that together are worth a call of the decoder; none at the end."""
    size = 0
    for chunk in chunks:
        yield chunk
        size += len(chunk)
        if size >= _JOINED_BYTES:
            return
