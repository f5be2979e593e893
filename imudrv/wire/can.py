"""CAN messages to frames: joins the messages of one sample and determines its full counter.

The messages of a sample have the same counter, or, where not all have one, follow each other in the order of
the profile within half a sample interval.
"""

from typing import Final, TypeAlias

import numpy as np

from imudrv.kernels import kernel
from imudrv.records import FRAME, MAX_TEMPERATURES, REJECT, Reason, Records
from imudrv.wire.fields import SLACK, Bytes, ahead_of, checks_hold, fill, hold, number, plain_check_holds
from imudrv.wire.layout import MAX_MESSAGES, NARROW_BITS, Layout, SequenceKind
from imudrv.wire.stream import Decoded
from imudrv.wire.tables import Tables, layout_tables

OPEN_SAMPLES: Final = 4
"""Incomplete samples kept at a time: the order of ids may interleave neighbours."""
LATE: Final = 64
"""A message at most this many samples before the newest is a duplicate; if older, the unit has restarted."""

_MAX_LENGTH: Final = 64
_EVER_NS: Final = 1 << 62
_ROOM: Final = _MAX_LENGTH + SLACK

CONSTANTS: Final = np.dtype(
    [
        ("all_parts", np.int64),  # one bit for each kind that comes with every sample
        ("low_bits", np.int64),  # of the counter in these
        ("full_bits", np.int64),  # of the widest counter
        ("hold", np.int64),  # samples to wait for a full counter
        ("late", np.int64),  # see `LATE`; 0 for a counter that wraps so soon that nothing counts as late
        ("is_ordered", np.bool_),  # the messages of a sample belong together by their order
        ("longest_ns", np.int64),  # from the first message of a sample to its last one
        ("inverted", np.uint32),  # status before any was received: no bit applies
        ("is_plain", np.bool_),  # the identifier alone gives the kind, and a plain check is all there is
    ],
    align=True,
)
"""Constants of a layout, in addition to its tables."""

SLOT: Final = np.dtype(
    [
        ("parts", np.int64),  # one bit for each kind that has come; 0: the slot is free
        ("begun", np.int64),  # index of the first message
        ("begun_ns", np.int64),  # its time
        ("low", np.int64),  # low bits of the counter
        ("index", np.int64, MAX_MESSAGES),  # of the message of each kind
        ("data", np.uint8, (MAX_MESSAGES, _ROOM)),
    ],
    align=True,
)
"""An incomplete sample."""

STATE: Final = np.dtype(
    [
        ("index", np.int64),  # of the next message
        ("source", np.int64),  # J1939 source address of the unit, once known; -1 before
        ("foreign", np.int64),  # counts since the beginning
        ("slow", np.int64),
        ("disagreements", np.int64),
        ("counter", np.int64),  # of the newest sample
        ("has_sample", np.bool_),
        ("is_anchored", np.bool_),  # the upper bits of the counter are known
        ("held", np.int64),  # frames that wait for their full counter
        ("damaged", np.int64),  # messages since the frame before
        ("torn", np.int64),  # samples given up since the frame before
        ("latest", FRAME),  # status and temperatures that hold for the next sample
        ("released", np.int64),  # counts of the running call: frames that may go out,
        ("found", np.int64),  # these and those that are held,
        ("rejected", np.int64),  # rejects
    ],
    align=True,
)
"""State that a call of the kernels leaves to the next."""

CanArrays: TypeAlias = tuple[Tables, Records, Records, Records, Records]
"""Tables of the layout, constants, open samples, state, held frames."""

_SOURCE: Final = 0xFF
_WHOLE_ID: Final = 0xFFFFFFFF
_SOUND: Final = 0
_WRONG_LENGTH: Final = int(Reason.WRONG_LENGTH)
_CHECK_FAILED: Final = int(Reason.CHECK_FAILED)
_TORN: Final = int(Reason.TORN)
_STALE: Final = int(Reason.STALE)


