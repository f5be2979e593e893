from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from imudrv.sinks import backlog
from imudrv.sinks.backlog import LIMIT, Backlog
from imudrv.wire.datagram import SIZE


def samples(first: int, count: int) -> bytes:
    return b"".join(n.to_bytes(4, "little").ljust(SIZE, b".") for n in range(first, first + count))


def numbers(stream: bytes) -> list[int]:
    assert len(stream) % SIZE == 0, "a datagram was torn"
    rows = [stream[at : at + SIZE] for at in range(0, len(stream), SIZE)]
    assert all(row[4:] == b"." * (SIZE - 4) for row in rows), "a datagram was torn"
    return [int.from_bytes(row[:4], "little") for row in rows]


class Consumer:
    """Takes a given number of bytes a write."""

    def __init__(self) -> None:
        self.room = 0
        self.got = bytearray()

    def write(self, data: bytes) -> int:
        taken = min(self.room, len(data))
        if taken == 0:
            raise BlockingIOError
        self.room -= taken
        self.got += data[:taken]
        return taken


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 400)), max_size=40), st.integers(1, 5))
def test_what_was_put_is_sent_dropped_or_queued_and_whole_whatever_the_consumer_takes(
    steps: list[tuple[int, int]], piece: int
) -> None:
    consumer, waiting, put = Consumer(), Backlog(piece), 0
    limit, backlog.LIMIT = backlog.LIMIT, 6
    try:
        for count, room in steps:
            consumer.room = room
            waiting.put(samples(put, count), consumer.write)
            put += count
            assert waiting.sent + waiting.dropped + waiting.queued == put
            assert waiting.sent == len(consumer.got) // SIZE
            assert waiting.queued <= 6 + 1, "six whole ones and one that is half out"
        consumer.room = 10**9
        waiting.flush(consumer.write)
    finally:
        backlog.LIMIT = limit
    got = numbers(bytes(consumer.got))
    assert waiting.queued == 0
    assert len(got) == waiting.sent == put - waiting.dropped
    assert got == sorted(set(got))


def test_the_oldest_are_dropped() -> None:
    waiting, consumer = Backlog(1), Consumer()
    waiting.put(samples(0, LIMIT + 5), consumer.write)
    assert (waiting.dropped, waiting.queued) == (5, LIMIT)
    consumer.room = 10**9
    waiting.flush(consumer.write)
    assert numbers(bytes(consumer.got)) == list(range(5, LIMIT + 5))


def test_no_write_is_larger_than_a_piece() -> None:
    sizes: list[int] = []
    write: Callable[[bytes], int] = lambda data: sizes.append(len(data)) or len(data)  # noqa: E731
    Backlog(18).put(samples(0, 40), write)
    assert sizes == [18 * SIZE, 18 * SIZE, 4 * SIZE]


def test_a_consumer_that_is_gone_loses_what_was_queued() -> None:
    waiting, consumer = Backlog(1), Consumer()
    consumer.room = 10
    waiting.put(samples(0, 3), consumer.write)
    assert waiting.queued == 3, "one of them is half out"
    waiting.abandon()
    assert (waiting.sent, waiting.dropped, waiting.queued) == (0, 3, 0)
