import os
import select
import socket
import subprocess
import sys
import threading
import time
import tty
from contextlib import suppress

import can
import numpy as np
import pytest
from realtime import DEADLINE_S, free_port

from imudrv import Source, load_profile
from imudrv.errors import InputError
from imudrv.hostclock import now_ns
from imudrv.ports import PortLostError, open_port
from imudrv.ports.can_port import CanPort
from imudrv.records import EXTENDED, MESSAGE

GROUP = "239.74.163.2"


def _bus(channel, **options):
    return can.Bus(channel, "virtual", ignore_config=True, **options)


def _message(identifier=0x150, data=b"\x01\x02\x03", **more):
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=identifier > 0x7FF, **more)


def test_messages_are_records_stamped_on_arrival(can_profile, opened, arrivals):
    port = opened("can://virtual/stamped", can_profile)
    assert port.source is Source.HARDWARE
    before = now_ns()
    with _bus("stamped") as unit:
        for k in range(300):
            unit.send(_message(0x150 + k % 4, bytes([k % 256] * (k % 9))))
    found = arrivals(port, 300)
    after = now_ns()
    messages = np.concatenate([arrival.data for arrival in found])
    expected = np.zeros(300, MESSAGE)
    expected["t_ns"] = messages["t_ns"]
    for k, row in enumerate(expected):
        row["id"], row["length"] = 0x150 + k % 4, k % 9
        row["data"][: k % 9] = k % 256
    assert messages.dtype == MESSAGE
    assert np.array_equal(messages, expected)
    assert np.all(np.diff([before, *messages["t_ns"], after]) >= 0)
    assert all(arrival.t_ns >= arrival.data["t_ns"][-1] for arrival in found)
    assert all(arrival.data.flags.writeable for arrival in found)


def test_a_timeout_returns_no_messages(can_profile, opened):
    nothing = opened("can://virtual/silent", can_profile).read(0.01).data
    assert nothing.dtype == MESSAGE
    assert nothing.size == 0


def test_a_long_can_fd_message_is_received_complete(canfd, opened, arrivals):
    port = opened("can://virtual/fd", canfd)
    with _bus("fd", protocol=can.CanProtocol.CAN_FD) as unit:
        unit.send(_message(0x158, bytes(range(48)), is_fd=True, bitrate_switch=True))
    (message,) = arrivals(port, 1)[0].data
    assert (message["id"], message["length"], message["fd"]) == (0x158, 48, 1)
    assert bytes(message["data"]) == bytes(range(48)) + bytes(16)


def test_only_data_of_the_units_own_identifiers_are_received(can_profile, opened, arrivals):
    port = opened("can://virtual/busy", can_profile)
    with _bus("busy") as unit:
        for identifier in (0x7, 0x14F, 0x150, 0x18000150, 0x154):
            unit.send(_message(identifier))
        unit.send(_message(0x151, b"", is_remote_frame=True))
        unit.send(_message(0x153))
    assert [int(id) for arrival in arrivals(port, 2) for id in arrival.data["id"]] == [0x150, 0x153]


def test_an_identifier_of_29_bits_is_received_and_differs_from_one_of_11_bits(can_profile, opened, arrivals):
    messages = (can_profile.messages[0].model_copy(update={"id": 0x1ABCDEF0}), *can_profile.messages[1:])
    port = opened("can://virtual/extended", can_profile.model_copy(update={"messages": messages}))
    with _bus("extended") as unit:
        unit.send(can.Message(arbitration_id=0x151, is_extended_id=True))
        unit.send(_message(0x1ABCDEF0))
        unit.send(_message(0x151))
    received = np.concatenate([arrival.data for arrival in arrivals(port, 2)])
    assert received["id"].tolist() == [EXTENDED | 0x1ABCDEF0, 0x151]


def test_of_a_parameter_group_every_priority_and_source_comes(opened, arrivals):
    port = opened("can://virtual/groups", load_profile("openimu-j1939"))
    sent = [0x0CF02A80, 0x18F02D81, 0x0CF02B80, 0x0CF02D80]
    with _bus("groups") as unit:
        for identifier in sent:
            unit.send(_message(identifier))
    received = np.concatenate([arrival.data for arrival in arrivals(port, 3)])
    assert received["id"].tolist() == [
        EXTENDED | identifier for identifier in sent if identifier != 0x0CF02B80
    ]


