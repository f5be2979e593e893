"""Samples at the other end, over real sockets and a real line."""

import os
import pty
import socket
import threading
import tty
from collections.abc import Iterator

import numpy as np
import pytest
from realtime import DEADLINE_S, free_port

from imudrv.errors import InputError
from imudrv.ports.base import PortLostError
from imudrv.receiver import Receiver, receive
from imudrv.records import INCREMENTS, Records, Source
from imudrv.wire.datagram import SIZE, encode


def increments(count: int, first: int = 0) -> Records:
    rng = np.random.default_rng(first)
    rows = np.zeros(count, INCREMENTS)
    rows["counter"] = (first + np.arange(count)) % 2**32
    rows["interval_ns"] = 1_000_000
    rows["t_ns"] = 1_700_000_000_000_000_000 + 1_000_000 * rows["counter"]
    rows["dtheta_b"] = rng.normal(size=(count, 3)) * 1e-6
    rows["dv_b"] = rng.normal(size=(count, 3)) * 1e-2
    rows["flags"] = 0x41
    return rows


def datagrams(rows: Records) -> bytes:
    return encode(rows, Source.SIMULATOR)


def take(receiver: Receiver, count: int) -> Records:
    got: list[Records] = []
    while sum(map(len, got)) < count:
        got.append(next(receiver))
    return np.concatenate(got)


class Udp:
    """A receiver and its sender."""

    def __init__(self, sender: socket.socket) -> None:
        self.address = "127.0.0.1", free_port()
        self._sender = sender
        self.receiver = receive(f"udp://:{self.address[1]}", timeout_s=DEADLINE_S)

    def send(self, packet: bytes) -> None:
        self._sender.sendto(packet, self.address)


@pytest.fixture
def udp() -> Iterator[Udp]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        udp = Udp(sender)
        with udp.receiver:
            yield udp


def test_udp_brings_every_sample_bit_for_bit(udp: Udp) -> None:
    sent = increments(100)
    for k in range(60):
        udp.send(datagrams(sent[k : k + 1]))
    udp.send(datagrams(sent[60:72]))
    udp.send(datagrams(sent[72:100]))
    np.testing.assert_array_equal(take(udp.receiver, 100), sent)
    assert udp.receiver.counts.lost == 0
    assert udp.receiver.rejected_bytes == 0


def test_what_is_missing_is_counted_across_the_wrap_of_the_counter(udp: Udp) -> None:
    sent = increments(10, first=2**32 - 5)
    kept = np.delete(sent, [3, 4, 5, 8])
    udp.send(datagrams(kept))
    np.testing.assert_array_equal(take(udp.receiver, 6), kept)
    assert udp.receiver.counts.lost == 4
    assert udp.receiver.counts.closes


def test_duplicate_and_late_samples_are_dropped_and_counted(udp: Udp) -> None:
    sent = increments(8)
    for k in (0, 1, 1, 4, 3, 5, 0, 6, 7):
        udp.send(datagrams(sent[k : k + 1]))
    assert take(udp.receiver, 6)["counter"].tolist() == [0, 1, 4, 5, 6, 7]
    counts = udp.receiver.counts
    assert (counts.duplicate, counts.out_of_order, counts.missing, udp.receiver.counts.lost) == (2, 1, 1, 2)


def test_a_restart_of_the_driver_loses_nothing(udp: Udp) -> None:
    udp.send(datagrams(increments(3, first=5_000)))
    udp.send(datagrams(increments(3)))
    assert take(udp.receiver, 6)["counter"].tolist() == [5_000, 5_001, 5_002, 0, 1, 2]
    assert udp.receiver.counts.lost == 0
    assert udp.receiver.counts.restarts == 1


def test_packets_that_are_no_datagrams_are_rejected_and_counted(udp: Udp) -> None:
    sent = increments(2)
    packet = datagrams(sent)
    for junk in (b"", b"I50N", packet[:40], b"hello", bytes(2000), packet[:SIZE][::-1]):
        udp.send(junk)
    damaged = bytearray(packet)
    damaged[SIZE + 30] ^= 1
    udp.send(bytes(damaged))
    udp.send(packet[SIZE:])
    np.testing.assert_array_equal(take(udp.receiver, 2), sent)
    junk_bytes = 4 + 40 + 5 + 2000 + SIZE + SIZE
    assert udp.receiver.rejected_bytes == junk_bytes


def test_udp_listens_on_the_loopback_by_default(udp: Udp) -> None:
    with pytest.raises(PortLostError, match=r"cannot listen \(Address already in use\)"):
        receive(f"udp://127.0.0.1:{udp.address[1]}")


def test_a_timeout_ends_the_iteration() -> None:
    with receive("udp://127.0.0.1:0", timeout_s=0.01) as receiver:
        assert list(receiver) == []


def test_tcp_brings_every_sample_in_any_pieces_until_the_other_end_closes() -> None:
    sent = increments(500)
    wire = datagrams(sent)

    def serve(server: socket.socket) -> None:
        with server.accept()[0] as connection:
            for k in range(0, len(wire), 1001):
                connection.sendall(wire[k : k + 1001])

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=serve, args=(server,))
        thread.start()
        with receive(f"tcp://127.0.0.1:{server.getsockname()[1]}", timeout_s=DEADLINE_S) as receiver:
            got = np.concatenate(list(receiver))
            assert list(receiver) == []
        thread.join()
    np.testing.assert_array_equal(got, sent)
    assert receiver.counts.lost == 0


def test_a_serial_line_brings_every_sample_until_it_is_unplugged() -> None:
    sent = increments(20)
    unit, line = pty.openpty()
    tty.setraw(line)
    with receive(f"serial://{os.ttyname(line)}?baudrate=460800", timeout_s=DEADLINE_S) as receiver:
        os.close(line)
        os.write(unit, b"noise" + datagrams(sent))
        np.testing.assert_array_equal(take(receiver, 20), sent)
        os.close(unit)
        assert list(receiver) == []
    assert receiver.rejected_bytes == 5


@pytest.mark.parametrize(
    "url",
    [
        "udp://127.0.0.1",
        "udp://127.0.0.1:port",
        "udp://127.0.0.1:70000",
        "udp://127.0.0.1:5005/there",
        "udp://127.0.0.1:5005?a=b",
        "tcp://",
        "http://127.0.0.1:80",
        "serial://",
        "serial:///dev/null?baudrate=quick",
        "serial:///dev/null?colour=red",
        "5005",
    ],
)
def test_a_wrong_url_is_reported(url: str) -> None:
    with pytest.raises(InputError, match=rf"^{url.replace('?', '[?]')}: (expected .*://|1 fault)"):
        receive(url)


def test_without_a_driver_the_message_says_what_to_do() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(
        PortLostError, match=f"^tcp://127.0.0.1:{port}: cannot connect; is the driver running"
    ):
        receive(f"tcp://127.0.0.1:{port}")
    with pytest.raises(PortLostError, match="there is no /dev/not-there"):
        receive("serial:///dev/not-there")