class CanAssembler:
    """Assembler of a CAN profile's samples; feed it messages as they arrive, in any pieces.

    A sample is complete when all messages that come with every sample have come with the same counter. Older
    incomplete samples are then given up: their messages are `TORN`. A second message of the same kind and
    counter, or one for a sample at most `LATE` before the newest, is `STALE`. An older counter means that the
    unit has restarted, and its former state is forgotten.

    Messages that come with every k-th sample only (temperatures, status, full counter) hold from then on;
    temperatures are `NO_TEMPERATURE` before. If such a message has a wider counter than the samples, these
    are held until the first one gives their full counter, at most 2 k samples; without one they are released
    with counters that continue the first one's own. A later full counter that disagrees is used from then on.

    The frames and rejects are the same for any cut into pieces, and every message fed is part of a frame, a
    reject, `slow`, `foreign` or `pending`. It does not matter whether a message was CAN FD: identifier,
    length and check decide.

    Parameters
    ----------
    layout : Layout
        Layout of a CAN profile.
    """

    def __init__(self, layout: Layout) -> None:
        self._tables = layout_tables(layout)
        self._constants = _constants(layout, self._tables[0])
        self._parts = sum(kind.is_part for kind in layout.messages)
        self._slots = np.zeros(OPEN_SAMPLES, SLOT)
        self._held = np.zeros(self._constants["hold"][0] + 1, FRAME)
        self._state = np.zeros(1, STATE)
        _forget(self._constants[0], self._state[0])

    @property
    def messages_fed(self) -> int:
        """Number of messages fed so far."""
        return int(self._state[0]["index"])

    @property
    def foreign(self) -> int:
        """Messages with identifiers that the profile does not know; a busy bus would flood the rejects."""
        return int(self._state[0]["foreign"])

    @property
    def slow(self) -> int:
        """Accepted messages of the kinds that do not come with every sample."""
        return int(self._state[0]["slow"])

    @property
    def pending(self) -> int:
        """Messages of samples that are incomplete or held."""
        incomplete = sum(int(parts).bit_count() for parts in self._slots["parts"])
        return incomplete + int(self._state[0]["held"]) * self._parts

    @property
    def counter_disagreements(self) -> int:
        """Number of full counters that were not the expected ones."""
        return int(self._state[0]["disagreements"])

    @property
    def arrays(self) -> CanArrays:
        """Arguments of `assemble`."""
        return self._tables, self._constants, self._slots, self._state, self._held

    def most_frames(self, messages: int) -> int:
        """Return the largest number of frames that so many messages complete, held ones included."""
        return self._held.size + messages

    def most_rejects(self, messages: int) -> int:
        """Return the largest number of rejects that so many messages give."""
        return messages + OPEN_SAMPLES * self._parts

    def feed(self, messages: Records) -> Decoded:
        """Decode messages.

        Parameters
        ----------
        messages : ndarray of MESSAGE, shape (n,)
            In the order of arrival.

        Returns
        -------
        Decoded
            Frames and rejects that they complete. `offset` of a frame is the index of the message that
            completed it, `t_ns` that message's time; `offset` of a reject is the index of the message,
            `length` 1. Indices count all messages ever fed.
        """
        frames = np.zeros(self.most_frames(messages.size), FRAME)
        rejects = np.zeros(self.most_rejects(messages.size), REJECT)
        found, rejected = assemble(messages, *self.arrays, rejects, frames)
        return Decoded(frames[:found], rejects[:rejected])

    def close(self) -> Decoded:
        """End of the messages.

        Returns
        -------
        Decoded
            The samples that were held, and the messages of incomplete ones as rejects.
        """
        torn = [
            (index, 1, Reason.TORN)
            for slot in self._slots[np.argsort(self._slots["begun"])]
            for kind, index in enumerate(slot["index"].tolist())
            if slot["parts"] >> kind & 1
        ]
        self._slots["parts"] = 0
        frames = self._held[: self._state[0]["held"]].copy()
        self._state["held"] = 0
        return Decoded(frames, np.array(torn, REJECT))


def _constants(layout: Layout, kinds: Records) -> Records:
    parts, every = kinds["part"] >= 0, [message.every for message in layout.messages]
    bits = np.where(layout.sequence.kind == SequenceKind.COUNTER, kinds["sequence"]["bits"], 0)
    low_bits = bits[parts].max(initial=0)
    has_full_counter = bits > low_bits
    constants = np.zeros(1, CONSTANTS)
    constants["all_parts"] = sum(1 << k for k in np.flatnonzero(parts).tolist())
    constants["low_bits"], constants["full_bits"] = low_bits, bits.max()
    constants["hold"] = np.max(2 * np.array(every) * has_full_counter) if low_bits else 0
    constants["late"] = LATE if low_bits >= NARROW_BITS else 0
    constants["is_ordered"] = layout.is_ordered or not low_bits
    # Half of the time until another sample could be meant.
    period = 1 if constants["is_ordered"][0] else (1 << int(low_bits)) / layout.sequence.step
    constants["longest_ns"] = min(int(period * layout.interval / 2), _EVER_NS)
    constants["inverted"] = layout.status.inverted
    constants["is_plain"] = all(
        m.can_mask == _WHOLE_ID and not m.constants and m.checks in ((), (m.plain_check,))
        for m in layout.messages
    )
    return constants


