import errno
import os
import select
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from realtime import DEADLINE_S

from imudrv.errors import InputError
from imudrv.sinks import network
from imudrv.sinks.backlog import LIMIT
from imudrv.sinks.base import Written
from imudrv.sinks.network import MAX_CLIENTS, TcpSink, UdpSink
from imudrv.wire.datagram import SIZE, DatagramDecoder


def receiver() -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind(("127.0.0.1", 0))
    udp.settimeout(DEADLINE_S)
    return udp


def port_of(sink: TcpSink) -> int:
    return int(sink.state.state.rpartition(":")[2])


def clients_of(sink: TcpSink) -> int:
    first = sink.state.state.split()[0]
    return 0 if first == "waiting" else int(first)


def connect(sink: TcpSink, wait_for, receive_buffer: int | None = None) -> socket.socket:
    before = clients_of(sink)
    client = socket.socket()
    if receive_buffer is not None:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    client.settimeout(DEADLINE_S)
    client.connect(("127.0.0.1", port_of(sink)))
    wait_for(lambda: sink.poll() or clients_of(sink) > before)
    return client


def read(client: socket.socket, samples: int) -> bytes:
    data = b""
    while len(data) < samples * SIZE:
        piece = client.recv(samples * SIZE - len(data))
        assert piece, "the sink hung up"
        data += piece
    return data


def take(client: socket.socket, got: bytearray) -> int:
    """Append what has arrived; the number of bytes so far."""
    while select.select([client], [], [], 0)[0]:
        piece = client.recv(1 << 20)
        assert piece, "the sink hung up"
        got += piece
    return len(got)


def counters(data: bytes) -> list[int]:
    received = DatagramDecoder().feed(data)
    assert received.rejects.size == 0
    assert len(received.increments) * SIZE == len(data)
    return received.increments["counter"].tolist()


@pytest.fixture
def tcp() -> Iterator[TcpSink]:
    sink = TcpSink("tcp://:0")
    yield sink
    sink.close()


def test_udp_brings_every_sample_in_order_in_packets_that_no_network_splits(batch) -> None:
    with receiver() as udp:
        sink = UdpSink(f"udp://127.0.0.1:{udp.getsockname()[1]}")
        for first in range(10):
            sink.publish(batch(first, 1))
        late = batch(10, 50)
        sink.publish(late)
        packets = [udp.recv(65536) for _ in range(13)]
        assert counters(b"".join(packets)) == list(range(60))
        assert [len(packet) // SIZE for packet in packets] == [1] * 10 + [18, 18, 14]
        assert max(map(len, packets)) < 1400
        assert b"".join(packets[10:]) == late.datagrams
        assert sink.state[1:] == ("ok", True, 60, 0, 0)
        sink.close()


def test_nothing_is_lost_once_a_udp_receiver_listens(batch, monkeypatch) -> None:
    monkeypatch.setattr(network, "_REFUSED_S", DEADLINE_S)
    with receiver() as udp:
        port = udp.getsockname()[1]
    sink = UdpSink(f"udp://127.0.0.1:{port}")
    for n in range(100):
        sink.publish(batch(n, 1))
    state = sink.state
    assert (state.state, state.healthy) == ("nobody listens", False)
    assert state.sent + state.dropped == 100
    assert state.sent <= 1, "nothing has been received of the last one yet"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", port))
        udp.settimeout(DEADLINE_S)
        for n in range(100, 120):
            sink.publish(batch(n, 1))
        assert counters(b"".join(udp.recv(65536) for _ in range(20))) == list(range(100, 120))
    assert sink.state.sent == 20
    assert sink.state.dropped == 100
    sink.close()


def test_an_unreachable_network_is_reported_and_only_loses_samples(batch, wait_for, monkeypatch) -> None:
    def unreachable(self: socket.socket, address: object) -> None:
        raise OSError(101, "Network is unreachable")

    with receiver() as udp:
        with monkeypatch.context() as patch:
            patch.setattr(socket.socket, "connect", unreachable)
            sink = UdpSink(f"udp://127.0.0.1:{udp.getsockname()[1]}")
            sink.publish(batch(0, 5))
            assert sink.state[1:] == ("network is unreachable", False, 0, 5, 0)
        wait_for(lambda: sink.poll() or sink.state.state == "ok")
        sink.publish(batch(5, 1))
        assert counters(udp.recv(65536)) == [5]
        sink.close()


@pytest.mark.parametrize(
    "url", ["udp://", "udp://host", "udp://127.0.0.1:99999", "udp://:5000", "udp://h:1/x"]
)
def test_an_invalid_udp_address_is_refused(url: str) -> None:
    with pytest.raises(InputError, match="expected udp://HOST:PORT"):
        UdpSink(url)


def test_an_unknown_host_is_refused() -> None:
    with pytest.raises(InputError, match=r"no-such-host\.invalid.*check the name"):
        UdpSink("udp://no-such-host.invalid:5000")


def test_tcp_serves_only_this_machine_by_default(tcp: TcpSink) -> None:
    assert tcp.state.state.startswith("waiting for a client on 127.0.0.1:")
    assert tcp.state.healthy
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port_of(tcp)), timeout=DEADLINE_S)


