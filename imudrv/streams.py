"""Samples, status and events over Zenoh (https://zenoh.io), for many benches.

A unit has three keys: ``KEY`` for the datagrams, ``KEY/status`` and ``KEY/events`` for JSON documents.
Sessions listen on the loopback and find those of this computer; a configuration file of Zenoh connects
others.

Between Zenoh's threads and ours is a pair of sockets, so that the live loop sends to a descriptor as to any
other output, and a receiver reads one.
"""

import json
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, Final, NamedTuple

from imudrv.errors import InputError
from imudrv.loopback import LOOPBACK
from imudrv.url import Url
from imudrv.wire.datagram import SIZE

STATUS: Final = "status"
EVENTS: Final = "events"
"""Last part of the keys beside that of the datagrams."""

_AT_ONCE: Final = SIZE << 9
_BUFFER: Final = 1 << 22
_JOIN_S: Final = 1.0
_WAIT_S: Final = 1.0
"""Longest that a publisher waits for a subscriber whose queues are full; it loses what comes after that. At
1 kHz the queues of the system hold minutes: only a replay at full speed waits at all."""
_WAIT_KEY: Final = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
_COLLECT_S: Final = 0.005
"""Time for which samples are collected: a message for each would wake this thread in the middle of the loop,
and take a subscriber of 50 units two processors."""
_MOST_NOTES: Final = 100
_LONGEST: Final = 1 << 20
"""Most bytes of one message that a subscriber takes; the longest of ours is a status of some kilobytes."""
_MOST_BYTES: Final = 1 << 25
"""Most bytes that wait in a `Watch`: of 50 units at 1 kHz those of two seconds at least."""
_OVERHEAD: Final = 256
"""Bytes of a message that waits, beside its data."""


