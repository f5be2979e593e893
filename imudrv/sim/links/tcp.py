"""TCP server."""

import select
import socket
import time
from contextlib import suppress
from typing import cast

from imudrv.errors import InputError
from imudrv.records import Records
from imudrv.sim.links.base import POLL_S, READ_BYTES, RETRY_S, TIMEOUT_S, LineOptions, SimulatedLine


class SimulatedTcpServer(SimulatedLine):
    """TCP server; every client receives all bytes sent after it connected.

    Parameters
    ----------
    options : LineOptions
        Options of every line.
    host : str
        Address to listen on.
    port : int
        TCP port; 0 takes a free one.

    Raises
    ------
    InputError
        It cannot listen on this address.
    """

    def __init__(self, options: LineOptions, host: str, port: int) -> None:
        super().__init__(options)
        self._address = (host, port)
        self._server: socket.socket | None = None
        self._clients: list[socket.socket] = []
        self.plug()
        shown = f"[{host}]" if ":" in host else host
        self._say(f"{options.name} plays on tcp://{shown}:{self._address[1]}")

    def plug(self) -> None:
        """Listen."""
        try:
            family = socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
            self._server = socket.create_server(self._address, family=family)
        except OSError as error:
            host, port = self._address
            raise InputError(f"tcp://{host}:{port}: cannot listen there: {error.strerror}") from error
        self._server.setblocking(False)
        self._address = (self._address[0], self._server.getsockname()[1])

    def wait_for_reader(self) -> None:
        """Wait for a client."""
        self._update_clients()
        while not self._clients and not self._stop.is_set():
            time.sleep(RETRY_S)
            self._update_clients()

    def send(self, data: bytes | Records) -> None:
        """Send bytes to every client."""
        self._update_clients()
        if len(data) and self._waits and self._server:
            self.wait_for_reader()
        if self._clients:
            self.sent += len(data)
        else:
            self.undelivered += len(data)
        for client in list(self._clients):
            self._send_to(client, memoryview(cast(bytes, data)))  # only CAN profiles make messages

    def _send_to(self, client: socket.socket, rest: memoryview) -> None:
        since = time.monotonic()
        reason = "disconnected"
        try:
            while rest:
                _, writable, _ = select.select([], [client], [], POLL_S)
                if writable:
                    rest = rest[client.send(rest) :]
                    since = time.monotonic()
                elif self._stop.is_set():
                    reason = "was disconnected with data unread"
                    break
                elif not self._waits and time.monotonic() - since > TIMEOUT_S:
                    reason = "reads nothing and was disconnected"
                    break
        except OSError:
            pass
        if rest:
            self.undelivered += len(rest)
            self._remove(client, reason)

    def _remove(self, client: socket.socket, reason: str) -> None:
        client.close()
        self._clients.remove(client)
        self._say(f"a client {reason}; {len(self._clients)} left")

    def _update_clients(self) -> None:
        """Accept a new client, remove those that disconnected and discard what the others sent."""
        for client in list(self._clients):
            try:
                is_gone = not client.recv(READ_BYTES)
            except BlockingIOError:
                continue
            except OSError:
                is_gone = True
            if is_gone:
                self._remove(client, "disconnected")
        if self._server is None:
            return
        with suppress(BlockingIOError, ConnectionError):
            client, _ = self._server.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients.append(client)

    def unplug(self) -> None:
        """Disconnect the clients and stop listening."""
        self.close()

    def close(self) -> None:
        """Close the server, then the clients: none that is sent away can connect again."""
        if self._server is not None:
            self._server.close()
        self._server = None
        for client in self._clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_WR)
            client.close()
        self._clients = []