@kernel
def assemble(
    messages: Records,
    tables: Tables,
    constants: Records,
    slots: Records,
    state: Records,
    held: Records,
    rejects: Records,
    frames: Records,
) -> tuple[int, int]:
    """Assemble the samples of messages.

    Parameters
    ----------
    messages : ndarray of MESSAGE
        In the order of arrival.
    tables, constants, slots, state, held
        `CanAssembler.arrays`.
    rejects : ndarray of REJECT
        Receives the rejects, see `CanAssembler.most_rejects`.
    frames : ndarray of FRAME
        Receives the frames, see `CanAssembler.most_frames`.

    Returns
    -------
    tuple of int
        Number of frames that may go out, and of rejects.
    """
    # Out of the tuple once: each access inside the loop would count references.
    kinds, fields, multiplexed, fixed_bytes, checks = tables
    c, s = constants[0], state[0]
    s["released"], s["found"], s["rejected"] = 0, s["held"], 0
    for f in range(s["held"]):
        frames[f] = held[f]
    data = np.zeros(_ROOM, np.uint8)
    for i in range(messages.shape[0]):
        message = messages[np.uint64(i)]
        k = (
            _plain_kind_of(message["id"], kinds)
            if c["is_plain"]
            else _kind_of(message, kinds, fixed_bytes, s)
        )
        if k < 0:
            s["foreign"] += 1
        else:
            kind = kinds[np.uint64(k)]
            if c["is_plain"]:
                fault = _plain_fault(message, data, kind)
            else:
                fault = _fault(message, data, kind, fixed_bytes, checks)
            if fault != _SOUND:
                s["damaged"] += 1
                _reject(s["index"], fault, s, rejects)
            elif kind["part"] < 0:
                s["slow"] += 1
                if not kind["is_skipped"]:
                    _take_slow(data, kind, fields, multiplexed, c, s, frames)
            else:
                if c["is_ordered"]:
                    complete = _take_in_order(data, k, kind, message["t_ns"], c, s, slots, rejects)
                else:
                    complete = _take_part(data, k, kind, message["t_ns"], c, s, slots, rejects)
                if complete >= 0:
                    if not c["is_ordered"]:
                        _advance(slots[complete]["low"], c, s)
                    _make_frame(frames, slots[complete], message["t_ns"], kinds, fields, multiplexed, c, s)
                    _release(c, s)
        s["index"] += 1
    s["held"] = s["found"] - s["released"]
    for f in range(s["held"]):
        held[f] = frames[s["released"] + f]
    return s["released"], s["rejected"]


@kernel
def _kind_of(message: np.void, kinds: Records, fixed_bytes: Records, s: np.void) -> int:
    """Return the row of the kind with this identifier and these constants; -1 for an unknown identifier.

    Where any source address is possible, that of the first message is the unit's.
    """
    identifier, best = np.int64(message["id"]), -1
    for k in range(kinds.shape[0]):
        kind = kinds[np.uint64(k)]
        if identifier & kind["can_mask"] != kind["can_id"]:
            continue
        if kind["can_mask"] & _SOURCE == 0:
            if s["source"] < 0:
                s["source"] = identifier & _SOURCE
            if identifier & _SOURCE != s["source"]:
                continue
        if _has_constants(message["data"], kind, fixed_bytes):
            return k
        if best < 0:
            best = k
    return best


@kernel
def _plain_kind_of(identifier: int, kinds: Records) -> int:
    """Return the row of the kind with this identifier; -1 for an unknown one. Faster than `_kind_of`."""
    for k in range(kinds.shape[0]):
        if kinds[np.uint64(k)]["can_id"] == identifier:
            return k
    return -1


@kernel
def _plain_fault(message: np.void, data: Bytes, kind: np.void) -> int:
    """Do what `_fault` does, without constants and with a plain check at most."""
    if message["length"] != kind["length"]:
        return _WRONG_LENGTH
    _copy(message["data"], data, kind["length"])
    return _SOUND if plain_check_holds(data, 0, kind) else _CHECK_FAILED


