"""Any valid profile: what a unit sends is decoded again, and no input is lost without a reason."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from profile_strategy import profiles

from imudrv.imu.sequence import SequenceTracker
from imudrv.records import Flag, Records
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.layout import SequenceKind, Values
from tools.fuzz.any_profile import check_any_profile, layout_of, on_the_wire
from tools.fuzz.random_input import mutated
from tools.fuzz.sent import samples

SEEDS = st.integers(0, 2**32 - 1)
CUTS = st.lists(st.integers(0, 4000), max_size=6)
ANY_PROFILE = settings(
    max_examples=200, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)


@ANY_PROFILE
@given(profiles(), SEEDS, CUTS)
def test_what_a_unit_of_any_profile_sends_is_decoded_to_the_same_samples(
    document: dict[str, Any], seed: int, cuts: list[int]
) -> None:
    layout = layout_of(document)
    sent = samples(np.random.default_rng(seed), layout, 60, first=seed % 300)
    wire = on_the_wire(layout, sent)
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    pieces = np.split(wire, sorted(min(cut, len(wire)) for cut in cuts))
    frames = [decoder.feed(piece if layout.can else piece.tobytes()) for piece in pieces]
    got = np.concatenate([tracker.feed(piece) for piece in (*frames, decoder.close())])
    is_total = any(s.values is Values.TOTAL for s in layout.sensors if any(s.axes))
    assert decoder.rejected == {}
    assert tracker.counts.closes
    assert len(got) == len(sent) - is_total
    sent = sent[is_total:]
    numbering = sent["counter"] if layout.sequence.kind is SequenceKind.COUNTER else np.arange(len(sent))
    assert np.array_equal(np.diff(got["counter"]), np.diff(numbering))
    assert np.array_equal(got["interval_ns"], sent["interval_ns"])
    for name, sensor in (("gyro", layout.gyro), ("accelerometer", layout.accelerometer)):
        for axis, field in enumerate(sensor.axes):
            if field is None:
                assert np.isnan(got[name][:, axis]).all()
                continue
            # Half a count; of float64 a few bits are lost in its units, of float32 24 bits are left.
            count = sensor.per_count[axis]
            if sensor.values is Values.RATE:
                count *= layout.interval_ns * 1e-9
            assert got[name][:, axis] == pytest.approx(sent[name][:, axis], rel=1e-6, abs=0.5 * count)
    temperatures = got["temperature_degc"][:, : len(layout.temperature_names)]
    assert np.nanmax(abs(temperatures - 35.0), initial=0.0) < 1e-5
    by_status = Flag.FAULT | Flag.SATURATED | Flag.WARM_UP
    assert not np.any(got["flags"] & ~(Flag.VALID | by_status))
    if not document.get("status_bits"):
        assert set(got["flags"].tolist()) == {int(Flag.VALID)}


@ANY_PROFILE
@given(profiles(), SEEDS, CUTS, st.binary(max_size=40))
def test_damaged_input_of_any_profile_is_accounted_for_and_the_same_in_any_pieces(
    document: dict[str, Any], seed: int, cuts: list[int], noise: bytes
) -> None:
    layout, rng = layout_of(document), np.random.default_rng(seed)
    wire = on_the_wire(layout, samples(rng, layout, 30, first=seed % 70_000))
    unit = wire.itemsize
    tokens = [wire[: len(wire) // 5].tobytes(), wire[-2:].tobytes(), noise[: len(noise) // unit * unit]]
    check_any_profile(document, mutated(rng, wire.tobytes(), tokens, unit), [cut * unit for cut in cuts])


@ANY_PROFILE
@given(profiles(), st.binary(max_size=1600), CUTS)
def test_any_bytes_are_accounted_for_with_any_profile(
    document: dict[str, Any], data: bytes, cuts: list[int]
) -> None:
    size = len(data) // 80 * 80 if document["transport"] == "can" else len(data)
    check_any_profile(document, data[:size], cuts)


@ANY_PROFILE
@given(profiles(), SEEDS, st.lists(st.integers(0, 1000), max_size=40), st.integers(0, 40))
def test_reads_at_once_give_the_bits_of_read_by_read(
    document: dict[str, Any], seed: int, cuts: list[int], first: int
) -> None:
    layout, rng = layout_of(document), np.random.default_rng(seed)
    wire = on_the_wire(layout, samples(rng, layout, 20, first=seed % 70_000)).copy()
    if not layout.can:
        at = rng.integers(0, len(wire), 2)
        wire[at] = rng.integers(0, 256, 2)
    ends = np.array([*sorted(min(cut, len(wire)) for cut in cuts), len(wire)])
    times = np.cumsum(rng.integers(1, 10**7, len(ends)))
    singly, at_once = FrameDecoder(layout), FrameDecoder(layout)
    data = [wire[a:b] if layout.can else wire[a:b].tobytes() for a, b in pairwise([0, *ends.tolist()])]
    one = np.concatenate([singly.feed(read, int(t_ns)) for read, t_ns in zip(data, times, strict=True)])
    first = min(first, len(ends))
    cut = int(ends[first - 1]) if first else 0
    other = [
        at_once.feed_reads(wire[:cut], ends[:first], times[:first]),
        at_once.feed_reads(wire[cut:], ends[first:] - cut, times[first:]),
    ]
    assert same(np.concatenate(other), one)
    assert at_once.rejected == singly.rejected
    assert same(at_once.close(), singly.close())


def same(one: Records, other: Records) -> bool:
    """Whether records have the same bits in every column."""
    assert one.dtype.names is not None
    return len(one) == len(other) and all(one[n].tobytes() == other[n].tobytes() for n in one.dtype.names)
