"""Server of one page with live data, for browsers on this machine; a thread of its own.

The page and its data need the token in the printed address. Everything is loaded from this server, which says
so to the browser (CSP). Data go out as text; a slow page loses frames, and nobody waits for it. Of many
viewers one may act: the first one, until it hands over or leaves; then whoever takes it.

Messages of a page are JSON objects of at most `MOST_BYTES`: ``{"take": true}``, ``{"give": true}``, or one
that is handed on if that viewer may act.
"""

import asyncio
import json
import secrets
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import resources
from importlib.resources.abc import Traversable
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Final

from imudrv.errors import InputError

if TYPE_CHECKING:
    from aiohttp import web

MOST_BYTES: Final = 1024
"""Largest message of a page."""

MOST_VIEWERS: Final = 20
"""Most viewers at a time."""

_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}

_DOCUMENT_HEADERS: Final = {
    **_HEADERS,
    "Content-Security-Policy": "default-src 'none'; img-src data:; style-src 'unsafe-inline'",
}

_TYPES: Final = {"html": "text/html", "css": "text/css", "js": "text/javascript", "json": "application/json"}

_HEARTBEAT_S: Final = 5.0


class _Viewer:
    """A connected page: what it has to be sent next, the newest of each kind only."""

    def __init__(self) -> None:
        self.newest = ""
        self.kept: dict[str, str] = {}
        self.wake = asyncio.Event()


