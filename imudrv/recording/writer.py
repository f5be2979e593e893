"""Writers of MCAP files (https://mcap.dev/spec) whose messages come encoded.

Records are those of the library. Its own writer takes 4 us a message, during which the live loop cannot run;
here many messages are encoded at once.
"""

import struct
import zlib
from collections.abc import Sequence
from importlib.metadata import version
from typing import IO, Final

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from imudrv.recording.format import with_heads

CHUNK_BYTES: Final = 1 << 20
"""About the size of a chunk before compression."""

_MESSAGE: Final = struct.Struct("<BQHIQQ")
_BODY: Final = _MESSAGE.size - 9
_FOOTER: Final = struct.Struct("<BQQQ")
_INDEX: Final = struct.Struct("<BQHI")
_ENTRY: Final = np.dtype([("t_ns", "<u8"), ("offset", "<u8")])
_SUMMARY: Final = (Schema, Channel, Statistics, ChunkIndex, AttachmentIndex, MetadataIndex)
"""Groups of the summary, in this order."""


class McapWriter:
    """Writer without chunks, so that what is written is readable at once.

    Parameters
    ----------
    file : binary file
        To write to, from its beginning.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._position = 0
        self._definitions: list[Schema | Channel] = []
        self._indexes: list[ChunkIndex | AttachmentIndex | MetadataIndex] = []
        self._sequences: dict[int, int] = {}  # number of messages, by channel
        self._first_ns, self._last_ns = 1 << 64, 0
        self._put(MCAP0_MAGIC + _encoded(Header("", f"imu50 {version('imu50')}")))

    def define(self, record: Schema | Channel) -> None:
        """Write a schema, or a channel after its schema; their numbers are not 0."""
        self._definitions.append(record)
        if isinstance(record, Channel):
            self._sequences[record.id] = 0
        self._put(_encoded(record))

    def attach(self, attachment: Attachment) -> None:
        """Write an attachment."""
        a, begin = attachment, self._position
        length = self._put(_encoded(a))
        self._indexes.append(
            AttachmentIndex(begin, length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
        )

    def add_metadata(self, metadata: Metadata) -> None:
        """Write a metadata record."""
        begin = self._position
        self._indexes.append(MetadataIndex(begin, self._put(_encoded(metadata)), metadata.name))

    def message(self, channel: int, t_ns: int, data: bytes) -> None:
        """Write a message.

        Parameters
        ----------
        channel : int
            Number of a defined channel.
        t_ns : int
            Its time, for both times of the format.
        data : bytes
            As the channel encodes it.
        """
        sequence = self._count(channel, 1, t_ns, t_ns)
        head = _MESSAGE.pack(Opcode.MESSAGE, _BODY + len(data), channel, sequence & 0xFFFFFFFF, t_ns, t_ns)
        self._add(head + data, channel, (t_ns,), (0,))

    def messages(
        self, channel: int, times: NDArray[np.int64], data: NDArray[np.uint8], ends: NDArray[np.int64]
    ) -> None:
        """Write messages.

        Parameters
        ----------
        channel : int
            Number of a defined channel.
        times : ndarray of int64, shape (n,)
            Time of each.
        data : ndarray of uint8
            Data of all, one behind the other.
        ends : ndarray of int64, shape (n,)
            Where the data of each ends.
        """
        count = len(times)
        if not count:
            return
        sequence = self._count(channel, count, int(times.min()), int(times.max()))
        heads, sizes = np.zeros(count, _HEAD), np.diff(ends, prepend=0)
        heads["opcode"], heads["length"], heads["channel"] = Opcode.MESSAGE, _BODY + sizes, channel
        heads["sequence"] = (sequence + np.arange(count)) & 0xFFFFFFFF
        heads["log_time"] = heads["publish_time"] = times
        records, record_ends = with_heads(heads.view(np.uint8).reshape(count, -1), data, ends)
        begins = record_ends - sizes - heads.itemsize
        self._add(records.tobytes(), channel, times.tolist(), begins.tolist())

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self._put(_encoded(DataEnd(0)))
        begin = self._position
        summary, offsets = b"", b""
        for kind in _SUMMARY:
            group = b"".join(_encoded(record) for record in self._summarised() if isinstance(record, kind))
            if group:
                offsets += _encoded(SummaryOffset(group[0], begin + len(summary), len(group)))
            summary += group
        places = begin, begin + len(summary)
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, *places), zlib.crc32(summary + offsets))
        self._put(summary + offsets + _encoded(Footer(*places, crc)) + MCAP0_MAGIC)

    def _summarised(self) -> list[McapRecord]:
        kinds = [type(record) for record in (*self._definitions, *self._indexes)]
        counts = self._sequences
        statistics = Statistics(
            attachment_count=kinds.count(AttachmentIndex),
            channel_count=kinds.count(Channel),
            channel_message_counts={channel: count for channel, count in counts.items() if count},
            chunk_count=kinds.count(ChunkIndex),
            message_count=sum(counts.values()),
            message_end_time=self._last_ns,
            message_start_time=min(self._first_ns, self._last_ns),
            metadata_count=kinds.count(MetadataIndex),
            schema_count=kinds.count(Schema),
        )
        return [*self._definitions, *self._indexes, statistics]

    def _count(self, channel: int, count: int, first_ns: int, last_ns: int) -> int:
        """Count messages and note their times; return the number of the first one."""
        sequence = self._sequences[channel]
        self._sequences[channel] = sequence + count
        if last_ns > self._last_ns:  # nearly always
            self._last_ns = last_ns
        if first_ns < self._first_ns:
            self._first_ns = first_ns
        return sequence

    def _add(self, records: bytes, channel: int, times: Sequence[int], begins: Sequence[int]) -> None:
        """Write messages, whose records begin there."""
        self._put(records)

    def _put(self, data: bytes) -> int:
        self._file.write(data)
        self._position += len(data)
        return len(data)


class ChunkedWriter(McapWriter):
    """Writer of compressed chunks with an index of their messages; see `McapWriter`."""

    def __init__(self, file: IO[bytes]) -> None:
        super().__init__(file)
        self._pieces: list[bytes] = []
        self._size = 0
        self._entries: dict[int, list[tuple[int, int]]] = {}  # time and place of each message, by channel
        self._compressor = zstandard.ZstdCompressor()

    def finish(self) -> None:
        """See `McapWriter.finish`."""
        self._finish_chunk()
        super().finish()

    def _add(self, records: bytes, channel: int, times: Sequence[int], begins: Sequence[int]) -> None:
        places = [self._size + begin for begin in begins]
        self._entries.setdefault(channel, []).extend(zip(times, places, strict=True))
        self._pieces.append(records)
        self._size += len(records)
        if self._size >= CHUNK_BYTES:
            self._finish_chunk()

    def _finish_chunk(self) -> None:
        if not self._size:
            return
        data, begin = b"".join(self._pieces), self._position
        indexes = {channel: np.array(entries, _ENTRY) for channel, entries in self._entries.items()}
        first = min(int(entries["t_ns"].min()) for entries in indexes.values())
        last = max(int(entries["t_ns"].max()) for entries in indexes.values())
        packed = self._compressor.compress(data)
        length = self._put(_encoded(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data))))
        places, index_begin = {}, self._position
        for channel, entries in indexes.items():
            places[channel] = self._position
            ordered = entries[np.argsort(entries["t_ns"], kind="stable")].tobytes()
            self._put(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(ordered), channel, len(ordered)) + ordered)
        self._indexes.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=begin,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=last,
                message_index_length=self._position - index_begin,
                message_index_offsets=places,
                message_start_time=first,
                uncompressed_size=len(data),
            )
        )
        self._pieces, self._size, self._entries = [], 0, {}


_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""Beginning of a message's record."""


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
