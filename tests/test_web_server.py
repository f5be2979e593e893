"""The server of pages: who is let in, what is bounded, and that a slow page costs nobody anything."""

import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from realtime import until

from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.sim.scenario import NOMINAL

aiohttp = pytest.importorskip("aiohttp")

from imudrv.web.server import MOST_BYTES, MOST_VIEWERS, PageServer  # noqa: E402

TOKEN = "a-token-of-the-session"


class Served:
    """A server, and what it received."""

    def __init__(self, folder: Path) -> None:
        (folder / "index.html").write_text("<p>page</p>")
        self.received: list[dict[str, Any]] = []
        self.server = PageServer(folder, "127.0.0.1:0", TOKEN, self.received.append)
        self.base = self.server.url.partition("/?")[0]

    def open(self, session: Any, token: str = TOKEN, origin: str | None = None) -> Any:
        headers = {"Origin": self.base if origin is None else origin}
        return session.ws_connect(f"{self.base}/ws?token={token}", headers=headers)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    served = Served(tmp_path)
    yield served
    served.server.close()


def run(made: Any) -> Any:
    return asyncio.run(asyncio.wait_for(made, 60.0))


@pytest.mark.parametrize(
    ("token", "origin"),
    [("", None), ("wrong", None), (TOKEN, "http://evil.example"), (TOKEN, ""), (TOKEN, "null")],
)
def test_a_socket_needs_the_token_and_the_origin_of_the_page(
    token: str, origin: str | None, served: Served
) -> None:
    async def refused() -> int:
        async with aiohttp.ClientSession() as session:
            with pytest.raises(aiohttp.WSServerHandshakeError) as error:
                await served.open(session, token, origin)
            return error.value.status

    assert run(refused()) == 403
    assert served.server.viewers == 0


@pytest.mark.parametrize("text", ["x" * (MOST_BYTES + 1), "no json", "[1]", "[" * 1000, '"text"'])
def test_a_message_that_is_none_ends_only_its_own_page(text: str, served: Served) -> None:
    async def closed() -> Any:
        async with (
            aiohttp.ClientSession() as session,
            served.open(session) as good,
            served.open(session) as bad,
        ):
            await bad.send_str(text)
            while not bad.closed:
                await bad.receive()
            await good.send_json({"action": "confirm", "step": "z"})
            await good.close()

    run(closed())
    until(lambda: served.received == [{"action": "confirm", "step": "z"}])


def test_only_one_may_act_and_it_is_handed_over_or_left(served: Served) -> None:
    async def acting(socket: Any) -> dict[str, Any]:
        while (content := await socket.receive_json())["kind"] != "acting":
            pass
        return content

    async def talk() -> None:
        async with aiohttp.ClientSession() as session, served.open(session) as one:
            assert (await acting(one))["acting"]
            async with served.open(session) as two:
                assert await acting(two) == {"kind": "acting", "acting": False, "free": False}
                await two.send_json({"take": True})
                await two.send_json({"n": 2})  # ignored
                assert not (await acting(two))["acting"]
                await one.send_json({"give": True})
                assert (await acting(two))["free"]
                await two.send_json({"take": True})
                assert (await acting(two))["acting"]
                await two.send_json({"n": 3})
            while not (await acting(one))["free"]:
                pass

    run(talk())
    until(lambda: served.received == [{"n": 3}])


def test_a_page_that_reads_nothing_loses_frames_and_stops_nobody(served: Served) -> None:
    frame = json.dumps({"kind": "view", "filler": "x" * 20_000})

    async def talk() -> str:
        async with aiohttp.ClientSession() as session, served.open(session) as fast:
            slow = await served.open(session)
            slow._response.connection.transport.pause_reading()  # noqa: SLF001  as a stopped page
            for number in range(2000):
                served.server.publish(f"{number} {frame}")
                if number % 100 == 0:
                    await asyncio.sleep(0.01)
            served.server.publish("last")
            while (message := await fast.receive()).data != "last":
                assert message.type is aiohttp.WSMsgType.TEXT
            slow._response.connection.transport.abort()  # noqa: SLF001
            return str(message.data)

    assert run(talk()) == "last"


