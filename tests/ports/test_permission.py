"""Advice to a user who may not open a device."""

import os
from pathlib import Path

import pytest

from imudrv.ports.permission import permission_advice

DEVICE = Path("/dev/ttyUSB0")


def of_group(monkeypatch: pytest.MonkeyPatch, number: int, name: str, mode: int) -> None:
    """Every device belongs to this group, and its users have these permissions."""
    monkeypatch.setattr(
        Path, "stat", lambda _: os.stat_result((0o020000 | mode, 0, 0, 1, 0, number, 0, 0, 0, 0))
    )
    monkeypatch.setattr(Path, "group", lambda _: name)


def test_a_group_with_access_is_named_and_how_to_join_it(monkeypatch: pytest.MonkeyPatch) -> None:
    of_group(monkeypatch, 20, "dialout", 0o660)
    assert permission_advice(DEVICE).startswith(
        "its group is dialout: `sudo usermod -aG dialout $USER`, then log"
    )
    assert "99-imu50.rules" in permission_advice(DEVICE)


@pytest.mark.parametrize(
    ("number", "name", "mode"), [(0, "root", 0o660), (20, "dialout", 0o600), (5, "tty", 0o620)]
)
def test_nobody_is_advised_to_join_the_group_of_root_or_one_without_access(
    monkeypatch: pytest.MonkeyPatch, number: int, name: str, mode: int
) -> None:
    of_group(monkeypatch, number, name, mode)
    assert "usermod" not in permission_advice(DEVICE)
    assert "install the udev rules 99-imu50.rules, which `imudrv files --to DIR` writes" in permission_advice(
        DEVICE
    )


def test_a_device_that_has_gone_gets_advice_too(tmp_path: Path) -> None:
    assert permission_advice(tmp_path / "gone") == "run as a user with permission"
