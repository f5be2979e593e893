"""Every form in which a capture comes gives the same samples, or says what it is and what to do."""

import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zstandard
from realtime import DEADLINE_S

import imudrv
from imudrv.cli import main
from imudrv.errors import InputError
from imudrv.imu.sequence import SampleCounts
from imudrv.records import Reason, Records
from imudrv.wire.candump import CandumpDecoder

CAN_FORMS = (
    "base.log",
    "zero.log",
    "dec8.log",
    "errframes.log",
    "fdflags.log",
    "screen.log",
    "screen_t.log",
    "screen_A.log",
    "base.log.gz",
    "base.asc",
    "base.blf",
    "base.trc",
)
SERIAL_FORMS = ("base.raw", "hexdump.txt", "xxd.txt", "base.raw.gz")
DAMAGED = {
    "crlf.raw": (719, 81, 51, "text mode"),
    "xonxoff.raw": (448, 352, 168, "XON/XOFF"),
    "ff_doubled.raw": (601, 199, 50, "PARMRK"),
}
"""Samples good and damaged, gaps, and what the hint has to name."""


@pytest.fixture
def logs(data: Path) -> Path:
    return data / "field" / "logs"


def truth_of(unit: Path) -> dict[int, tuple[int, ...]]:
    """Pulses of all six axes by the low 16 bits of the counter."""
    rows = np.genfromtxt(unit, delimiter=",", names=True, dtype=np.int64)
    axes = [rows[name] for name in ("gx", "gy", "gz", "ax", "ay", "az")]
    return dict(
        zip((rows["counter"] % 2**16).tolist(), zip(*(a.tolist() for a in axes), strict=True), strict=True)
    )


def rows_of(pulses: Records) -> dict[int, tuple[int, ...]]:
    both = np.concatenate([pulses["gyro"], pulses["accelerometer"]], axis=1)
    return dict(zip((pulses["counter"] % 2**16).tolist(), map(tuple, both.tolist()), strict=True))


def read(path: Path, profile: str | None, channel: str | None = None) -> tuple[Records, imudrv.Capture]:
    capture = imudrv.Capture(path, profile, channel)
    size = 0

    def advance(count: int) -> None:
        nonlocal size
        size += count

    pulses = np.concatenate(list(capture.pulses(advance)))
    assert size == capture.size, "the progress ends at the end of the file"
    return pulses, capture


def lost(counts: SampleCounts) -> int:
    return counts.expected - counts.good


@pytest.mark.parametrize("name", [*CAN_FORMS, *SERIAL_FORMS, "canfd.log"])
@pytest.mark.parametrize("is_named", [True, False], ids=["with profile", "without profile"])
def test_a_capture_is_whole_in_every_form(logs: Path, name: str, is_named: bool) -> None:
    profile = {"canfd.log": "imu50-canfd"}.get(name, "imu50-can" if name in CAN_FORMS else "imu50-rs422")
    pulses, capture = read(logs / name, profile if is_named else None)
    assert capture.profile.name == profile
    assert rows_of(pulses) == truth_of(logs / "imu50-a.truth.csv")
    counts = capture.tracker.counts
    assert (counts.good, counts.expected, counts.lost, counts.duplicate) == (800, 800, 0, 0)
    errors = {Reason.ERROR_FRAME} if name == "errframes.log" else set()
    assert set(capture.rejected) == errors


@pytest.mark.parametrize(
    ("name", "first_s", "last_s"),
    [
        ("base.log", 1700000000.000028, 1700000000.799),
        ("screen_t.log", 1700000000.000028, 1700000000.799),
        ("screen_A.log", 1700000000.000028, 1700000000.799),
        ("base.blf", 1700000000.000028, 1700000000.799),
        ("base.trc", 1700000000.000028, 1700000000.799),
        ("base.asc", 0.0, 0.799),
        ("zero.log", 0.0, 0.799),
        ("screen.log", 0.0, 0.0),
    ],
)
def test_the_times_of_a_log_are_kept(logs: Path, name: str, first_s: float, last_s: float) -> None:
    messages = decoded(imudrv.Capture(logs / name, "imu50-can"))
    # a log has microseconds; the time of the last message scatters by 0.06 ms, and 0.1 ms a message
    assert messages["t_ns"][0] == pytest.approx(first_s * 1e9, abs=1000)
    assert messages["t_ns"][-1] == pytest.approx(last_s * 1e9, abs=500_000)


def decoded(capture: imudrv.Capture) -> Records:
    log = CandumpDecoder()
    return np.concatenate([log.feed(piece.data)[0] for piece in capture.file.pieces()])


