"""Datagrams over Zenoh, between two sessions on the loopback."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
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
from imudrv.streams import Publication, Watch
from imudrv.url import split
from imudrv.wire.datagram import SIZE

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
            "connect": {"endpoints": [endpoint] if how == "connect" else [], "retry": {"period_max_ms": 200}},
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


def test_status_and_events_come_beside_the_samples(
    batch, urls: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["receive", urls[0].replace("bench3/50-0017", "bench3"), "--seconds", "1.5"]
    watch = Thread(target=main, args=(command,))
    watch.start()
    until(lambda: is_listening(urls[0]))
    sink = open_sink(urls[1], LAYOUT)
    until(lambda: sink.publish(batch(0, 1)) or "50-0017: " in capsys.readouterr().out)
    sink.event(1_700_000_000_000_000_000, "port lost:\n\x1b[2J/dev/ttyUSB0")
    sink.status(lambda: {"health": "warn", "reasons": ["clock not locked yet"]})
    sink.close()
    watch.join()
    lines = capsys.readouterr().out.splitlines()
    assert "imu50/bench3/50-0017: port lost: \\x1b[2J/dev/ttyUSB0" in lines
    assert lines[-1].endswith("; warn: clock not locked yet")
    assert len({line.partition(": ")[0] for line in lines}) == 1


def test_what_another_program_publishes_as_status_or_event_is_no_fault_of_the_subscriber(
    urls: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    watch = Thread(target=main, args=(["receive", urls[0], "--seconds", "1.5"],))
    watch.start()
    until(lambda: is_listening(urls[0]))
    stranger = Publication(split(urls[1], ("zenoh",)))
    documents = [{}, {"text": None}, {"health": 3, "reasons": {"a": 1}}, {"health": "ok", "reasons": [[], 7]}]
    for _ in range(20):
        for kind in ("status", "events"):
            for document in documents:
                stranger.note(kind, lambda found=document: found)
        stranger.socket.send(b"x" * 76)
        time.sleep(0.03)
    stranger.close()
    watch.join()
    assert capsys.readouterr().out.splitlines()[-1].endswith("0 restarts of the unit; ok: []; 7")


def test_sessions_listen_on_the_loopback_and_find_each_other_there(batch) -> None:
    key = f"zenoh://imu50/test-{os.getpid()}/1"
    sink = open_sink(key, LAYOUT)
    with imudrv.receive(key, timeout_s=0.1) as receiver:
        until(lambda: sink.publish(batch(0, 1)) or next(receiver, None) is not None)
        assert set(listening_addresses()) == {"127.0.0.1"}
    sink.close()


def listening_addresses() -> list[str]:
    """Addresses at which this process accepts TCP connections."""
    own = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if is_socket(fd)}
    found = []
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/self/net/{name}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in own:
                address = words[1].partition(":")[0]
                found.append(socket.inet_ntoa(bytes.fromhex(address)[::-1]) if name == "tcp" else address)
    return found


def is_socket(fd: str) -> bool:
    try:
        return os.readlink(f"/proc/self/fd/{fd}").startswith("socket:")
    except OSError:  # that of the listing itself
        return False


def test_a_subscriber_that_hangs_costs_the_others_nothing_and_is_served_again(
    batch, urls: tuple[str, str], tmp_path: Path
) -> None:
    sink = open_sink(urls[0], LAYOUT)
    command = [sys.executable, "-u", "-m", "imudrv", "receive", urls[1]]
    reports = tmp_path / "reports"
    with (
        reports.open("w") as out,
        subprocess.Popen(command, stdout=out) as hanging,
        imudrv.receive(urls[1], timeout_s=0.01) as receiver,
    ):
        sent = 0
        received: list[Records] = []

        def send_until(reached: Callable[[], object]) -> None:
            def step() -> object:
                nonlocal sent
                is_taken = not received or received[-1]["counter"][-1] == sent - 1
                if is_taken and not sink.state.queued:  # as fast as the other one takes it
                    sink.publish(batch(sent, 4000))
                    sent += 4000
                else:
                    sink.poll()
                received.extend(receiver)  # up to a pause
                return reached()

            until(step)

        def lost() -> int:
            """Samples that the other one has missed; it may have begun in the middle of a burst."""
            return max(map(int, re.findall(r"(\d+) missing", reports.read_text())), default=0)

        try:
            send_until(lambda: len(received) > 5 and " good" in reports.read_text())
            hanging.send_signal(signal.SIGSTOP)
            first, before = sent, lost()
            # More than the queues hold: the publisher waits, then leaves it alone.
            send_until(lambda: received[-1]["counter"][-1] > first + most_queued())
            hanging.send_signal(signal.SIGCONT)
            send_until(lambda: lost() > before)
            last = sent
            send_until(lambda: received[-1]["counter"][-1] >= last)
        finally:
            hanging.kill()
        counters = np.concatenate(received)["counter"]
        assert np.array_equal(counters, np.arange(counters[0], counters[0] + len(counters)))
        assert sink.state.dropped == 0
        hanging.wait()
        last = sent
        send_until(lambda: received[-1]["counter"][-1] >= last)  # its death stops nothing either
    sink.close()


def most_queued() -> int:
    """Samples that the queues of the system hold between two processes, at most."""
    kinds = (Path(f"/proc/sys/net/ipv4/tcp_{kind}").read_text() for kind in ("rmem", "wmem"))
    return sum(int(sizes.split()[2]) for sizes in kinds) // SIZE


def test_a_receiver_outlives_the_service_and_gets_what_the_next_one_sends(
    batch, urls: tuple[str, str]
) -> None:
    with imudrv.receive(urls[1], timeout_s=0.05) as receiver:
        for first in (1000, 2000):
            sink = open_sink(urls[0], LAYOUT)
            sent = iter(range(first, first + 1000))
            got: list[int] = []

            def arrives(sink: Sink = sink, sent=sent, got=got) -> bool:
                sink.publish(batch(next(sent), 1))
                if (rows := next(receiver, None)) is not None:
                    got.extend(rows["counter"].tolist())
                return bool(got)

            until(arrives)
            assert got[0] >= first
            sink.close()


def test_a_watch_keeps_a_bounded_number_of_bytes(
    urls: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imudrv.streams._MOST_BYTES", 10_000)
    watch = Watch(split(urls[0], ("zenoh",)))
    publication = Publication(split(urls[1], ("zenoh",)))
    until(lambda: publication.note("events", lambda: {"text": "first"}) or watch.take())
    for number in range(100):
        publication.note("events", lambda n=number: {"text": f"{n:0500}"})
    publication.note("events", lambda: {"text": "x" * (1 << 20)})  # longer than any of ours
    publication.note("events", lambda: {"text": "last"})
    publication.close()
    heard = watch.take()
    watch.close()
    assert heard[-1].document() == {"text": "last"}
    assert [one.document()["text"] for one in heard[:-1]] == [
        f"{n:0500}" for n in range(101 - len(heard), 100)
    ]
    assert 5 < len(heard) < 20


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
        (f"{KEY}/status", "expected the key of a unit, got that of its status or events"),
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
