"""Random choices, damage and cuts."""

from collections.abc import Sequence
from typing import Any

from numpy.random import Generator


def pick(rng: Generator, choices: Sequence[Any]) -> Any:
    """Return one of the choices with its own type; numpy would convert it."""
    return choices[int(rng.integers(len(choices)))]


def small_number(rng: Generator, most: int = 300) -> int:
    """Return a number below `most`, usually a small one."""
    return int(rng.integers(pick(rng, (2, 5, 30, 30, most))))


def mutated(rng: Generator, data: bytes, tokens: Sequence[bytes], unit: int = 1) -> bytes:
    """Return data damaged in up to a dozen places, in multiples of `unit` bytes; `tokens` are inserted."""
    out = bytearray(data)
    for _ in range(int(rng.integers(12))):
        at = int(rng.integers(len(out) // unit + 1)) * unit
        end = at + int(rng.geometric(0.1)) * unit
        action = int(rng.integers(16))
        if action < 5 and at < len(out):
            out[at + int(rng.integers(unit))] ^= 1 << int(rng.integers(8))
        elif action < 7:
            del out[at:end]
        elif action < 9:
            out[at:at] = rng.bytes(end - at)
        elif action < 11:
            out[at:at] = out[at:end]
        elif action < 15:
            token = pick(rng, tokens)
            out[at : at + len(token) * (action % 2)] = token
        elif at > len(out) // 2:
            del out[at:]
    return bytes(out)


def random_cuts(rng: Generator, size: int) -> list[int]:
    """Return where the input is cut: at every byte, at many places or at few."""
    if size < 300 and rng.integers(3) == 0:
        return list(range(size))
    return sorted(rng.integers(0, size + 1, pick(rng, (1, 3, 10, 60))).tolist())
