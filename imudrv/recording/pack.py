"""Compress a recording."""

from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer

from imudrv.files.atomic import atomic_write
from imudrv.recording.reader import Recording


def pack(source: Path, target: Path) -> None:
    """Write a recording again, compressed and with an index.

    Parameters
    ----------
    source : Path
        The recording.
    target : Path
        Its new file, which may be the same one; it appears complete or not at all.

    Raises
    ------
    InputError
        The recording cannot be read or is damaged, or the target cannot be written.
    """
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    with atomic_write(target) as file:
        writer = Writer(file)
        writer.start()
        for _, record in Recording(source).records():
            if isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas.get(record.schema_id, 0), record.metadata
                )
            elif isinstance(record, Attachment):
                writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message):
                writer.add_message(
                    channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
        writer.finish()  # type: ignore[no-untyped-call]