class PageServer:
    """Serves a page, from construction to `close`.

    Parameters
    ----------
    page : Traversable
        Folder with the files of the page; ``index.html`` is the page. All pages have ``live.js``, too.
    address : str
        ``HOST:PORT``.
    token : str
        Secret part of the address.
    receive : callable
        Called in the server's thread with each message of the viewer that may act.
    documents : Mapping of str to callable, optional
        Content of further pages by name, empty if there is none yet; they bring their own CSP.

    Attributes
    ----------
    url : str
        Address for the browser, with the token.

    Raises
    ------
    InputError
        The address is invalid or in use, or aiohttp is not installed.
    """

    def __init__(
        self,
        page: Traversable,
        address: str,
        token: str,
        receive: Callable[[dict[str, Any]], None],
        documents: Mapping[str, Callable[[], bytes]] | None = None,
    ) -> None:
        try:
            import aiohttp  # noqa: F401
        except ImportError:
            raise InputError("--web: expected the package aiohttp: pip install 'imu50[web]'") from None
        files = (resources.files(__package__).joinpath("live.js"), *page.iterdir())
        self._files = {file.name: file.read_bytes() for file in files if file.is_file()}
        self._documents = dict(documents or {})
        self._token, self._receive = token, receive
        self._viewers: dict[Any, _Viewer] = {}
        self._actor: Any = None
        self._kept: dict[str, str] = {}
        self._host, self._port = _host_and_port(address)
        self._started, self._failure = Event(), ""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._thread = Thread(target=lambda: asyncio.run(self._serve()), name="web", daemon=True)
        self._thread.start()
        self._started.wait()
        if self._failure:
            raise InputError(f"--web {address}: cannot be used: {self._failure}")
        self.url = f"http://{_in_url(self._host)}:{self._port}/?token={token}"

    @property
    def viewers(self) -> int:
        """Number of connected pages."""
        return len(self._viewers)

    def publish(self, text: str) -> None:
        """Send a frame to every viewer; one that was not sent yet is replaced."""
        if self._viewers:
            self._call(self._publish, text)

    def keep(self, name: str, text: str) -> None:
        """Send a message to every viewer, and to those that come later; it replaces that of the same name."""
        self._call(self._keep, name, text)

    def close(self) -> None:
        """End the server."""
        self._call(lambda: self._stop.set() if self._stop else None)
        self._thread.join()

    def _call(self, function: Callable[..., object], *arguments: object) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # it has ended
                self._loop.call_soon_threadsafe(function, *arguments)

    # In the thread of the server

    def _publish(self, text: str) -> None:
        for viewer in self._viewers.values():
            viewer.newest = text
            viewer.wake.set()

    def _keep(self, name: str, text: str) -> None:
        self._kept[name] = text
        for viewer in self._viewers.values():
            viewer.kept[name] = text
            viewer.wake.set()

    def _tell_actor(self) -> None:
        for socket, viewer in self._viewers.items():
            acting = {"kind": "acting", "acting": socket is self._actor, "free": self._actor is None}
            viewer.kept["acting"] = json.dumps(acting)
            viewer.wake.set()

    async def _serve(self) -> None:
        from aiohttp import WSCloseCode, web

        app = web.Application(client_max_size=MOST_BYTES)
        app.router.add_get("/ws", self._socket)
        app.router.add_get("/{name:[A-Za-z_.]*}", self._file)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        self._stop, self._loop = asyncio.Event(), asyncio.get_running_loop()
        try:
            site = web.TCPSite(runner, self._host, self._port)
            await site.start()
            self._port = runner.addresses[0][1]
        except OSError as error:
            self._failure = error.strerror or str(error)
        self._started.set()
        if not self._failure:
            await self._stop.wait()
            for socket in list(self._viewers):
                with suppress(asyncio.TimeoutError, ConnectionError):
                    await asyncio.wait_for(socket.close(code=WSCloseCode.GOING_AWAY), 1.0)
        await runner.cleanup()

    def _is_allowed(self, request: "web.Request") -> bool:
        return secrets.compare_digest(request.query.get("token", "").encode(), self._token.encode())

    async def _file(self, request: "web.Request") -> "web.Response":
        from aiohttp import web

        name = request.match_info["name"] or "index.html"
        is_secret = name == "index.html" or name in self._documents
        if is_secret and not self._is_allowed(request):
            return web.Response(
                status=403, text="open the address that the program printed\n", headers=_HEADERS
            )
        kind = _TYPES.get(name.rpartition(".")[2], "text/plain")
        if name in self._documents and (content := self._documents[name]()):
            return web.Response(body=content, content_type=kind, charset="utf-8", headers=_DOCUMENT_HEADERS)
        if name not in self._files:
            return web.Response(status=404, text="no such page\n", headers=_HEADERS)
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8", headers=_HEADERS)

    async def _socket(self, request: "web.Request") -> "web.StreamResponse":
        from aiohttp import WSCloseCode, WSMsgType, web

        if not self._is_allowed(request) or request.headers.get("Origin") != f"http://{request.host}":
            return web.Response(status=403, text="not allowed\n", headers=_HEADERS)
        if len(self._viewers) >= MOST_VIEWERS:
            return web.Response(status=503, text="too many viewers\n", headers=_HEADERS)
        # Not compressed: that costs more than the bytes, on this machine or in a laboratory.
        socket = web.WebSocketResponse(heartbeat=_HEARTBEAT_S, max_msg_size=MOST_BYTES, compress=False)
        await socket.prepare(request)
        viewer = _Viewer()
        viewer.kept |= self._kept
        self._viewers[socket] = viewer
        self._actor = self._actor or socket
        self._tell_actor()
        sender = asyncio.create_task(_send(socket, viewer))
        try:
            async for message in socket:
                content = _parsed(message.data) if message.type is WSMsgType.TEXT else None
                if content is None:
                    await socket.close(code=WSCloseCode.POLICY_VIOLATION)
                    break
                self._take_message(socket, content)
        finally:
            sender.cancel()
            del self._viewers[socket]
            if self._actor is socket:
                self._actor = None
            self._tell_actor()
        return socket

    def _take_message(self, socket: object, content: dict[str, Any]) -> None:
        if content.get("take") is True:
            self._actor = self._actor or socket
            self._tell_actor()
        elif self._actor is socket:
            if content.get("give") is True:
                self._actor = None
                self._tell_actor()
            else:
                self._receive(content)


async def _send(socket: "web.WebSocketResponse", viewer: _Viewer) -> None:
    """Send what waits; while the page is slow, newer frames replace older ones."""
    with suppress(ConnectionError, RuntimeError):  # it has gone
        while True:
            await viewer.wake.wait()
            viewer.wake.clear()
            kept, viewer.kept, newest, viewer.newest = viewer.kept, {}, viewer.newest, ""
            for text in (*kept.values(), *([newest] if newest else [])):
                await socket.send_str(text)


def _parsed(text: str) -> dict[str, Any] | None:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _host_and_port(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--web {address}: expected HOST:PORT, such as 127.0.0.1:8650")
    return host.strip("[]"), int(port)


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host