def test_a_page_that_reads_nothing_gets_the_newest_state_and_no_queue(served: Served) -> None:
    filler, changes = "x" * 50_000, 1000

    async def talk() -> list[int]:
        async with aiohttp.ClientSession() as session, served.open(session) as slow:
            transport = slow._response.connection.transport  # noqa: SLF001
            transport.pause_reading()
            for number in range(changes):
                served.server.keep("result", json.dumps({"number": number, "filler": filler}))
                if number % 100 == 0:
                    await asyncio.sleep(0.01)
            served.server.keep("result", json.dumps({"number": changes}))
            transport.resume_reading()
            numbers = []
            while not numbers or numbers[-1] != changes:
                content = await slow.receive_json()
                if "number" in content:
                    numbers.append(content["number"])
            return numbers

    numbers = run(talk())
    assert numbers == sorted(numbers)
    assert len(numbers) < changes / 2  # the sockets hold 10 MB at most, 200 of them


def test_the_number_of_viewers_is_bounded(served: Served) -> None:
    async def crowd() -> int:
        async with aiohttp.ClientSession() as session:
            sockets = [await served.open(session) for _ in range(MOST_VIEWERS)]
            with pytest.raises(aiohttp.WSServerHandshakeError) as error:
                await served.open(session)
            for socket in sockets:
                await socket.close()
            return error.value.status

    assert run(crowd()) == 503


@pytest.mark.parametrize("address", ["", "8650", "127.0.0.1:", "127.0.0.1:99999", ":80", "127.0.0.1:x"])
def test_an_address_has_a_host_and_a_port(address: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected HOST:PORT, such as 127"):
        PageServer(tmp_path, address, TOKEN, lambda _: None)


def test_an_address_in_use_is_named(served: Served, tmp_path: Path) -> None:
    address = served.base.removeprefix("http://")
    with pytest.raises(InputError, match=f"--web {address}: cannot be used: .*in use"):
        PageServer(tmp_path, address, TOKEN, lambda _: None)


def test_files_outside_the_page_are_not_served(served: Served) -> None:
    async def statuses() -> list[int]:
        async with aiohttp.ClientSession() as session:
            found = []
            for path in (
                "/../etc/passwd",
                "/..%2fetc%2fpasswd",
                "/index.html",
                "/nothing.js",
                f"/?token={TOKEN}",
            ):
                async with session.get(served.base + path) as answer:
                    assert answer.headers.get("X-Content-Type-Options", "nosniff") == "nosniff"
                    found.append(answer.status)
            return found

    assert run(statuses()) == [404, 404, 403, 404, 200]


def test_the_monitor_serves_status_frames_of_a_running_service(tmp_path: Path) -> None:
    head = "{format: imu50-scenario, version: 1, seed: 1, motion: [{rest: {duration_s: 3600}}],"
    site = "site: {latitude_deg: 28, longitude_deg: 113, height_m: 60}}"
    (tmp_path / "rest.yaml").write_text(head + site)
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    status = tmp_path / "status.sock"
    serve = ["run", "--port", "sim://rest.yaml", "--profile", "imu50-rs422", "--calibration", "unit.yaml"]
    commands = [
        [*serve, "--status", str(status)],
        ["monitor", "--status", str(status), "--web", "127.0.0.1:0"],
    ]
    processes = []

    def start(command: list[str]) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "imudrv", *command], cwd=tmp_path, stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        return process

    async def frame(url: str) -> dict[str, Any]:
        base, _, query = url.partition("/?")
        headers, address = {"Origin": base}, f"{base}/ws?{query}"
        async with aiohttp.ClientSession() as session, session.ws_connect(address, headers=headers) as page:
            while (content := await page.receive_json())["kind"] != "status":
                assert content["kind"] in ("hello", "acting")
            return content

    try:
        start(commands[0])
        until(status.exists)
        monitor = start(commands[1])
        assert monitor.stdout is not None
        url = monitor.stdout.readline().partition("page for browsers: ")[2].strip()
        shown = run(frame(url))
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert {name for name, _, _ in shown["rows"]["en"]} >= {
        "unit",
        "port",
        "sample rate",
        "losses",
        "clock",
        "latency",
        "status bits",
    }
    assert len(shown["rows"]["zh_CN"]) == len(shown["rows"]["en"])
    assert sum(count for _, count in shown["latency"]) > 0
    assert 8.0 < shown["force"] < 12.0  # gravity, with the noise of one sample
    assert shown["rate"] < 2.0  # a pulse is 0.14 deg/s
