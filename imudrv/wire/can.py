"""CAN messages to frames: puts the messages of one sample together and finds its full counter."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import FRAME, MAX_TEMPERATURES, NO_TEMPERATURE, REJECT, Reason, Records
from imudrv.wire.fields import SLACK, ahead_of, check_holds, fill, read
from imudrv.wire.layout import COUNTER, Layout
from imudrv.wire.stream import Decoded
from imudrv.wire.tables import message_tables

OPEN_SAMPLES: Final = 4
"""Incomplete samples kept at a time: the order of ids may interleave neighbours."""
LATE: Final = 64
"""A message up to this many samples behind the newest one is doubled; farther, the unit has restarted."""

_NO_FRAMES: Final = np.zeros(0, FRAME)
_NO_REJECTS: Final = np.zeros(0, REJECT)
_LONGEST: Final = 64
_ROOM: Final = _LONGEST + SLACK
_WRONG_LENGTH: Final = int(Reason.WRONG_LENGTH)
_CHECK_FAILED: Final = int(Reason.CHECK_FAILED)
_TORN: Final = int(Reason.TORN)
_STALE: Final = int(Reason.STALE)

_ID, _LENGTH, _COUNTER_AT, _IS_PART, _IS_FULL, _FIELD, _CONSTANT = range(7)
"""Columns of the table of kinds; the last two: where its rows begin in the tables of fields and constants."""

_INDEX, _FOREIGN, _SLOW, _DISAGREED, _COUNTER, _HAS_SAMPLE, _IS_ANCHORED, _DAMAGED, _GIVEN_UP = range(9)
"""State: index of the next message; counts of messages and disagreements; counter of the newest sample,
whether one has come, whether its upper bits are settled; since the frame before: damaged messages, samples
given up."""


class CanAssembler:
    """Assembler of a CAN profile's samples; feed it messages as they come, in any pieces.

    A sample is complete when all messages that come with every sample have come with the same counter. The
    incomplete ones before it are then given up: their messages are `TORN`. A second message of the same kind
    and counter, or one for a sample up to `LATE` behind the newest, is `STALE`. A counter farther behind
    means that the unit has restarted, and what is known of it is forgotten.

    Messages that come with each k-th sample only (temperatures, status, full counter) hold from then on;
    temperatures are `NO_TEMPERATURE` before. Where such a message has a wider counter than the samples, they
    are held until the first one tells their full counter, 2 k samples at the most; if none comes they go out
    counted on from the first one's own counter. A later one that says otherwise is believed from then on.

    The frames and rejects are the same for any cut into pieces, and every message fed is part of a frame, a
    reject, `slow`, `foreign` or `pending`. It does not matter whether a message was CAN FD: identifier,
    length and check decide.

    Parameters
    ----------
    layout : Layout
        Of a CAN profile.
    """

    def __init__(self, layout: Layout) -> None:
        kinds = layout.messages
        self._tables = _tables(layout)
        self._parts = sum(kind.every == 1 for kind in kinds)
        self._begun = np.zeros(OPEN_SAMPLES, np.int64)
        self._have = np.zeros(OPEN_SAMPLES, np.int64)
        self._low = np.zeros(OPEN_SAMPLES, np.int64)
        self._index = np.zeros((OPEN_SAMPLES, len(kinds)), np.int64)
        self._data = np.zeros((OPEN_SAMPLES, len(kinds), _ROOM), np.uint8)
        self._held = _NO_FRAMES
        self._latest = np.zeros(1, FRAME)
        self._state = np.zeros(9, np.int64)
        _forget(self._state, self._latest, self._tables.hold)

    @property
    def messages_fed(self) -> int:
        """Messages fed since the beginning."""
        return int(self._state[_INDEX])

    @property
    def foreign(self) -> int:
        """Messages with identifiers that the profile does not know; a busy bus would flood the rejects."""
        return int(self._state[_FOREIGN])

    @property
    def slow(self) -> int:
        """Accepted messages of the kinds that do not come with every sample."""
        return int(self._state[_SLOW])

    @property
    def pending(self) -> int:
        """Messages of samples that are incomplete or held."""
        return sum(int(have).bit_count() for have in self._have) + self._held.size * self._parts

    @property
    def counter_disagreements(self) -> int:
        """How often a full counter was not the one expected."""
        return int(self._state[_DISAGREED])

    def feed(self, messages: Records) -> Decoded:
        """Take messages in.

        Parameters
        ----------
        messages : ndarray of MESSAGE, shape (n,)
            In the order of arrival.

        Returns
        -------
        Decoded
            What became complete with them. `offset` of a frame is the index of the message that completed it,
            `t_ns` that message's; `offset` of a reject is the index of the message, `length` 1. Indices count
            all messages ever fed.
        """
        held = self._held.size
        frames = np.zeros(held + messages.size, FRAME)
        frames[:held] = self._held
        rejects = np.zeros((messages.size + OPEN_SAMPLES * self._parts, 3), np.int64)
        released, found, rejected = _assemble(
            messages,
            self._tables,
            (self._begun, self._have, self._low, self._index, self._data),
            self._latest,
            self._state,
            frames,
            held,
            rejects,
        )
        # Copies and views of nothing would take a quarter of a live call.
        self._held = frames[released:found].copy() if released < found else _NO_FRAMES
        refused = rejects[:rejected].view(REJECT)[:, 0] if rejected else _NO_REJECTS
        return Decoded(frames[:released], refused)

    def close(self) -> Decoded:
        """End of the messages: held samples come out, incomplete ones as rejects."""
        torn = [
            (index, 1, Reason.TORN)
            for slot in np.argsort(self._begun)
            for kind, index in enumerate(self._index[slot])
            if self._have[slot] >> kind & 1
        ]
        self._have[:] = 0
        frames, self._held = self._held, self._held[:0]
        return Decoded(frames, np.array(torn, REJECT))


class _Tables(NamedTuple):
    """What the kernel reads of a layout; the rows of all kinds are stacked."""

    kinds: NDArray[np.int64]
    big_endian: bool
    fields: NDArray[np.int64]
    constants: NDArray[np.int64]
    checks: NDArray[np.int64]
    crc_tables: NDArray[np.uint32]
    whole: int  # one bit for each kind that is part of every sample
    low_bits: int
    full_bits: int
    hold: int  # samples to wait for a full counter


def _tables(layout: Layout) -> _Tables:
    kinds = layout.messages
    counters = [next((f for f in kind.fields if f.target == COUNTER), None) for kind in kinds]
    low_bits = next(f.bits for f, kind in zip(counters, kinds, strict=True) if f and kind.every == 1)
    rows: list[tuple[int, ...]] = []
    field = constant = hold = 0
    for kind, counter in zip(kinds, counters, strict=True):
        is_full = kind.every > 1 and counter is not None and counter.bits > low_bits
        at = counter.offset if counter else 0
        rows.append((kind.can_id, kind.length, at, kind.every == 1, is_full, field, constant))
        field += len(kind.fields)
        constant += len(kind.constants)
        hold = max(hold, 2 * kind.every * is_full)
    rows.append((-1, 0, 0, 0, 0, field, constant))
    tables = [message_tables(layout, kind) for kind in kinds]
    return _Tables(
        np.array(rows, np.int64),
        layout.big_endian,
        np.concatenate([t.fields for t in tables]),
        np.concatenate([t.constants for t in tables]),
        np.stack([t.check for t in tables]),
        np.stack([t.crc_table for t in tables]),
        sum(1 << k for k, kind in enumerate(kinds) if kind.every == 1),
        low_bits,
        max(f.bits for f in counters if f),
        hold,
    )


@kernel
def _assemble(messages, tables, slots, latest, state, frames, found, rejects):  # type: ignore[no-untyped-def]
    """Take all messages, after `found` held frames; how many are released, found and rejected."""
    # Out of the tuples once: each access inside the loop would count references.
    kinds, big_endian, fields, constants, checks, crc_tables, whole, low_bits, full_bits, hold = tables
    begun, have, low_counters, indices, slot_data = slots
    full_span = np.int64(1) << full_bits
    data = np.zeros(_ROOM, np.uint8)
    released = rejected = 0
    for i in range(messages.shape[0]):
        message = messages[np.uint64(i)]
        index = state[_INDEX]
        state[_INDEX] += 1
        k = _kind_of(message.id, kinds)
        if k < 0:
            state[_FOREIGN] += 1
            continue
        kind = kinds[k]
        if message.length != kind[_LENGTH]:
            state[_DAMAGED] += 1
            rejected = _reject(rejects, rejected, index, _WRONG_LENGTH)
            continue
        for b in range(kind[_LENGTH]):
            data[b] = message.data[b]
        if not (
            _constants_hold(data, constants, kind[_CONSTANT], kinds[k + 1, _CONSTANT])
            and check_holds(data, 0, big_endian, checks[k], crc_tables[k])
        ):
            state[_DAMAGED] += 1
            rejected = _reject(rejects, rejected, index, _CHECK_FAILED)
            continue

        if not kind[_IS_PART]:
            state[_SLOW] += 1
            fill(data, 0, fields[kind[_FIELD] : kinds[k + 1, _FIELD]], big_endian, latest[0])
            if kind[_IS_FULL]:
                shift = _anchor(state, latest[0].counter, low_bits, full_span)
                for f in range(released, found):
                    frames[f].counter = (frames[f].counter + shift) & (full_span - 1)
                released = found
            continue

        low = read(data, kind[_COUNTER_AT], low_bits, False, big_endian)
        if state[_HAS_SAMPLE]:
            ahead = ahead_of(low, state[_COUNTER], low_bits)
            if ahead < -LATE:
                for s in range(OPEN_SAMPLES):
                    rejected = _give_up(s, have, indices, state, rejects, rejected)
                released = found
                _forget(state, latest, hold)
            elif ahead <= 0:
                rejected = _reject(rejects, rejected, index, _STALE)
                continue

        slot = _slot_of(low, begun, have, low_counters)
        if have[slot] and low_counters[slot] != low:
            rejected = _give_up(slot, have, indices, state, rejects, rejected)
        if have[slot] == 0:
            begun[slot] = index
            low_counters[slot] = low
        bit = 1 << k
        if have[slot] & bit:
            rejected = _reject(rejects, rejected, index, _STALE)
            continue
        have[slot] |= bit
        indices[slot, k] = index
        for b in range(kind[_LENGTH]):
            slot_data[slot, k, b] = data[b]
        if have[slot] != whole:
            continue

        have[slot] = 0
        for s in range(OPEN_SAMPLES):
            if ahead_of(low_counters[s], low, low_bits) < 0:
                rejected = _give_up(s, have, indices, state, rejects, rejected)
        if state[_HAS_SAMPLE] or state[_IS_ANCHORED]:
            state[_COUNTER] = (state[_COUNTER] + ahead_of(low, state[_COUNTER], low_bits)) & (full_span - 1)
        else:
            state[_COUNTER] = low
        state[_HAS_SAMPLE] = 1
        frames[found] = latest[0]
        frame = frames[found]
        found += 1
        for part in range(kinds.shape[0] - 1):
            if whole >> part & 1:
                rows = fields[kinds[part, _FIELD] : kinds[part + 1, _FIELD]]
                fill(slot_data[slot, part], 0, rows, big_endian, frame)
        frame.counter = state[_COUNTER]
        frame.offset = index
        frame.t_ns = message.t_ns
        frame.damaged = state[_DAMAGED]
        frame.torn = state[_GIVEN_UP]
        state[_DAMAGED] = state[_GIVEN_UP] = 0
        if found - released > hold:
            state[_IS_ANCHORED] = 1
        if state[_IS_ANCHORED]:
            released = found
    return released, found, rejected


@kernel
def _forget(state, latest, hold):  # type: ignore[no-untyped-def]
    """Know nothing of the unit any more; counts stay."""
    state[_COUNTER] = 0
    state[_HAS_SAMPLE] = 0
    state[_IS_ANCHORED] = hold == 0
    latest[0].status = 0
    for channel in range(MAX_TEMPERATURES):
        latest[0].temperature[channel] = NO_TEMPERATURE


@kernel
def _anchor(state, full, low_bits, full_span):  # type: ignore[no-untyped-def]
    """Settle the counter by the full one of a recent sample; how far off it was."""
    shift = np.int64(0)
    if state[_HAS_SAMPLE]:
        expected = state[_COUNTER] + ahead_of(full, state[_COUNTER], low_bits)
        shift = (full - expected) & (full_span - 1)
        state[_COUNTER] = (state[_COUNTER] + shift) & (full_span - 1)
        state[_DISAGREED] += shift != 0 and state[_IS_ANCHORED]
    else:
        state[_COUNTER] = full
    state[_IS_ANCHORED] = 1
    return shift


@kernel
def _kind_of(identifier, kinds):  # type: ignore[no-untyped-def]
    """Row of the kind with this identifier; -1 for a foreign one."""
    for k in range(kinds.shape[0] - 1):
        if kinds[k, _ID] == identifier:
            return k
    return -1


@kernel
def _constants_hold(data, constants, first, stop):  # type: ignore[no-untyped-def]
    """Whether the bytes that never change are as they should be."""
    holds = True
    for c in range(first, stop):
        holds &= data[constants[c, 0]] == constants[c, 1]
    return holds


@kernel
def _slot_of(low, begun, have, low_counters):  # type: ignore[no-untyped-def]
    """Slot of the open sample `low`; otherwise a free one; otherwise the one begun first."""
    slot = 0
    for s in range(OPEN_SAMPLES):
        if have[s] and low_counters[s] == low:
            return s
        if have[slot] and (have[s] == 0 or begun[s] < begun[slot]):
            slot = s
    return slot


@kernel
def _give_up(slot, have, indices, state, rejects, rejected):  # type: ignore[no-untyped-def]
    """Reject the messages of the sample in `slot`, if there is one, as torn."""
    state[_GIVEN_UP] += have[slot] != 0
    for k in range(indices.shape[1]):
        if have[slot] >> k & 1:
            rejected = _reject(rejects, rejected, indices[slot, k], _TORN)
    have[slot] = 0
    return rejected


@kernel
def _reject(rejects, rejected, index, reason):  # type: ignore[no-untyped-def]
    """Add the message `index` to the rejects."""
    rejects[rejected, 0] = index
    rejects[rejected, 1] = 1
    rejects[rejected, 2] = reason
    return rejected + 1