def test_a_bus_that_filters_nothing_gives_both_kinds_of_identifier(arrivals):
    with _bus("unfiltered") as unit:
        port = CanPort("can://virtual/unfiltered", _bus("unfiltered"))
        unit.send(can.Message(arbitration_id=0x150, is_extended_id=True))
        unit.send(_message(0x150))
        received = np.concatenate([arrival.data for arrival in arrivals(port, 2)])
        port.close()
    assert received["id"].tolist() == [EXTENDED | 0x150, 0x150]


class Broken(can.BusABC):
    """A bus with given faults."""

    def __init__(self, trouble, state=can.BusState.ACTIVE):
        self.trouble = trouble
        self._state = state
        super().__init__("broken")

    @property
    def state(self):
        return self._state

    def send(self, msg, timeout=None):
        raise NotImplementedError

    def _recv_internal(self, timeout):
        trouble, self.trouble = self.trouble, None
        if isinstance(trouble, Exception):
            raise trouble
        return trouble, True


OTHER_ERROR = can.Message(arbitration_id=0x4, is_error_frame=True, is_extended_id=False)
BUS_OFF = can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False)


@pytest.mark.parametrize(
    ("bus", "message"),
    [
        (Broken(BUS_OFF), "the controller is bus-off; check wiring and bit rate"),
        (Broken(None, can.BusState.ERROR), "the controller is bus-off"),
        (Broken(OSError(19, "No such device")), "No such device"),
        (Broken(AssertionError()), "AssertionError"),
        (Broken(can.CanOperationError("Error receiving: gone", 6)), "Error receiving: gone"),
        (Broken(can.CanOperationError("down", 100)), "interface is down; `sudo ip link set NAME up"),
    ],
    ids=["error frame", "state", "system error", "surprise", "driver error", "interface down"],
)
def test_a_bus_that_goes_away_is_a_lost_port(bus, message):
    port = CanPort("can://broken/0", bus)
    with pytest.raises(PortLostError, match=message):
        port.read(0)
    port.close()


@pytest.mark.parametrize("nonsense", [ValueError("no number"), IndexError("dlc"), OTHER_ERROR])
def test_an_invalid_message_or_a_transient_error_is_no_message_and_no_loss(nonsense):
    port = CanPort("can://broken/0", Broken(nonsense))
    assert port.read(0).data.size == 0
    port.close()


def test_a_closed_port_is_closed_once_and_lost_when_read(can_profile, opened):
    port = opened("can://virtual/closed", can_profile)
    port.close()
    port.close()
    with pytest.raises(PortLostError, match="the port is closed"):
        port.read(0)


def test_an_absent_can_interface_is_a_lost_port(can_profile):
    with pytest.raises(PortLostError, match=r"there is no CAN interface can77|kernel has no CAN"):
        open_port("can://socketcan/can77", can_profile)


@pytest.fixture
def adapter():
    """The far end of an slcan adapter's serial port, and its path."""
    far, near = os.openpty()
    tty.setraw(near)
    yield far, os.ttyname(near)
    os.close(near)
    os.close(far)


def commands(far: int, wanted: bytes) -> bool:
    """Read the commands to the adapter until the wanted commands have come."""
    got = bytearray()
    while wanted not in got and select.select([far], [], [], DEADLINE_S)[0]:
        got += os.read(far, 100)
    return wanted in got


def test_an_slcan_adapter_is_opened_by_its_path_and_set_to_the_bit_rate(
    adapter, can_profile, opened, arrivals
):
    far, path = adapter
    port = opened(f"can://slcan/{path}?sleep_after_open=0", can_profile)
    assert commands(far, b"S8\r")  # 1 Mbit/s
    os.write(far, b"\r\at1503010203\rtXYZ3\rt1518" + b"0011223344556677\r")
    messages = np.concatenate([arrival.data for arrival in arrivals(port, 2)])
    assert messages["id"].tolist() == [0x150, 0x151]
    assert bytes(messages["data"][0, :3]) == b"\x01\x02\x03"


