import re
import threading
from itertools import count
from pathlib import Path

import can
import numpy as np
import pytest
from realtime import DEADLINE_S

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.imu.sequence import SequenceTracker
from imudrv.records import MESSAGE, Records
from imudrv.sinks import can as can_sink
from imudrv.sinks.can import CanSink
from imudrv.wire.can import CanAssembler

SERIAL = profiles.load("imu50-rs422").layout()


def receive(bus: can.BusABC, count: int) -> Records:
    messages = np.zeros(count, MESSAGE)
    for row in messages:
        message = bus.recv(DEADLINE_S)
        assert message is not None, "the sink stopped sending"
        row["id"], row["length"], row["fd"] = message.arbitration_id, message.dlc, message.is_fd
        row["data"][: message.dlc] = list(message.data)
    return messages


@pytest.mark.parametrize(("profile", "messages"), [("imu50-can", 2 * 200 + 2 * 2), ("imu50-canfd", 200)])
def test_pulses_of_a_serial_unit_go_out_on_a_can_bus(batch, wait_for, profile: str, messages: int) -> None:
    layout = profiles.load(profile).layout()
    with can.Bus(f"gateway {profile}", "virtual", protocol=protocol(layout.fd)) as bus:
        sink = CanSink(f"can://virtual/gateway {profile}?profile={profile}", SERIAL)
        wait_for(lambda: sink.state.state == "ok")
        sent = batch(0, 200)
        sink.publish(sent)
        decoded = CanAssembler(layout).feed(receive(bus, messages))
        assert decoded.rejects.size == 0
        pulses = SequenceTracker(layout).feed(decoded.frames)
        for name in ("counter", "gyro", "accelerometer"):
            assert np.array_equal(pulses[name], sent.pulses[name])
        # 0.01 degC is the wire's resolution.
        assert pulses["temperature_degc"][-1, :4] == pytest.approx([35.12, 34.95, 35.01, 34.88], abs=0.005)
        wait_for(lambda: sink.state[1:] == ("ok", True, 200, 0, 0))
        sink.close()


def test_identifiers_of_29_bits_are_sent_as_such(batch, wait_for, tmp_path: Path) -> None:
    profile = tmp_path / "wide.yaml"
    profile.write_bytes(profiles.content("imu50-can").replace(b"id: 0x150", b"id: 0x18FF0150"))
    with can.Bus("wide gateway", "virtual") as bus:
        sink = CanSink(f"can://virtual/wide gateway?profile={profile}", SERIAL)
        wait_for(lambda: sink.state.state == "ok")
        sink.publish(batch(0, 1))
        received = [bus.recv(20) for _ in range(2)]
        sink.close()
    sent = [(m.arbitration_id, m.is_extended_id) for m in received if m is not None]
    assert sent == [(0x18FF0150, True), (0x151, False)]


def protocol(fd: bool) -> can.CanProtocol:
    return can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20


def test_samples_that_the_outgoing_profile_cannot_carry_are_dropped_and_counted(batch, wait_for) -> None:
    with can.Bus("narrow", "virtual") as bus:
        sink = CanSink("can://virtual/narrow?profile=imu50-can", SERIAL)
        wait_for(lambda: sink.state.state == "ok")
        sent = batch(1, 5)
        sent.pulses["gyro"][1, 2] = 40_000  # more than 16 bits
        sent.pulses["interval_ns"][3] = 3_000_000  # bridged a gap
        sink.publish(sent)
        counters = [int.from_bytes(m["data"][6:8].tobytes(), "little") for m in receive(bus, 6)]
        assert counters == [1, 1, 3, 3, 5, 5]
        wait_for(lambda: sink.state[1:] == ("ok", True, 3, 2, 0))
        sink.close()


@pytest.mark.parametrize(
    ("unit", "renamed", "expected"),
    [
        # one sensor for all accelerometers; the electronics have no place in the outgoing profile
        ("imu50-rs422-acc", {}, [30.0, 34.0, 34.0, 34.0]),
        # the mean of three; a sensor that the unit lacks goes out as zero counts
        (
            "imu50-rs422",
            {"accelerometer_x": "accelerometer", "accelerometer_y": "electronics"},
            [30.0, 36.0, 0.0, 38.0],
        ),
    ],
)
def test_temperatures_are_matched_by_sensor(
    batch, wait_for, tmp_path: Path, unit: str, renamed: dict[str, str], expected: list[float]
) -> None:
    text = (Path(profiles.__file__).parent / "imu50-canfd.yaml").read_text()
    for old, new in renamed.items():
        text = text.replace(f"sensor: {old},", f"sensor: {new},")
    profile = tmp_path / "outgoing.yaml"
    profile.write_text(text)
    with can.Bus(f"sensors {unit}", "virtual", protocol=protocol(fd=True)) as bus:
        sink = CanSink(f"can://virtual/sensors {unit}?profile={profile}", profiles.load(unit).layout())
        wait_for(lambda: sink.state.state == "ok")
        sent = batch(1, 1)
        sent.pulses["temperature_degc"][0, :4] = [30.0, 34.0, 36.0, 38.0]
        sink.publish(sent)
        degc = receive(bus, 1)["data"][0, 28:36].copy().view("<i2") * 0.01
        assert degc == pytest.approx(expected, abs=1e-9)
        sink.close()


