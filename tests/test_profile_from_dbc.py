"""Profiles that begin as a DBC file: what is mapped decodes as cantools does, all else becomes a comment."""

from importlib import resources
from pathlib import Path

import cantools
import numpy as np
import pytest

from imudrv import profiles
from imudrv.cli import main
from imudrv.errors import InputError
from imudrv.files.settings_file import read
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.dbc import FILL_IN, skeleton
from imudrv.profiles.schema import Profile
from imudrv.records import EXTENDED, MESSAGE, PULSES, Records
from imudrv.wire.can import CanAssembler
from imudrv.wire.encode import CanEncoder

# Big-endian numbers of 12 bits that share bytes, others beside them, offsets, a multiplexed signal.
PACKED = """VERSION ""
NS_ :
BS_:
BU_: IMU ECU
BO_ 2364549760 Rates: 8 IMU
 SG_ RollRate : 7|12@0- (0.05,0) [0|0] "deg/s" ECU
 SG_ PitchRate : 11|12@0- (0.05,0) [0|0] "deg/s" ECU
 SG_ yaw_rate : 31|12@0- (-0.1,0) [0|0] "deg/s" ECU
 SG_ RollingCounter : 32|4@1+ (1,0) [0|0] "" ECU
 SG_ Checksum : 56|8@1+ (1,0) [0|0] "" ECU
BO_ 2364550528 Accelerations: 8 IMU
 SG_ LatAccelY : 0|16@1+ (0.01,-320) [0|0] "m/s^2" ECU
 SG_ LongAccelX : 16|16@1+ (0.01,-320) [0|0] "m/s^2" ECU
 SG_ VertAccelZ : 32|16@1+ (0.01,-320) [0|0] "m/s^2" ECU
 SG_ RollingCounter : 48|4@1+ (1,0) [0|0] "" ECU
 SG_ Page M : 52|4@1+ (1,0) [0|0] "" ECU
 SG_ TempGyro m3 : 56|8@1- (1,0) [0|0] "degC" ECU
BO_ 100 Engine: 8 ECU
 SG_ FlowRate : 0|16@1+ (1,0) [0|0] "l/h" IMU
 SG_ Status : 16|8@1+ (1,0) [0|0] "" IMU
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "unit.dbc"
    path.write_text(text)
    return path


def profile_of(folder: Path, text: str) -> Profile:
    path = folder / "unit.yaml"
    path.write_text(text)
    return read(path, Profile)


def test_the_skeleton_of_our_own_dbc_decodes_as_our_own_profile(tmp_path: Path) -> None:
    with resources.as_file(resources.files("imudrv.profiles") / "imu50.dbc") as path:
        text = skeleton(path)
    assert text.count(FILL_IN) == 4  # the legend, the bit rate, a check of the other message, the status bits
    made = profile_of(tmp_path, text.replace("bitrate: 500000", "bitrate: 1000000")).layout()
    ours = profiles.load("imu50-can").layout()
    sent = np.zeros(500, PULSES)
    sent["counter"] = 65_300 + np.arange(500)
    random = np.random.default_rng(1)
    for sensor in ("gyro", "accelerometer"):
        sent[sensor] = random.integers(-30_000, 30_000, (500, 3))
    sent["temperature_degc"] = 35.12
    messages = CanEncoder(ours).encode(sent)
    rows = [_decoded(layout, messages) for layout in (made, ours)]
    assert len(rows[0]) == 500
    for column in rows[1].dtype.names or ():
        np.testing.assert_array_equal(rows[0][column], rows[1][column], err_msg=column)


def _decoded(layout, messages: Records) -> Records:
    assembler = CanAssembler(layout)
    frames = np.concatenate([assembler.feed(messages).frames, assembler.close().frames])
    return SequenceTracker(layout).feed(frames)


def test_packed_signals_decode_as_cantools_does(tmp_path: Path) -> None:
    profile = profile_of(tmp_path, skeleton(written(tmp_path, PACKED)))
    database = cantools.database.load_string(PACKED, "dbc")
    random = np.random.default_rng(2)
    sent = np.zeros(2 * 200, MESSAGE)
    values = []
    for n in range(200):
        both = {}
        for k, name in enumerate(("Rates", "Accelerations")):
            data = bytearray(random.integers(0, 256, 8, np.uint8).tobytes())
            data[6 if k else 4] = 0x30 | n % 16  # the page and the counter
            row = sent[2 * n + k]
            row["id"] = EXTENDED | database.get_message_by_name(name).frame_id
            row["length"], row["data"][:8] = 8, list(data)
            both |= database.decode_message(name, bytes(data), allow_truncated=True)
        values.append(both)
    layout = profile.layout()
    rows = _decoded(layout, sent)
    T = layout.interval_ns * 1e-9
    rates = [[v["RollRate"], v["PitchRate"], v["yaw_rate"]] for v in values]
    accelerations = [[v["LongAccelX"], v["LatAccelY"], v["VertAccelZ"]] for v in values]
    # cantools rounds scale and offset in other steps than the driver.
    np.testing.assert_allclose(np.degrees(rows["gyro"]) / T, rates, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rows["accelerometer"] / T, accelerations, rtol=1e-12, atol=1e-11)


def test_what_is_not_sure_is_a_comment(tmp_path: Path) -> None:
    lines = skeleton(written(tmp_path, PACKED)).splitlines()
    comments = [line.strip() for line in lines if line.strip().startswith("#")]
    for words in (
        ("Checksum", FILL_IN),
        ("Page", "says which"),
        ("TempGyro", "only while Page is 3"),
        ("Engine", "no signal of an inertial unit"),
        ("FlowRate", "of 'l/h'"),
        ("Status", "8 bits"),
    ):
        assert any(all(word in comment for word in words) for comment in comments), words
    assert any(line.startswith("sample_rate_hz") and FILL_IN in line for line in lines)


def test_a_message_of_j1939_becomes_a_parameter_group(tmp_path: Path) -> None:
    attributes = """BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_ "ProtocolType" STRING ;
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
BA_DEF_DEF_ "ProtocolType" "J1939";
BA_ "ProtocolType" "J1939";
BA_ "VFrameFormat" BO_ 2364549760 3;
"""
    profile = profile_of(tmp_path, skeleton(written(tmp_path, PACKED + attributes)))
    assert profile.messages[0].pgn == 0xF02A


def test_a_dbc_without_an_inertial_unit_says_what_to_fill_in(tmp_path: Path) -> None:
    text = skeleton(
        written(tmp_path, PACKED.partition("BO_ 2364549760")[0] + "BO_ 100" + PACKED.partition("BO_ 100")[2])
    )
    assert f"messages: []  # {FILL_IN}" in text
    assert f"# gyro: no signal of it is recognised; {FILL_IN}" in text


@pytest.mark.parametrize(
    "content", ["", "VERSION", "# a note\n", PACKED.replace("BO_ 100", "BO_ x"), "\0\1\2"]
)
def test_a_file_that_is_no_dbc_is_refused(content: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unit\.dbc: expected a DBC file"):
        skeleton(written(tmp_path, content))


def test_the_command_lists_prints_and_makes_profiles(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["profiles"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:4]] == list(profiles.OWN)
    assert sorted(line.split()[0] for line in lines) == profiles.shipped()
    assert any(line.startswith("kvh1775") and "serial  1000 Hz  KVH 1725/1750/1775" in line for line in lines)
    assert main(["profiles", "kvh1775"]) == 0
    assert capsys.readouterr().out.encode() == profiles.content("kvh1775")
    assert main(["profiles", "from-dbc", str(written(tmp_path, PACKED))]) == 0
    assert capsys.readouterr().out == skeleton(tmp_path / "unit.dbc")
    for mistake, said in (
        (["from-dbc"], "from-dbc FILE.dbc"),
        (["kvh1775", "x.dbc"], "a profile's name alone"),
        (["from-dbc", "absent.dbc"], "absent.dbc"),
        (["nix"], "another one that `imudrv profiles` lists"),
    ):
        assert main(["profiles", *mistake]) == 2
        assert said in capsys.readouterr().err
