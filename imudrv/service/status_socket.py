"""Report the status of a running service to those who ask.

A client connects, receives one line of JSON, and the service closes the connection.
"""

import json
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from imudrv.errors import InputError
from imudrv.service.endpoint import Endpoint, connect, default_folder

FORMAT: Final = "imu50-status"
VERSION: Final = 1
EXIT_CODES: Final = {"ok": 0, "warn": 3, "fail": 4}
"""Exit code of `imudrv status` by health."""


MAX_STATUS: Final = 1 << 20
"""Largest status that a client accepts, bytes."""

TIMEOUT_S: Final = 2.0


class StatusServer:
    """Answers with the status at a path; never blocks.

    Parameters
    ----------
    path : Path
        See `Endpoint`.

    Raises
    ------
    InputError
        See `Endpoint`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._endpoint = Endpoint(path)
        self._socket = self._endpoint.listener
        self._socket.setblocking(False)

    def poll(self, line: bytes) -> None:
        """Send the status to the clients that have connected.

        Parameters
        ----------
        line : bytes
            Status as one line of JSON.
        """
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with client, suppress(OSError):
                # Larger than any status, so that sending never waits for the client.
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_STATUS)
                client.setblocking(False)
                client.sendall(line)

    def close(self) -> None:
        """Stop listening and remove the socket."""
        self._endpoint.close()


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
    except ValueError:
        status = None
    if not isinstance(status, dict) or (status.get("format"), status.get("version")) != (FORMAT, VERSION):
        raise InputError(f"{path}: expected {FORMAT} version {VERSION}, got {bytes(data[:40])!r}")
    return status


def default_status_path() -> Path:
    """Return the default path of the status socket; see `imudrv.service.endpoint.default_folder`."""
    return default_folder() / "imu50.sock"
