"""Signs of a wrong setting in wire bytes: right for any cut, and none in sound bytes."""

import numpy as np
import pytest

from imudrv.capture_files import DamageSigns

SOUND = np.random.default_rng(11).bytes(40_000)
DAMAGE = {
    "text mode": SOUND.replace(b"\n", b"\r\n"),
    "XON/XOFF": SOUND.replace(b"\x11", b"").replace(b"\x13", b""),
    "PARMRK": SOUND.replace(b"\xff", b"\xff\xff"),
}


def hints(*pieces: bytes) -> list[str]:
    signs = DamageSigns()
    for piece in pieces:
        signs.feed(piece)
    return signs.hints


@pytest.mark.parametrize("name", DAMAGE)
@pytest.mark.parametrize("seed", range(5))
def test_each_damage_is_recognised_in_any_pieces(name: str, seed: int) -> None:
    data = DAMAGE[name]
    whole = hints(data)
    assert len(whole) == 1
    assert name in whole[0]
    cuts = np.sort(np.random.default_rng(seed).integers(0, len(data), 3000)).tolist()
    assert hints(*(data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True))) == whole
    assert hints(*(data[n : n + 1] for n in range(len(data)))) == whole


@pytest.mark.parametrize("name", DAMAGE)
def test_one_byte_that_the_damage_would_not_leave_disproves_it(name: str) -> None:
    lone = {"text mode": b"\0\n", "XON/XOFF": b"\0\x11", "PARMRK": b"\0\xff\0"}[name]
    data = DAMAGE[name]
    for at in (0, len(data) // 2, len(data)):
        assert hints(data[:at], lone, data[at:]) == []


def test_sound_or_few_bytes_have_no_sign() -> None:
    assert hints(SOUND) == hints() == hints(b"\r\n" * 7) == hints(bytes(10_000)) == []