def test_an_slcan_adapter_gets_the_data_bit_rate_of_a_can_fd_profile(adapter, canfd, opened):
    far, path = adapter
    opened(f"can://slcan/{path}?sleep_after_open=0", canfd)
    assert commands(far, b"S8\rY5\r")


def test_an_unplugged_slcan_adapter_is_lost_and_leaves_nothing_open(can_profile):
    far, near = os.openpty()
    tty.setraw(near)
    before = descriptors()
    port = open_port(f"can://slcan/{os.ttyname(near)}?sleep_after_open=0", can_profile)
    opened = descriptors() - before
    assert len(opened) >= 5, "the device and four ends of pipes"
    os.close(far)
    with pytest.raises(PortLostError):
        port.read(1)
    port.close()
    assert not opened & descriptors()
    os.close(near)


def descriptors() -> set[tuple[str, str]]:
    """Open descriptors of this process, and what each one is of: other threads have theirs."""
    found = set()
    for fd in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # closed since
            found.add((fd, os.readlink(f"/proc/self/fd/{fd}")))
    return found


def test_an_absent_slcan_adapter_is_reported_with_the_existing_ports(can_profile):
    with pytest.raises(PortLostError, match=r"there is no /dev/no-such; there (are|is)"):
        open_port("can://slcan//dev/no-such", can_profile)


def test_an_unusable_interface_is_a_mistake_of_the_user(can_profile):
    with pytest.raises(InputError, match="bitrate: expected at most 1000000"):
        open_port("can://virtual/x?bitrate=2000000", can_profile)
    with pytest.raises(InputError, match="Invalid bitrate, choose one of"):
        open_port("can://slcan/loop://?sleep_after_open=0&bitrate=12345", can_profile)


SENDER = f"""
import sys, can
with can.Bus({GROUP!r}, "udp_multicast", port=int(sys.argv[1]), ignore_config=True) as bus:
    for line in sys.stdin:
        first, last = map(int, line.split())
        for k in range(first, last):
            data = k.to_bytes(4, "little") * 12
            bus.send(can.Message(arbitration_id=0x158, data=data, is_extended_id=False, is_fd=True))
"""


def test_messages_of_another_process_arrive_in_order_and_a_foreign_datagram_is_ignored(canfd, opened):
    pytest.importorskip("msgpack")
    number = free_port()
    port = opened(f"can://udp_multicast/{GROUP}?port={number}", canfd)
    command = [sys.executable, "-c", SENDER, str(number)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True) as sender:
        found, asked = [], 0
        deadline = time.monotonic() + DEADLINE_S
        while asked < 2000:  # at most a hundred on the way: UDP may lose what a buffer cannot hold
            print(asked, asked + 100, file=sender.stdin, flush=True)
            asked += 100
            while sum(map(len, found)) < asked and time.monotonic() < deadline:
                found.append(port.read(0.2).data)
        messages = np.concatenate(found)
        assert messages["data"][:, :4].copy().view("<u4")[:, 0].tolist() == list(range(2000))
        assert messages["fd"].all()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"\xc1 no message", (GROUP, number))
        print(2000, 2001, file=sender.stdin, flush=True)
        while not (last := port.read(0.2).data).size:
            assert time.monotonic() < deadline
        assert last["data"][0, :4].copy().view("<u4")[0] == 2000
        sender.stdin.close()


def test_a_package_that_is_missing_is_named(can_profile, monkeypatch):
    monkeypatch.setattr("can.interfaces.udp_multicast.utils.msgpack", None)
    with pytest.raises(InputError, match="msgpack not installed; pip install msgpack"):
        open_port(f"can://udp_multicast/{GROUP}", can_profile)


def test_threads_on_a_virtual_bus_lose_nothing(can_profile, opened, arrivals):
    port = opened("can://virtual/threads", can_profile)

    def send():
        with _bus("threads") as unit:
            for k in range(2000):
                unit.send(_message(0x150, k.to_bytes(2, "little")))

    sender = threading.Thread(target=send)
    sender.start()
    messages = np.concatenate([arrival.data for arrival in arrivals(port, 2000)])
    sender.join()
    assert messages["data"][:, :2].copy().view("<u2")[:, 0].tolist() == list(range(2000))