def test_error_frames_are_counted_and_named_in_the_summary(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["decode", str(logs / "errframes.log"), "--profile", "imu50-can", "-o", str(tmp_path / "o.csv")])
        == 0
    )
    text = capsys.readouterr().out
    assert "800 samples by the counter = 800 good;" in text
    assert "error frame: 324 x" in text
    assert "324 error frames beside 1616 messages: the bus is faulty" in text


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_by_a_wrong_setting_is_counted_and_named(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    good, damaged, gaps, hint = DAMAGED[name]
    pulses, capture = read(logs / name, "imu50-rs422")
    truth, rows = truth_of(logs / "imu50-a.truth.csv"), rows_of(pulses)
    assert all(truth[counter] == row for counter, row in rows.items())
    assert (len(rows), lost(capture.tracker.counts)) == (good, damaged)
    steps = np.diff(pulses["counter"])
    flagged = pulses["flags"] & imudrv.Flag.MISSING_BEFORE != 0
    assert np.count_nonzero(steps > 1) == gaps
    np.testing.assert_array_equal(np.flatnonzero(flagged), np.flatnonzero(steps > 1) + 1)
    assert main(["decode", str(logs / name), "--profile", "imu50-rs422", "-o", str(tmp_path / "o.npz")]) == 0
    text = capsys.readouterr().out
    assert f"{good} good + {damaged} damaged" in text
    assert text.count("hint:") == 1
    assert hint in text


def test_a_sound_capture_gives_no_hint(logs: Path) -> None:
    _, capture = read(logs / "base.raw", "imu50-rs422")
    assert capture.hints == []


@pytest.mark.parametrize("suffix", ["", ".gz", ".zst"])
@pytest.mark.parametrize("form", ["any.log", "any.asc", "any.blf", "any.trc"])
def test_a_log_of_two_channels_is_refused_with_their_names_or_read_by_one(
    logs: Path, tmp_path: Path, form: str, suffix: str
) -> None:
    path, names = two_channels(logs, tmp_path / form)
    packers = {"": bytes, ".gz": gzip.compress, ".zst": zstandard.compress}
    packed = tmp_path / f"{form}{suffix}"
    packed.write_bytes(packers[suffix](path.read_bytes()))
    for profile in ("imu50-can", None):
        with pytest.raises(
            InputError, match=f"got those of {names[0]} and {names[1]}; choose one, as with --channel"
        ):
            read(packed, profile)
    for channel, unit in zip(names, "ab", strict=True):
        pulses, capture = read(packed, "imu50-can", channel)
        assert rows_of(pulses) == truth_of(logs / f"imu50-{unit}.truth.csv")
        assert capture.tracker.counts.good == 800


def two_channels(logs: Path, path: Path) -> tuple[Path, tuple[str, str]]:
    """The log of two units in another form, and the names of its channels there."""
    import can

    if path.suffix == ".log":
        path.write_bytes((logs / "any.log").read_bytes())
        return path, ("can0", "can1")
    with can.Logger(path) as writer:
        for message in can.CanutilsLogReader(logs / "any.log"):
            message.channel = int(message.channel.removeprefix("can"))  # the formats count from 1
            writer.on_message_received(message)
    return path, ("1", "2")


@pytest.mark.parametrize(
    ("name", "arguments", "code", "message"),
    [
        ("base.blf", [], 0, "base.blf: imu50-can, 14122 bytes of a Vector BLF log -> out.csv"),
        ("base.raw.gz", [], 0, "profile imu50-rs422: found, for it fits best of the shipped ones"),
        ("any.log", [], 2, "got those of can0 and can1; choose one, as with --channel can0"),
        ("base.asc", ["--profile", "imu50-rs422"], 2, "expected wire bytes for imu50-rs422, got an ASC log"),
        ("xxd.txt", ["--profile", "imu50-can"], 2, "expected a CAN log for imu50-can, got a hex dump"),
        (
            "base.raw",
            ["--profile", "imu50-can"],
            2,
            "its beginning has frames of imu50-rs422: try --profile imu50-rs422",
        ),
        ("README.md", [], 2, "got text of no known form, which none of them fits; choose the unit's with"),
    ],
)
def test_the_command_says_what_it_read_or_why_not(
    logs: Path, tmp_path: Path, name: str, arguments: list[str], code: int, message: str
) -> None:
    command = [sys.executable, "-m", "imudrv", "decode", str(logs / name), *arguments, "-o", "out.csv"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == code
    assert message in (done.stderr if code else done.stdout)
    assert (tmp_path / "out.csv").exists() == (code == 0)
    assert "Traceback" not in done.stderr


def test_two_profiles_that_fit_equally_well_are_named(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    twin = imudrv.load_profile("imu50-rs422")
    monkeypatch.setattr("imudrv.capture.profiles.shipped", lambda: ["imu50-rs422", "twin"])
    monkeypatch.setattr("imudrv.capture.profiles.load", lambda name: twin.model_copy(update={"name": name}))
    with pytest.raises(InputError, match="fits imu50-rs422 and twin equally well; choose one with --profile"):
        imudrv.Capture(logs / "base.raw")
