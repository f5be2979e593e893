"""Unix socket that reports the status of a running service.

A client connects, receives one line of JSON, and the service closes the connection. A thread of its own makes
the line, when a client asks.
"""

import json
import os
import socket
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, Final

from imudrv.errors import InputError

FORMAT: Final = "imu50-status"
VERSION: Final = 1
EXIT_CODES: Final = {"ok": 0, "warn": 3, "fail": 4}
"""Exit code of `imudrv status` by health."""


MAX_STATUS: Final = 1 << 20
"""Largest status that a client accepts, bytes."""

TIMEOUT_S: Final = 2.0


class StatusServer:
    """Unix socket that only its user can open.

    Parameters
    ----------
    path : Path
        Path of the socket. One left by a service that has died is replaced.
    line : callable
        Returns the status as one line of JSON; called in the thread of the server.

    Raises
    ------
    InputError
        Another service listens there, or the socket cannot be created.
    """

    def __init__(self, path: Path, line: Callable[[], bytes]) -> None:
        self.path = path
        self._line = line
        if path.exists() and stat.S_ISSOCK(path.stat().st_mode):
            with socket.socket(socket.AF_UNIX) as probe:
                probe.settimeout(TIMEOUT_S)
                if probe.connect_ex(os.fspath(path)) == 0:
                    raise InputError(
                        f"{path}: expected no other service, got one that answers; "
                        "stop it, or give --status another path"
                    )
            path.unlink()
        self._socket = socket.socket(socket.AF_UNIX)
        before = os.umask(0o177)
        try:
            self._socket.bind(os.fspath(path))
        except OSError as error:
            self._socket.close()
            raise InputError(f"{path}: cannot create the status socket: {error.strerror or error}") from error
        finally:
            os.umask(before)
        self._socket.listen(8)
        self._is_closing = False
        self._thread = Thread(target=self._run, name="status", daemon=True)

    def start(self) -> None:
        """Answer clients from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop listening and remove the socket."""
        self._is_closing = True
        if self._thread.is_alive():
            with socket.socket(socket.AF_UNIX) as waker:
                waker.connect_ex(os.fspath(self.path))
            self._thread.join(TIMEOUT_S)
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _run(self) -> None:
        while True:
            client, _ = self._socket.accept()
            with client, suppress(OSError):
                if self._is_closing:
                    return
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
        with socket.socket(socket.AF_UNIX) as channel:
            channel.settimeout(TIMEOUT_S)
            channel.connect(os.fspath(path))
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
    """Return the default path of the status socket: in the user's runtime folder."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / "imu50.sock"
