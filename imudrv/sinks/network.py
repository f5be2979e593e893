"""Datagrams over the network: UDP to one receiver, TCP to every client."""

import errno
import os
import select
import socket
import time
from typing import Any, Final, TypeAlias

from imudrv.errors import InputError
from imudrv.loopback import LOOPBACK
from imudrv.sinks.backlog import Backlog
from imudrv.sinks.base import HOUSEKEEPING_NS, Batch, Outlet, Sink, SinkState, Written
from imudrv.url import host_and_port, split
from imudrv.wire.datagram import SIZE
from imudrv.wording import counted

MAX_CLIENTS: Final = 32
STALLED_S: Final = 5.0
"""Time after which a client that takes nothing loses its place."""
_UDP_PIECE: Final = 18  # 1368 bytes: with its headers within an Ethernet frame
_TCP_PIECE: Final = 256
_RETRY_S: Final = 0.5
_REFUSED_S: Final = 2.0  # hosts report a closed port at most once a second
_CLOSE_S: Final = 1.0

_Resolved: TypeAlias = tuple[socket.AddressFamily, tuple[Any, ...]]


class UdpSink(Sink):
    """UDP to one receiver, or to a broadcast or multicast address.

    If no program listens, the host of the receiver reports this when the next packet is sent; that packet is
    sent again, so that nothing is lost from the moment the receiver listens.

    Parameters
    ----------
    url : str
        ``udp://HOST:PORT``.

    Raises
    ------
    InputError
        The address is not valid.
    """

    patience_ns = HOUSEKEEPING_NS

    def __init__(self, url: str) -> None:
        super().__init__(url)
        family, self._address = _resolve(url, None, socket.SOCK_DGRAM)
        self._backlog = Backlog(_UDP_PIECE)
        self._trouble = ""
        self._refused_until = 0.0
        self._last = 0  # samples of the packet before
        self._is_connected = False
        self._retry_at = 0.0
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.poll()

    def publish(self, batch: Batch) -> None:
        """Send a batch."""
        if not self._is_connected:
            self._backlog.dropped += len(batch.datagrams) // SIZE
            return
        try:
            self._backlog.put(batch.datagrams, self._send)
        except OSError as error:
            self._lost(error)

    def outlets(self) -> list[Outlet]:
        """See `Sink.outlets`."""
        is_free = self._is_connected and not self._backlog.queued
        return [Outlet(self._socket.fileno(), _UDP_PIECE * SIZE)] if is_free else []

    def written(self, batch: Batch, outlets: list[Written]) -> None:
        """See `Sink.written`."""
        if not outlets:
            self.publish(batch)
            return
        size, last, error = outlets[0]
        self._backlog.written(batch.datagrams, size)
        if size:
            self._trouble = ""
            self._last = last // SIZE
        if error == errno.ECONNREFUSED:
            self._refused()
        elif error not in (0, errno.EAGAIN):
            self._lost(OSError(error, os.strerror(error)))
        if self._backlog.queued:
            self.poll()

    def poll(self) -> None:
        """Send what is queued; try to connect again."""
        try:
            if self._is_connected:
                self._backlog.flush(self._send)
            elif time.monotonic() >= self._retry_at:
                self._retry_at = time.monotonic() + _RETRY_S
                self._socket.connect(self._address)
                self._is_connected = True
                self._trouble = ""
        except OSError as error:
            self._lost(error)

    @property
    def state(self) -> SinkState:
        """Current state."""
        refused = "nobody listens" if time.monotonic() < self._refused_until else ""
        trouble = self._trouble or refused
        counts = self._backlog
        return SinkState(self.url, trouble or "ok", not trouble, counts.sent, counts.dropped, counts.queued)

    def close(self) -> None:
        """Send what is queued for at most a second, and close."""
        deadline = time.monotonic() + _CLOSE_S
        while self._backlog.queued and (left := deadline - time.monotonic()) > 0:
            select.select([], [self._socket], [], left)
            self.poll()
        self._backlog.abandon()
        self._socket.close()

    def _send(self, packet: bytes) -> int:
        try:
            written = self._socket.send(packet)
        except ConnectionRefusedError:
            self._refused()
            written = self._socket.send(packet)
        self._trouble = ""
        self._last = written // SIZE
        return written

    def _refused(self) -> None:
        """Count the packet before as dropped: nobody has received it."""
        self._refused_until = time.monotonic() + _REFUSED_S
        self._backlog.sent -= self._last
        self._backlog.dropped += self._last
        self._last = 0

    def _lost(self, error: OSError) -> None:
        """Report a lost connection and drop the queue, which would arrive too late."""
        self._trouble = (error.strerror or str(error)).lower()
        self._backlog.abandon()