def test_a_tcp_client_gets_every_sample_from_its_connection_on(tcp: TcpSink, batch, wait_for) -> None:
    tcp.publish(batch(0, 1))
    with connect(tcp, wait_for) as one:
        tcp.publish(batch(1, 1))
        with connect(tcp, wait_for) as two:
            assert tcp.state.state.startswith("2 clients on")
            tcp.publish(batch(2, 100))
            assert counters(read(one, 101)) == list(range(1, 102))
            assert counters(read(two, 100)) == list(range(2, 102))
    assert tcp.state[3:] == (201, 0, 0)


def test_a_tcp_client_that_stops_reading_loses_only_its_own_oldest_samples(
    tcp: TcpSink, batch, wait_for, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network, "STALLED_S", 3600.0)
    with connect(tcp, wait_for, receive_buffer=1 << 16) as stuck, connect(tcp, wait_for) as good:
        got, rest = bytearray(), bytearray()
        samples = 0
        while tcp.state.dropped < LIMIT:  # whatever the buffers of the system hold
            tcp.publish(batch(samples, 100))
            samples += 100
            wait_for(lambda sent=samples: tcp.poll() or take(good, got) == sent * SIZE)
            assert samples < 1_000_000, "the queue has no bound"
        assert counters(bytes(got)) == list(range(samples))
        state = tcp.state
        assert state.queued <= LIMIT + 1, "one may be half out"
        assert state.sent + state.dropped + state.queued == 2 * samples
        # It reads again: what it has missed is a gap between whole datagrams, the newest are all there.
        wait_for(lambda: tcp.poll() or take(stuck, rest) == (samples - state.dropped) * SIZE)
        numbers = counters(bytes(rest))
        assert numbers[-LIMIT:] == list(range(samples - LIMIT, samples))
        assert np.all(np.diff(numbers) > 0)
    assert tcp.state.queued == 0


def test_tcp_clients_connect_and_disconnect_and_their_input_is_ignored(tcp: TcpSink, batch, wait_for) -> None:
    for n in range(5):
        with connect(tcp, wait_for) as client:
            client.sendall(b"GET / HTTP/1.0\r\n\r\n" * 1000)
            tcp.poll()
            tcp.publish(batch(n, 1))
            assert counters(read(client, 1)) == [n]
        wait_for(lambda: tcp.poll() or not clients_of(tcp))
    assert tcp.state.sent == 5
    assert tcp.state.state.startswith("waiting for a client")


def test_a_killed_tcp_client_is_detected_by_writing(tcp: TcpSink, batch, wait_for) -> None:
    client = connect(tcp, wait_for)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # close with a reset
    client.close()
    wait_for(lambda: tcp.publish(batch(0, 1)) or not clients_of(tcp))


def test_tcp_clients_that_take_nothing_lose_their_places_and_are_counted(
    tcp: TcpSink, batch, wait_for, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network, "STALLED_S", 0.2)
    port = port_of(tcp)
    stuck = [connect(tcp, wait_for, receive_buffer=1 << 12) for _ in range(MAX_CLIENTS - 1)]
    got, samples = bytearray(), 0
    with connect(tcp, wait_for) as good:
        while clients_of(tcp) > 1:
            tcp.publish(batch(samples, 500))
            samples += 500
            wait_for(lambda sent=samples: tcp.poll() or take(good, got) == sent * SIZE)
        assert counters(bytes(got)) == list(range(samples))
        assert f"; {MAX_CLIENTS - 1} disconnected that took nothing" in tcp.state.state
        with socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as late:
            wait_for(lambda: tcp.poll() or clients_of(tcp) == 2)
            tcp.publish(batch(samples, 1))
            assert counters(read(late, 1)) == [samples]
    for client in stuck:
        client.close()