class Publication:
    """The keys that one unit is published under; write datagrams to `socket`, and close that to end.

    Parameters
    ----------
    url : Url
        ``zenoh://KEY``; option ``config``: a configuration file of Zenoh, which alone then says where the
        session listens and connects.

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
        self._error = zenoh.ZError
        try:
            self._publishers = {
                kind: self._session.declare_publisher(
                    f"{url.address}/{kind}".rstrip("/"),
                    encoding=zenoh.Encoding.APPLICATION_JSON if kind else zenoh.Encoding.ZENOH_BYTES,
                    # After `_WAIT_S`. BLOCK would close the connection of the subscriber that hangs, upon
                    # which the session may stop for all (Zenoh 1.10: github.com/eclipse-zenoh/zenoh/issues/1876).
                    congestion_control=zenoh.CongestionControl.DROP,
                    reliability=zenoh.Reliability.RELIABLE,
                    express=True,
                )
                for kind in ("", STATUS, EVENTS)
            }
        except zenoh.ZError as error:
            self._session.close()
            raise InputError(f"{url.text}: expected a key such as imu50/BENCH/UNIT: {error}") from error
        self.socket, self._far = _pair()
        self.socket.setblocking(False)
        self._notes: deque[tuple[str, Callable[[], Mapping[str, object]]]] = deque(maxlen=_MOST_NOTES)
        self._is_noted, self._is_closing = Event(), False
        self._threads = [
            Thread(target=run, name=f"publisher of {url.address}", daemon=True)
            for run in (self._run, self._run_notes)
        ]
        for thread in self._threads:
            thread.start()

    def note(self, kind: str, document: Callable[[], Mapping[str, object]]) -> None:
        """Publish a document; of many that wait, the oldest are dropped.

        Parameters
        ----------
        kind : str
            `STATUS` or `EVENTS`.
        document : callable
            Returns values that JSON can represent; called in the publishing thread.
        """
        self._notes.append((kind, document))
        self._is_noted.set()

    def close(self) -> None:
        """Publish what was written and noted, for at most a second each, and close."""
        self.socket.close()
        self._is_closing = True
        self._is_noted.set()
        for thread in self._threads:
            thread.join(_JOIN_S)
        self._session.close()

    def _run(self) -> None:
        rest = b""
        with self._far:
            while data := self._far.recv(_AT_ONCE):
                data = rest + data
                whole = len(data) // SIZE * SIZE
                if whole and not self._put("", data[:whole]):
                    return
                rest = data[whole:]
                time.sleep(_COLLECT_S)

    def _run_notes(self) -> None:
        is_last = False
        while not is_last:
            self._is_noted.wait()
            self._is_noted.clear()
            is_last = self._is_closing
            while self._notes:
                kind, document = self._notes.popleft()
                if not self._put(kind, json.dumps(document(), default=str).encode()):
                    return

    def _put(self, kind: str, data: bytes) -> bool:
        """Publish; return whether the session is open still."""
        try:
            self._publishers[kind].put(data)
        except self._error:
            return False
        return True


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
        if len(sample.payload) > _LONGEST:
            return
        try:
            self._far.sendall(sample.payload.to_bytes())
        except OSError:
            return  # closed


class Heard(NamedTuple):
    """A message of a unit.

    Attributes
    ----------
    unit : str
        Key of the unit.
    kind : str
        `STATUS` or `EVENTS`; empty: datagrams.
    data : bytes
        From whoever publishes there: not checked.
    """

    unit: str
    kind: str
    data: bytes

    def document(self) -> dict[str, Any]:
        """Return the JSON document; empty if it is none."""
        try:
            document = json.loads(self.data)
        except (ValueError, RecursionError):
            return {}
        return document if isinstance(document, dict) else {}


class Watch:
    """Everything that is published under a key and below it: samples, status and events of all units there.

    What waits is bounded: of more, the oldest is dropped.

    Parameters
    ----------
    url : Url
        See `Publication`; the key may have wildcards.
    """

    def __init__(self, url: Url) -> None:
        zenoh = _zenoh(url)
        self._session = _session(zenoh, url)
        self._arrived: deque[Heard] = deque()
        self._size, self._lock = 0, Lock()
        try:
            below = f"{url.address.removesuffix('/**')}/**"
            self._subscriber = self._session.declare_subscriber(below, self._take)
        except zenoh.ZError as error:
            self._session.close()
            raise InputError(f"{url.text}: expected a key such as imu50/**: {error}") from error

    def take(self) -> list[Heard]:
        """Return what has arrived since the last call."""
        with self._lock:
            arrived, self._arrived, self._size = self._arrived, deque(), 0
        return list(arrived)

    def close(self) -> None:
        """Leave."""
        self._session.close()

    def _take(self, sample: Any) -> None:
        if len(sample.payload) > _LONGEST:
            return
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        unit, _, kind = key.rpartition("/")
        heard = Heard(unit, kind, data) if kind in (STATUS, EVENTS) else Heard(key, "", data)
        with self._lock:
            self._arrived.append(heard)
            self._size += len(data) + _OVERHEAD
            while self._size > _MOST_BYTES:
                self._size -= len(self._arrived.popleft().data) + _OVERHEAD


def _require_one(url: Url) -> None:
    if "*" in url.address:
        raise InputError(f"{url.text}: expected the key of one unit, got one for several")
    if url.address.rpartition("/")[2] in (STATUS, EVENTS):
        raise InputError(f"{url.text}: expected the key of a unit, got that of its status or events")


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
        config = _on_this_computer(zenoh) if path is None else zenoh.Config.from_file(path)
        config.insert_json5(_WAIT_KEY, json.dumps(round(_WAIT_S * 1e6)))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise InputError(f"{url.text}: cannot be opened: {error}") from error


def _on_this_computer(zenoh: Any) -> Any:
    """Return the configuration of a session that listens, and looks for others, on the loopback only."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps("peer"))
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/{LOOPBACK}:0"]))
    config.insert_json5("scouting/multicast/interface", json.dumps(LOOPBACK))
    return config


def _zenoh(url: Url) -> Any:
    try:
        import zenoh
    except ImportError as error:
        raise InputError(
            f"{url.text}: expected the package eclipse-zenoh: pip install imu50[zenoh]"
        ) from error
    return zenoh