def test_a_blocking_driver_delays_nothing_else_and_loses_the_oldest_samples(
    batch, wait_for, monkeypatch
) -> None:
    go, begun = threading.Event(), threading.Event()
    send = can.interfaces.virtual.VirtualBus.send

    def slow(self: can.BusABC, message: can.Message, timeout: float | None = None) -> None:
        begun.set()
        assert go.wait(DEADLINE_S)
        send(self, message, timeout)

    monkeypatch.setattr(can.interfaces.virtual.VirtualBus, "send", slow)
    monkeypatch.setattr(can_sink, "LIMIT", 50)
    with can.Bus("slow", "virtual") as bus:
        sink = CanSink("can://virtual/slow?profile=imu50-canfd", SERIAL)
        wait_for(lambda: sink.state.state == "ok")
        sink.publish(batch(0, 1))
        assert begun.wait(DEADLINE_S)
        for n in range(1, 100):
            sink.publish(batch(n, 1))
        assert sink.state[3:] == (0, 50, 50)
        go.set()
        counters = [int.from_bytes(m["data"][:4].tobytes(), "little") for m in receive(bus, 50)]
        assert counters == [0, *range(51, 100)], "the first was in hand already"
        wait_for(lambda: sink.state.sent == 50)
        sink.close()


def test_an_absent_or_failing_bus_is_reported_and_reopened(batch, wait_for, monkeypatch) -> None:
    monkeypatch.setattr(can_sink, "_RETRY_S", 0.05)
    broken = True
    send = can.interfaces.virtual.VirtualBus.send

    def failing(self: can.BusABC, message: can.Message, timeout: float | None = None) -> None:
        if broken:
            raise can.CanOperationError("transmit queue full")
        send(self, message, timeout)

    monkeypatch.setattr(can.interfaces.virtual.VirtualBus, "send", failing)
    with can.Bus("failing", "virtual") as bus:
        sink = CanSink("can://virtual/failing?profile=imu50-can", SERIAL)
        wait_for(lambda: sink.state.state == "ok")
        sink.publish(batch(1, 10))
        wait_for(lambda: sink.state.dropped == 10)
        broken = False
        counters = count(11)
        wait_for(lambda: sink.publish(batch(next(counters), 1)) or sink.state.sent)
        wait_for(lambda: sink.state.queued == 0)
        assert sink.state[1:3] == ("ok", True)
        assert sink.state.sent + sink.state.dropped == next(counters) - 1
        receive(bus, 2 * sink.state.sent)
        sink.close()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("can://virtual/x", r"expected the outgoing profile.*profile=imu50-can"),
        ("can://virtual/x?profile=imu50-rs422", "expected a port for the serial profile"),
        ("can://nothing/x?profile=imu50-can", "expected an interface of python-can"),
        ("can://virtual/x?profile=tools/psins-100hz.yaml", "psins-100hz"),
    ],
)
def test_an_impossible_gateway_is_refused(url: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CanSink(url, SERIAL)


@pytest.mark.parametrize(
    ("unit", "profile", "found"),
    [
        (
            "kvh1775",
            "imu50-can",
            "gyro: expected a profile for other units than pulses, as kvh1775 sends them",
        ),
        (
            "exail-asterix",
            "openimu-j1939",
            "accelerometer: expected a profile for the axes that exail-asterix has",
        ),
    ],
)
def test_a_profile_that_cannot_carry_the_units_numbers_is_refused_with_the_reason(
    unit: str, profile: str, found: str, tmp_path: Path
) -> None:
    layout = profiles.load(unit).layout()
    outgoing = tmp_path / "outgoing.yaml"  # at the unit's rate, so that only the numbers differ
    rate = f"sample_rate_hz: {1e9 / layout.interval_ns:g}".encode()
    outgoing.write_bytes(re.sub(rb"sample_rate_hz: \d+", rate, profiles.content(profile)))
    with pytest.raises(InputError, match=found):
        CanSink(f"can://virtual/refused?profile={outgoing}", layout)