class _Client:
    """Client, with its queue."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self.backlog = Backlog(_TCP_PIECE)
        self._sent, self._since = 0, time.monotonic()

    def put(self, datagrams: bytes) -> bool:
        """Send datagrams; return whether the client is still connected."""
        try:
            self.backlog.put(datagrams, self.connection.send)
        except OSError:
            return False
        return True

    def service(self) -> bool:
        """Send what is queued and discard what the client sends; return whether it is still connected."""
        try:
            self.backlog.flush(self.connection.send)
            return self.connection.recv(1 << 16) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    def has_stalled(self) -> bool:
        """Whether samples have waited for `STALLED_S` without any being taken; call it after `service`."""
        now = time.monotonic()
        if self.backlog.sent != self._sent or not self.backlog.queued:
            self._sent, self._since = self.backlog.sent, now
        return now - self._since >= STALLED_S


class TcpSink(Sink):
    """TCP server; each client has its own queue, and one that stops reading loses only its own samples.

    A client that shuts down its sending side counts as disconnected. One that takes nothing for `STALLED_S`
    is disconnected and counted.

    Parameters
    ----------
    url : str
        ``tcp://HOST:PORT``; without a host only this machine is served (127.0.0.1); port 0 takes a free one,
        given in the state.

    Raises
    ------
    InputError
        The address is not valid or cannot be used.
    """

    patience_ns = HOUSEKEEPING_NS

    def __init__(self, url: str) -> None:
        super().__init__(url)
        family, address = _resolve(url, LOOPBACK, socket.SOCK_STREAM)
        self._clients: list[_Client] = []
        self._free: list[_Client] = []  # those that were outlets
        self._sent = self._dropped = 0  # of disconnected clients
        self._stalled = 0  # clients
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind(address)
            self._listener.listen(MAX_CLIENTS)
        except OSError as error:
            self._listener.close()
            raise InputError(
                f"{url}: expected an address of this machine and a free port, "
                f"got: {error.strerror or error}; choose another one"
            ) from error
        self._listener.setblocking(False)
        host, port = self._listener.getsockname()[:2]
        self._where = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def outlets(self) -> list[Outlet]:
        """See `Sink.outlets`; a client with a queue is none."""
        self._free = [client for client in self._clients if not client.backlog.queued]
        return [Outlet(client.connection.fileno(), _TCP_PIECE * SIZE) for client in self._free]

    def written(self, batch: Batch, outlets: list[Written]) -> None:
        """See `Sink.written`."""
        for client, (size, _, error) in zip(self._free, outlets, strict=True):
            client.backlog.written(batch.datagrams, size)
            if error not in (0, errno.EAGAIN):
                self._remove(client)
        for client in [client for client in self._clients if client not in self._free]:
            if not client.put(batch.datagrams):
                self._remove(client)

    def publish(self, batch: Batch) -> None:
        """Send a batch."""
        for client in [client for client in self._clients if not client.put(batch.datagrams)]:
            self._remove(client)

    def poll(self) -> None:
        """Accept new clients, remove disconnected ones, send what is queued."""
        for client in list(self._clients):
            if not client.service():
                self._remove(client)
            elif client.has_stalled():
                self._stalled += 1
                self._remove(client)
        for _ in range(MAX_CLIENTS):
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            if len(self._clients) < MAX_CLIENTS:
                self._clients.append(_Client(connection))
            else:
                connection.close()

    @property
    def state(self) -> SinkState:
        """Current state."""
        count = len(self._clients)
        clients = counted(count, "client") if count else "waiting for a client"
        stalled = f"; {self._stalled} disconnected that took nothing for {STALLED_S:g} s"
        counts = [client.backlog for client in self._clients]
        return SinkState(
            self.url,
            f"{clients} on {self._where}{stalled if self._stalled else ''}",
            True,
            self._sent + sum(c.sent for c in counts),
            self._dropped + sum(c.dropped for c in counts),
            sum(c.queued for c in counts),
        )

    def close(self) -> None:
        """Send what is queued for at most a second, and close."""
        self._listener.close()
        deadline = time.monotonic() + _CLOSE_S
        while waiting := [client for client in self._clients if client.backlog.queued]:
            left = deadline - time.monotonic()
            if left <= 0:
                break
            _, ready, _ = select.select([], [client.connection for client in waiting], [], left)
            for client in waiting:
                if client.connection in ready and not client.service():
                    self._remove(client)
        for client in list(self._clients):
            self._remove(client)

    def _remove(self, client: _Client) -> None:
        client.backlog.abandon()
        client.connection.close()
        self._clients.remove(client)
        self._sent += client.backlog.sent
        self._dropped += client.backlog.dropped


def _resolve(url: str, default_host: str | None, kind: socket.SocketKind) -> _Resolved:
    """Return the address of a URL; without a default the host must be given."""
    host, port = host_and_port(split(url, ("udp", "tcp")), default_host)
    try:
        found = socket.getaddrinfo(host, port, type=kind)
    except OSError as error:
        raise InputError(
            f"{url}: expected a known host, got {host!r}: {error.strerror or error}; "
            "check the name or give a numeric address"
        ) from error
    family, _, _, _, address = found[0]
    return family, address