@kernel
def _has_constants(data: Bytes, kind: np.void, fixed_bytes: Records) -> bool:
    for f in range(kind["first_constant"], kind["end_constant"]):
        if data[fixed_bytes[f]["offset"]] != fixed_bytes[f]["value"]:
            return False
    return True


@kernel
def _fault(message: np.void, data: Bytes, kind: np.void, fixed_bytes: Records, checks: Records) -> int:
    """Copy the bytes of a message to `data`; return why they are not of this kind, or `_SOUND`."""
    if message["length"] != kind["length"]:
        return _WRONG_LENGTH
    _copy(message["data"], data, kind["length"])
    if _has_constants(data, kind, fixed_bytes) and checks_hold(data, 0, kind, checks):
        return _SOUND
    return _CHECK_FAILED


@kernel
def _copy(source: Bytes, target: Bytes, length: int) -> None:
    for b in range(np.uint64(length)):
        target[b] = source[b]


@kernel
def _take_slow(
    data: Bytes,
    kind: np.void,
    fields: Records,
    multiplexed: Records,
    c: np.void,
    s: np.void,
    frames: Records,
) -> None:
    """Take a message that does not come with every sample; a full counter releases the held frames."""
    fill(data, 0, kind, fields, multiplexed, s["latest"])
    if kind["sequence"]["bits"] > c["low_bits"] > 0:
        correction = _anchor(s["latest"]["counter"], c, s)
        for f in range(s["released"], s["found"]):
            frames[f]["counter"] = _wrapped(frames[f]["counter"] + correction, c)
        s["released"] = s["found"]


@kernel
def _anchor(full: int, c: np.void, s: np.void) -> int:
    """Set the counter by the full one of a recent sample; return by how much it changes."""
    if s["has_sample"]:
        expected = s["counter"] + ahead_of(full, s["counter"], c["low_bits"])
        correction = _wrapped(full - expected, c)
        s["counter"] = _wrapped(s["counter"] + correction, c)
        if correction != 0 and s["is_anchored"]:
            s["disagreements"] += 1
    else:
        correction = 0
        s["counter"] = full
    s["is_anchored"] = True
    return int(correction)


@kernel
def _take_part(
    data: Bytes, k: int, kind: np.void, t_ns: int, c: np.void, s: np.void, slots: Records, rejects: Records
) -> int:
    """Take a message that comes with every sample; return the slot that it completes, or -1."""
    low = number(data, 0, kind["sequence"])
    ahead = ahead_of(low, s["counter"], c["low_bits"]) if s["has_sample"] and c["late"] else 1
    if ahead < -c["late"]:
        _restart(c, s, slots, rejects)
    at = _slot_of(low, slots)
    slot, part = slots[at], np.int64(1) << k
    is_open = slot["parts"] != 0 and slot["low"] == low
    if is_open and not c["late"] and _is_late(t_ns, slot, c):
        _give_up(slot, s, rejects)
        is_open = False
    if -c["late"] <= ahead <= 0 or (is_open and slot["parts"] & part):
        _reject(s["index"], _STALE, s, rejects)
        return -1
    if not is_open:
        _give_up(slot, s, rejects)
        slot["begun"], slot["low"], slot["begun_ns"] = s["index"], low, t_ns
    if not _is_complete_with(data, k, kind, slot, c, s):
        return -1
    for other in range(OPEN_SAMPLES):
        if ahead_of(slots[other]["low"], low, c["low_bits"]) < 0:
            _give_up(slots[other], s, rejects)
    return at


@kernel
def _take_in_order(
    data: Bytes, k: int, kind: np.void, t_ns: int, c: np.void, s: np.void, slots: Records, rejects: Records
) -> int:
    """Take a message that follows the one before it in the sample; return the slot that it completes, or -1.

    `low` of the slot is the number of messages that have come.
    """
    slot = slots[0]
    if slot["parts"] and (kind["part"] != slot["low"] or _is_late(t_ns, slot, c)):
        _give_up(slot, s, rejects)
    if slot["parts"] == 0:
        if kind["part"]:
            s["torn"] += 1
            _reject(s["index"], _TORN, s, rejects)
            return -1
        slot["begun"], slot["low"], slot["begun_ns"] = s["index"], 0, t_ns
    slot["low"] += 1
    return 0 if _is_complete_with(data, k, kind, slot, c, s) else -1


