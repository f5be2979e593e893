"""Report the status of a running service to those who ask.

A client connects, receives one line of JSON, and the service closes the connection. A thread of its own makes
the line, when a client asks.
"""

import json
import select
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, Final

from imudrv.errors import InputError
from imudrv.service.endpoint import Endpoint, connect, default_folder
from imudrv.service.wake import WakePipe

FORMAT: Final = "imu50-status"
VERSION: Final = 1
EXIT_CODES: Final = {"ok": 0, "warn": 3, "fail": 4}
"""Exit code of `imudrv status` by health."""


MAX_STATUS: Final = 1 << 20
"""Largest status that a client accepts, bytes."""

TIMEOUT_S: Final = 2.0
_RENEWAL_S: Final = 1.0
"""Period of looking whether the path still leads to the socket."""


class StatusServer:
    """Answers with the status at a path.

    Parameters
    ----------
    path : Path
        See `Endpoint`.
    line : callable
        Returns the status as one line of JSON; called in the thread of the server.

    Raises
    ------
    InputError
        See `Endpoint`.
    """

    def __init__(self, path: Path, line: Callable[[], bytes]) -> None:
        self.path = path
        self._line = line
        self._endpoint = Endpoint(path)
        self._pipe = WakePipe()
        self._is_closing = False
        self._thread = Thread(target=self._run, name="status", daemon=True)

    def start(self) -> None:
        """Answer clients from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop listening and remove the socket."""
        self._is_closing = True
        self._pipe.wake()
        if self._thread.is_alive():
            self._thread.join(TIMEOUT_S)
        self._pipe.close()
        self._endpoint.close()

    def _run(self) -> None:
        while not self._is_closing:
            listener = self._endpoint.listener.fileno()
            ready, _, _ = select.select([listener, self._pipe.descriptor], [], [], _RENEWAL_S)
            if listener in ready:
                with suppress(OSError):
                    self._answer()
            elif not ready:
                self._endpoint.renew()

    def _answer(self) -> None:
        client, _ = self._endpoint.listener.accept()
        with client:
            # Larger than any status, so that sending never waits for the client.
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_STATUS)
            client.setblocking(False)
            client.sendall(self._line())


def ask(path: Path) -> dict[str, Any]:
    """Ask a service for its status.

    Parameters
    ----------
    path : Path
        Its socket.

    Returns
    -------
    dict
        JSON document, see `imudrv.service.status.Status.from_json`.

    Raises
    ------
    InputError
        No service listens there, or what answers is not a service of this product.
    """
    data = bytearray()
    try:
        with connect(path, TIMEOUT_S) as channel:
            while len(data) <= MAX_STATUS and (piece := channel.recv(1 << 16)):
                data += piece
    except OSError as error:
        raise InputError(
            f"{path}: expected a running service, got none ({error.strerror or error}); "
            "start it with `imudrv run`, or name its socket with --status"
        ) from error
    try:
        status = json.loads(data)
    except (ValueError, RecursionError):
        status = None
    if not isinstance(status, dict) or (status.get("format"), status.get("version")) != (FORMAT, VERSION):
        raise InputError(f"{path}: expected {FORMAT} version {VERSION}, got {bytes(data[:40])!r}")
    return status


def default_status_path() -> Path:
    """Return the default path of the status socket; see `imudrv.service.endpoint.default_folder`."""
    return default_folder() / "imu50.sock"