def test_tcp_clients_beyond_the_maximum_are_refused(tcp: TcpSink, wait_for) -> None:
    clients = [connect(tcp, wait_for) for _ in range(MAX_CLIENTS)]
    with socket.create_connection(("127.0.0.1", port_of(tcp)), timeout=DEADLINE_S) as late:
        tcp.poll()
        assert late.recv(1) == b""
    assert tcp.state.state.startswith(f"{MAX_CLIENTS} clients")
    for client in clients:
        client.close()


def test_closing_a_tcp_sink_sends_what_is_queued(batch, wait_for, monkeypatch) -> None:
    monkeypatch.setattr(network, "_CLOSE_S", DEADLINE_S)  # however slowly the client reads
    sink = TcpSink("tcp://127.0.0.1:0")
    with connect(sink, wait_for, receive_buffer=1 << 16) as client, ThreadPoolExecutor() as pool:
        put = 0
        while sink.state.queued == 0:
            sink.publish(batch(put, 100))
            put += 100
        data = pool.submit(read, client, put)
        sink.close()
        assert counters(data.result(DEADLINE_S)) == list(range(put))
        assert client.recv(1) == b""
    assert sink.state[3:] == (put, 0, 0)


def test_a_port_in_use_is_refused_before_the_start(tcp: TcpSink) -> None:
    with pytest.raises(InputError, match="expected an address of this machine and a free port"):
        TcpSink(f"tcp://127.0.0.1:{port_of(tcp)}")


def test_a_host_given_is_the_one_that_is_served() -> None:
    sink = TcpSink("tcp://0.0.0.0:0")
    assert "on 0.0.0.0:" in sink.state.state
    sink.close()
    with pytest.raises(InputError, match="expected an address of this machine"):
        TcpSink("tcp://192.0.2.1:0")


# What outlets have taken without the sink


def test_a_udp_packet_that_was_refused_is_sent_again_and_the_one_before_counts_as_dropped(batch) -> None:
    with receiver() as udp:
        sink = UdpSink(f"udp://127.0.0.1:{udp.getsockname()[1]}")
        (outlet,) = sink.outlets()
        datagrams = batch(0, 30).datagrams
        packets = [datagrams[: outlet.piece], datagrams[outlet.piece :]]
        sink.written(batch(0, 30), [Written(outlet.piece, outlet.piece, errno.ECONNREFUSED)])
        assert udp.recv(65536) == packets[1]
        first = outlet.piece // SIZE
        assert (sink.state.sent, sink.state.dropped, sink.state.queued) == (30 - first, first, 0)
        assert sink.state.state == "nobody listens"
        sink.close()


def test_a_tcp_client_continues_within_a_datagram_and_is_no_outlet_until_its_queue_is_empty(
    tcp, wait_for, batch
) -> None:
    with connect(tcp, wait_for) as client:
        (outlet,) = tcp.outlets()
        first, second = batch(0, 10), batch(10, 5)
        cut = 3 * SIZE + 7
        client_end = socket.socket(fileno=os.dup(outlet.fd))
        with client_end:
            assert client_end.send(first.datagrams[:cut]) == cut
        tcp.written(first, [Written(cut, cut, 0)])
        assert tcp.state.queued == 7
        assert tcp.outlets() == []
        tcp.written(second, [])
        tcp.poll()
        assert read(client, 15) == first.datagrams + second.datagrams
        assert (tcp.state.sent, tcp.state.dropped, tcp.state.queued) == (15, 0, 0)
        assert len(tcp.outlets()) == 1


def test_a_tcp_client_whose_outlet_failed_is_removed_and_its_samples_are_counted(
    tcp, wait_for, batch
) -> None:
    with connect(tcp, wait_for):
        assert len(tcp.outlets()) == 1
        tcp.written(batch(0, 4), [Written(SIZE, SIZE, errno.EPIPE)])
        assert clients_of(tcp) == 0
        assert (tcp.state.sent, tcp.state.dropped) == (1, 3)