@kernel
def _is_late(t_ns: int, slot: np.void, c: np.void) -> bool:
    """Whether a message is of a later sample, by its time if that is known."""
    return bool(t_ns != 0 and slot["begun_ns"] != 0 and t_ns - slot["begun_ns"] > c["longest_ns"])


@kernel
def _is_complete_with(data: Bytes, k: int, kind: np.void, slot: np.void, c: np.void, s: np.void) -> bool:
    """Put a message into its slot; return whether that completes the sample, and free the slot then."""
    slot["parts"] |= np.int64(1) << k
    slot["index"][k] = s["index"]
    _copy(data, slot["data"][k], kind["length"])
    if slot["parts"] != c["all_parts"]:
        return False
    slot["parts"] = 0
    return True


@kernel
def _slot_of(low: int, slots: Records) -> int:
    """Slot of the open sample `low`; otherwise a free one; otherwise the one begun first."""
    best = 0
    for i in range(OPEN_SAMPLES):
        slot = slots[i]
        if slot["parts"] and slot["low"] == low:
            return i
        if slots[best]["parts"] and (slot["parts"] == 0 or slot["begun"] < slots[best]["begun"]):
            best = i
    return best


@kernel
def _make_frame(
    frames: Records,
    slot: np.void,
    t_ns: int,
    kinds: Records,
    fields: Records,
    multiplexed: Records,
    c: np.void,
    s: np.void,
) -> None:
    """Make the next frame of a complete sample and of what holds since earlier messages."""
    frames[s["found"]] = s["latest"]
    frame = frames[s["found"]]
    for k in range(kinds.shape[0]):
        kind = kinds[np.uint64(k)]
        if kind["part"] >= 0:
            fill(slot["data"][np.uint64(k)], 0, kind, fields, multiplexed, frame)
    if multiplexed.shape[0]:
        hold(frame, s["latest"])
    if not c["is_ordered"]:
        frame["counter"] = s["counter"]
    frame["offset"], frame["t_ns"] = s["index"], t_ns
    frame["damaged"], frame["torn"] = s["damaged"], s["torn"]
    s["damaged"] = s["torn"] = 0
    s["found"] += 1


@kernel
def _advance(low: int, c: np.void, s: np.void) -> None:
    """Count on to the sample with these low bits."""
    if s["has_sample"] or s["is_anchored"]:
        s["counter"] = _wrapped(s["counter"] + ahead_of(low, s["counter"], c["low_bits"]), c)
    else:
        s["counter"] = low
    s["has_sample"] = True


@kernel
def _wrapped(counter: int, c: np.void) -> int:
    """Return the counter modulo its full width."""
    return int(counter & ((np.int64(1) << c["full_bits"]) - 1))


@kernel
def _restart(c: np.void, s: np.void, slots: Records, rejects: Records) -> None:
    """Handle a restart of the unit: reject open samples, release held frames, reset the state."""
    for i in range(OPEN_SAMPLES):
        _give_up(slots[i], s, rejects)
    s["released"] = s["found"]
    _forget(c, s)


@kernel
def _forget(c: np.void, s: np.void) -> None:
    """Reset the state of the unit; counts stay."""
    s["counter"], s["has_sample"], s["is_anchored"] = 0, False, c["hold"] == 0
    s["source"] = -1
    s["latest"]["status"] = c["inverted"]
    for channel in range(MAX_TEMPERATURES):
        s["latest"]["temperature"][channel] = np.nan


@kernel
def _release(c: np.void, s: np.void) -> None:
    """Release the frames if their full counter is known, or has not arrived in time."""
    if s["found"] - s["released"] > c["hold"]:
        s["is_anchored"] = True
    if s["is_anchored"]:
        s["released"] = s["found"]


@kernel
def _give_up(slot: np.void, s: np.void, rejects: Records) -> None:
    """Reject the messages of the sample in `slot`, if there is one, as torn."""
    if slot["parts"] == 0:
        return
    s["torn"] += 1
    for k in range(MAX_MESSAGES):
        if slot["parts"] >> k & 1:
            _reject(slot["index"][k], _TORN, s, rejects)
    slot["parts"] = 0


@kernel
def _reject(index: int, reason: int, s: np.void, rejects: Records) -> None:
    """Add the message `index` to the rejects."""
    reject = rejects[s["rejected"]]
    reject["offset"], reject["length"], reject["reason"] = index, 1, reason
    s["rejected"] += 1
