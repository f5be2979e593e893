import socket
from contextlib import suppress

from imudrv.profiles import load
from imudrv.service.events import EventLog
from imudrv.service.port import BACK_OFF_S, PortSupervisor
from imudrv.units import NS_PER_S


def test_a_port_that_opens_but_brings_nothing_is_opened_with_pauses_and_reported_once() -> None:
    # A serial server without its device: it accepts, and closes.
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        now_ns, lines, opened = 0, list[str](), 0
        events = EventLog(lines.append, lines.append, lambda *_: None, lambda: now_ns)
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        port = PortSupervisor(url, load("imu50-rs422"), True, events, lambda: now_ns)
        turns = 100
        for _ in range(turns):
            port.read(0.001)
            with suppress(BlockingIOError):
                server.accept()[0].close()
                opened += 1
            now_ns += NS_PER_S // 50
        # Pauses of 0.1, 0.2, 0.4 s, then 0.8 s in 2 s; without them it is opened every second turn.
        assert 3 <= opened <= 2 + len(BACK_OFF_S), opened
        assert sum("port lost" in line for line in lines) == 1, lines
        assert not any("is back" in line for line in lines)
        server.settimeout(30.0)
        now_ns += NS_PER_S
        port.read(0.001)
        unit = server.accept()[0]
        unit.send(b"wire")
        while (arrival := port.read(0.1)) is None:
            pass
        port.decoded(arrival.data, 0)
        unit.close()
        port.close()
        assert "port is back" in lines[-1]
