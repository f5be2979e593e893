"""Unix socket that reports the status of a running service.

A client connects, receives one line of JSON, and the service closes the connection.
"""

import json
import os
import socket
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from imudrv.errors import InputError
from imudrv.service.status import Status

MAX_STATUS: Final = 1 << 20
"""Largest status that a client takes, bytes."""


TIMEOUT_S: Final = 2.0


class StatusServer:
    """Listens on a unix socket that only the user can open; never blocks.

    Parameters
    ----------
    path : Path
        The socket. One that a dead service left is replaced.

    Raises
    ------
    InputError
        Another service is there, or the socket cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
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
        try:
            before = os.umask(0o177)
            try:
                self._socket.bind(os.fspath(path))
            finally:
                os.umask(before)
        except OSError as error:
            self._socket.close()
            raise InputError(f"{path}: cannot make the status socket: {error.strerror or error}") from error
        self._socket.listen(8)
        self._socket.setblocking(False)

    def poll(self, line: bytes) -> None:
        """Tell whoever has connected.

        Parameters
        ----------
        line : bytes
            The status now; whole lines of JSON.
        """
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with client, suppress(OSError):
                # Larger than any status, so that it goes out at once whoever reads.
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_STATUS)
                client.setblocking(False)
                client.sendall(line)

    def close(self) -> None:
        """Stop listening and take the socket away."""
        self._socket.close()
        self.path.unlink(missing_ok=True)


def ask(path: Path) -> Status:
    """Ask a service for its status.

    Parameters
    ----------
    path : Path
        Its socket.

    Returns
    -------
    dict

    Raises
    ------
    InputError
        Nobody is there, or what is there is no service of ours.
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
    if not isinstance(status, dict) or status.get("format") != "imu50-status":
        raise InputError(f"{path}: expected the status of a service, got {bytes(data[:40])!r}")
    return status


def default_status_path() -> Path:
    """Return the default path of the status socket: in the user's runtime folder."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / "imu50.sock"
