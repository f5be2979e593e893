"""Datagrams over Zenoh (https://zenoh.io), for many benches: found by name, over TLS and routers if asked.

Between Zenoh's threads and ours is a pair of sockets, so that the live loop sends to a descriptor as to any
other output, and a receiver reads one.
"""

import socket
from collections import deque
from pathlib import Path
from threading import Thread
from typing import Any, Final

from imudrv.errors import InputError
from imudrv.url import Url
from imudrv.wire.datagram import SIZE

_AT_ONCE: Final = SIZE << 9
_BUFFER: Final = 1 << 22
_JOIN_S: Final = 1.0
_MOST_ARRIVED: Final = 1 << 18  # of all units: five seconds of 50 at 1 kHz


class Publication:
    """A key that datagrams are published under; write them to `socket`, and close that to end.

    Parameters
    ----------
    url : Url
        ``zenoh://KEY``; option ``config``: a configuration file of Zenoh.

    Attributes
    ----------
    socket : socket.socket
        Not blocking.

    Raises
    ------
    InputError
        The package eclipse-zenoh is absent, or the key or the configuration is not valid.
    """

    def __init__(self, url: Url) -> None:
        zenoh = _zenoh(url)
        _require_one(url)
        self._session = _session(zenoh, url)
        try:
            self._publisher = self._session.declare_publisher(
                url.address,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                express=True,
            )
        except zenoh.ZError as error:
            self._session.close()
            raise InputError(f"{url.text}: expected a key such as imu50/BENCH/UNIT: {error}") from error
        self.socket, self._far = _pair()
        self.socket.setblocking(False)
        self._thread = Thread(target=self._run, name=f"publisher of {url.address}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish what was written, for at most a second, and close."""
        self.socket.close()
        self._thread.join(_JOIN_S)
        self._session.close()

    def _run(self) -> None:
        rest = b""
        with self._far:
            while data := self._far.recv(_AT_ONCE):
                data = rest + data
                whole = len(data) // SIZE * SIZE
                if whole:
                    self._publisher.put(data[:whole])
                rest = data[whole:]


class Subscription:
    """The datagrams of one key as a stream.

    Parameters
    ----------
    url : Url
        See `Publication`.
    """

    def __init__(self, url: Url) -> None:
        zenoh = _zenoh(url)
        _require_one(url)
        self._session = _session(zenoh, url)
        self._near, self._far = _pair()
        try:
            self._subscriber = self._session.declare_subscriber(url.address, self._take)
        except zenoh.ZError as error:
            self._session.close()
            raise InputError(f"{url.text}: expected a key such as imu50/BENCH/UNIT: {error}") from error

    def fileno(self) -> int:
        """Return the descriptor that is readable when there are data."""
        return self._near.fileno()

    def recv(self, most: int) -> bytes:
        """Return at most that many bytes."""
        return self._near.recv(most)

    def close(self) -> None:
        """Leave; the other end of the socket first, so that no thread of Zenoh waits for it."""
        self._near.close()
        self._far.close()
        self._session.close()

    def _take(self, sample: Any) -> None:
        try:
            self._far.sendall(sample.payload.to_bytes())
        except OSError:
            return  # closed


class Watch:
    """The datagrams of all units whose keys match, such as ``imu50/**``.

    Parameters
    ----------
    url : Url
        See `Publication`; the key may have wildcards.
    """

    def __init__(self, url: Url) -> None:
        zenoh = _zenoh(url)
        self._session = _session(zenoh, url)
        self._arrived: deque[tuple[str, bytes]] = deque(maxlen=_MOST_ARRIVED)
        try:
            self._subscriber = self._session.declare_subscriber(url.address, self._take)
        except zenoh.ZError as error:
            self._session.close()
            raise InputError(f"{url.text}: expected a key such as imu50/**: {error}") from error

    def take(self) -> list[tuple[str, bytes]]:
        """Return key and datagrams of what has arrived since the last call."""
        return [self._arrived.popleft() for _ in range(len(self._arrived))]

    def close(self) -> None:
        """Leave."""
        self._session.close()

    def _take(self, sample: Any) -> None:
        self._arrived.append((str(sample.key_expr), sample.payload.to_bytes()))


def _require_one(url: Url) -> None:
    if "*" in url.address:
        raise InputError(f"{url.text}: expected the key of one unit, got one for several")


def _pair() -> tuple[socket.socket, socket.socket]:
    pair = socket.socketpair()
    for one in pair:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    return pair


def _session(zenoh: Any, url: Url) -> Any:
    if unknown := sorted(set(url.options) - {"config"}):
        raise InputError(f"{url.text}: expected no option but config, got {', '.join(unknown)}")
    path = url.options.get("config")
    if path is not None and not Path(path).is_file():
        raise InputError(f"{url.text}: config: expected a file, there is none; check the path")
    try:
        return zenoh.open(zenoh.Config() if path is None else zenoh.Config.from_file(path))
    except zenoh.ZError as error:
        raise InputError(f"{url.text}: cannot be opened: {error}") from error


def _zenoh(url: Url) -> Any:
    try:
        import zenoh
    except ImportError as error:
        raise InputError(
            f"{url.text}: expected the package eclipse-zenoh: pip install imu50[zenoh]"
        ) from error
    return zenoh
