"""Datagrams over Zenoh, between two sessions on the loopback."""

import json
import re
import socket
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from realtime import until

import imudrv
from imudrv import profiles
from imudrv.cli import main
from imudrv.errors import InputError
from imudrv.records import Records
from imudrv.sinks import open_sink
from imudrv.sinks.base import Sink

pytest.importorskip("zenoh")

LAYOUT = profiles.load("imu50-rs422").layout()
KEY = "zenoh://imu50/bench3/50-0017"


@pytest.fixture
def urls(tmp_path: Path) -> tuple[str, str]:
    """URLs of an output and of a receiver that know each other; nothing leaves this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    for name, how in (("listen", "listen"), ("connect", "connect")):
        config = {
            "mode": "peer",
            "scouting": {"multicast": {"enabled": False}},
            "listen": {"endpoints": [endpoint] if how == "listen" else []},
            "connect": {"endpoints": [endpoint] if how == "connect" else []},
        }
        (tmp_path / f"{name}.json5").write_text(json.dumps(config))
    return f"{KEY}?config={tmp_path / 'listen.json5'}", f"{KEY}?config={tmp_path / 'connect.json5'}"


def is_listening(url: str) -> bool:
    config = json.loads(Path(url.partition("config=")[2]).read_text())
    with socket.socket() as caller:
        port = int(config["listen"]["endpoints"][0].rpartition(":")[2])
        return caller.connect_ex(("127.0.0.1", port)) == 0


def test_what_is_published_arrives_bit_for_bit_also_at_a_subscriber_that_stalls(
    batch, urls: tuple[str, str]
) -> None:
    sink = open_sink(urls[0], LAYOUT)
    received: list[Records] = []
    with imudrv.receive(urls[1], timeout_s=0.2) as receiver:
        begin = 0

        def arrives() -> bool:
            nonlocal begin
            sink.publish(batch(begin, 1))
            begin += 1
            return next(receiver, None) is not None

        until(arrives)  # the sessions have found each other
        for first in range(begin, begin + 6000, 10):  # six seconds that nobody reads
            sink.publish(batch(first, 10))

        def has_all() -> bool:
            sink.poll()
            received.extend(receiver)  # up to a pause
            return bool(received) and received[-1]["counter"][-1] == begin + 5999

        until(has_all)
        sink.close()
    samples = np.concatenate(received)
    samples = samples[samples["counter"] >= begin]
    assert np.array_equal(samples["counter"], np.arange(begin, begin + 6000))
    expected = batch(begin, 6000).increments
    for name in ("t_ns", "interval_ns", "dtheta_b", "dv_b", "flags"):
        assert np.array_equal(samples[name], expected[name])
    assert sink.state.dropped == 0


def test_several_units_are_counted_by_their_keys(
    batch, urls: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    watch = Thread(
        target=main, args=(["receive", urls[0].replace("bench3/50-0017", "**"), "--seconds", "2"],)
    )
    watch.start()
    until(lambda: is_listening(urls[0]))
    sinks = [open_sink(urls[1].replace("0017", number), LAYOUT) for number in ("0017", "0018")]
    first = 0
    while watch.is_alive():
        for sink in sinks:
            sink.publish(batch(first, 1))
        first += 1
        watch.join(0.002)
    for sink in sinks:
        sink.close()
    last = capsys.readouterr().out.splitlines()[-2:]
    for line, unit in zip(last, ("50-0017", "50-0018"), strict=True):
        assert line.startswith(f"imu50/bench3/{unit}: ")
        expected, good = (int(word) for word in re.findall(r"(\d+) (?:samples|good)", line))
        assert expected == good > 0


def test_nobody_need_listen(batch, urls: tuple[str, str]) -> None:
    sink: Sink = open_sink(urls[0], LAYOUT)
    for first in range(100):
        sink.publish(batch(first, 1))
    until(lambda: sink.poll() or sink.state.sent == 100)
    sink.close()
    assert sink.state[1:] == ("ok", True, 100, 0, 0)


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("zenoh://imu50/**", "expected the key of one unit, got one for several"),
        (f"{KEY}?speed=1", "expected no option but config, got speed"),
        (f"{KEY}?config=nothing.json5", "config: expected a file, there is none"),
    ],
)
def test_a_url_that_is_wrong_is_refused(url: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        open_sink(url, LAYOUT)


def test_a_receiver_of_several_units_is_refused() -> None:
    with pytest.raises(InputError, match="expected the key of one unit, got one for several"):
        imudrv.receive("zenoh://imu50/**")
