import os
from pathlib import Path

import pytest

from imudrv.files import spool
from imudrv.files.spool import AppendThread, Piece


def test_a_round_ends_with_what_was_queued_at_its_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool, "PERIOD_S", 3600)  # so that the round at the end is the only one
    pieces = [Piece(b"a", 1, True), Piece(b"b", 2, True), Piece(b"c", 3, False), Piece(b"d", 4, False)]
    writer = AppendThread(tmp_path / "file", b"head", lambda: pieces.pop(0), lambda: b"end")
    writer.close()
    assert (tmp_path / "file").read_bytes() == b"headabcend"
    assert writer.sent == 6
    assert len(pieces) == 1


def test_the_disk_keeps_what_was_written_as_often_as_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wait_for
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(spool.os, "fsync", lambda fd: synced.append(os.fstat(fd).st_size))
    writer = AppendThread(tmp_path / "file", b"head", lambda: Piece(b"", 0, False), sync_s=0.01)
    wait_for(lambda: len(synced) > 2)
    writer.close()
    assert synced[0] == len(b"head")
    synced.clear()
    AppendThread(tmp_path / "other", b"head", lambda: Piece(b"", 0, False)).close()
    assert not synced
