import contextlib
import errno
import hashlib
import math
import os
import re
import struct
import tempfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field, JsonValue

from imudrv.errors import FaultyFileError, InputError
from imudrv.files import atomic, yaml_text
from imudrv.files.atomic import sha256, unchanged
from imudrv.files.faults import MAX_FAULTS
from imudrv.files.model import Matrix3, Model, UtcTime, Vector3
from imudrv.files.settings_file import kind, parse, read, read_file, write


class Line(Model):
    baudrate: Annotated[int, Field(ge=50)]
    parity: Literal["none", "even"] = "none"


class Bus(Model):
    bitrate: int


class Settings(Model):
    format: Literal["test-settings"]
    version: Literal[1]
    rate_hz: Annotated[float, Field(gt=0)] = 1.0
    count: int = 0
    name: Annotated[str, Field(min_length=1, max_length=8)] = "x"
    strict: bool = False
    axes: Matrix3 | None = None
    arm: Vector3 | None = None
    when: UtcTime | None = None
    line: Line | Bus | None = None
    lines: tuple[Line, ...] = ()
    either: float | str = 0.0


class Free(Model):
    content: dict[str, JsonValue]


HEADER = {"format": "test-settings", "version": 1}


def faults_of(document: object, model: type[Model] = Settings) -> tuple[str, ...]:
    with pytest.raises(FaultyFileError) as caught:
        parse(document, model, "a document")
    return caught.value.faults


def fault(**changes: Any) -> str:
    (only,) = faults_of({**HEADER, **changes})
    return only


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "settings.yaml"


def faults_in(file: Path, text: str | bytes) -> str:
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(FaultyFileError) as caught:
        read(file, Settings)
    return str(caught.value)


# What is accepted


def test_a_file_becomes_its_model(file: Path) -> None:
    file.write_text(
        "format: test-settings\nversion: 1\nrate_hz: 400\narm: [1, 2.5, -3]\nlines: [{baudrate: 9600}]\n"
    )
    settings = read(file, Settings)
    assert settings == Settings(
        format="test-settings", version=1, rate_hz=400.0, arm=(1.0, 2.5, -3.0), lines=(Line(baudrate=9600),)
    )
    assert isinstance(settings.rate_hz, float)
    assert read(str(file), Settings) == settings


def test_a_model_does_not_change() -> None:
    with pytest.raises(ValueError, match="frozen"):
        parse(HEADER, Settings, "x").count = 2  # type: ignore[misc]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-6", 1e-6),
        ("1.5E+3", 1500.0),
        (".5", 0.5),
        ("-0.0", -0.0),
        ("12", 12),
        ("-7", -7),
        ("0x150", 0x150),
        ("100000000000000000000000", 1e23),
        ("0017", "0017"),
        ("00.5", "00.5"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("50-0017", "50-0017"),
        ("2026-11-22", "2026-11-22"),
        ("yes", "yes"),
        ("off", "off"),
        ("True", True),
        ("false", False),
        ("~", None),
        ("", None),
        ("'12'", "12"),
        ('"true"', "true"),
        ("|\n    12\n", "12\n"),
        ("'<<'", "<<"),
    ],
)
def test_an_unquoted_value_is_read_as_yaml_1_2_specifies(file: Path, text: str, value: object) -> None:
    file.write_text(f"content:\n  a: {text}\n")
    came = read(file, Free).content["a"]
    assert came == value
    assert type(came) is type(value)
    if isinstance(came, float):
        assert math.copysign(1.0, came) == (-1.0 if text.startswith("-") else 1.0)


def test_keys_are_text_whatever_they_look_like(file: Path) -> None:
    file.write_text("content: {1: a, on: b, 0x10: c, <<: d}\n")
    assert read(file, Free).content == {"1": "a", "on": "b", "0x10": "c", "<<": "d"}


def test_a_byte_order_mark_is_no_part_of_the_first_key(file: Path) -> None:
    file.write_bytes(b"\xef\xbb\xbfcontent: {}\n")
    assert read(file, Free).content == {}


@pytest.mark.parametrize(
    "text",
    [
        "2026-11-22T10:00:00Z",
        "'2026-11-22T10:00:00Z'",
        "2026-11-22 18:00:00+08:00",
        "2026-11-22T10:00:00.000Z",
    ],
)
def test_a_time_is_kept_in_utc_quoted_or_not(file: Path, text: str) -> None:
    file.write_text(f"format: test-settings\nversion: 1\nwhen: {text}\n")
    when = read(file, Settings).when
    assert when == datetime(2026, 11, 22, 10, tzinfo=UTC)
    assert when.utcoffset() == timedelta(0)


def test_a_document_may_hold_a_time_as_such() -> None:
    when = datetime(2026, 11, 22, 10, tzinfo=UTC)
    assert parse({**HEADER, "when": when}, Settings, "x").when == when


# What is refused, and in which words


def test_all_faults_are_reported_at_once(file: Path) -> None:
    text = (
        "format: test-settings\nversion: 1\nrate_hz: -1\ncount: many\naxes: [[1, 0, 0], [0, 1], 5]\nnane: x\n"
    )
    assert faults_in(file, text) == "\n  ".join(
        [
            f"{file}: 5 faults",
            "rate_hz: expected more than 0.0, got -1",
            "count: expected a whole number, got text 'many'",
            "axes[1]: expected 3 numbers, got 2",
            "axes[2]: expected a list, got 5",
            "nane: unknown key; did you mean name?",
        ]
    )


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("rate_hz", True, "expected a number, got true"),
        ("rate_hz", "5", "expected a number, got text '5'"),
        ("rate_hz", None, "expected a number, got nothing"),
        ("rate_hz", math.nan, "expected a finite number, got nan"),
        ("rate_hz", math.inf, "expected a finite number, got inf"),
        ("rate_hz", 0, "expected more than 0.0, got 0"),
        ("rate_hz", {"a": 1}, "expected a number, got a mapping"),
        ("count", 1.5, "expected a whole number, got 1.5"),
        ("count", False, "expected a whole number, got false"),
        ("name", 17, "expected text, got 17; put it in quotes"),
        ("name", "", "expected text of 1 characters or more, got text ''"),
        ("name", "longer than it", "expected text of at most 8 characters, got text 'longer than it'"),
        ("strict", "yes", "expected true or false, got text 'yes'"),
        ("strict", 1, "expected true or false, got 1"),
        ("arm", [1, 2, 3, 4], "expected at most 3 numbers, got 4"),
        ("arm", [], "expected 3 numbers, got 0"),
        ("arm", 5, "expected a list, got 5"),
        ("axes", [[1, 0, 0]], "expected 3 rows, got 1"),
        (
            "when",
            "2026-11-22T10:00:00",
            "expected a time in the way of .*, with its zone, got text '2026-11-22T10",
        ),
        ("when", "tomorrow", "expected a time in the way of 2026-11-22T10:00:00Z, got text 'tomorrow'"),
        ("when", 5, "expected a time in the way of 2026-11-22T10:00:00Z, got 5"),
        ("when", "0001-01-01T00:00:00+14:00", "expected a date from the year 2000 on, got 0001-01-01"),
        ("either", [1, 2], "expected a number or text, got a list of 2"),
        ("lines", {"baudrate": 9600}, "expected a list, got a mapping"),
    ],
)
def test_a_fault_says_place_expected_and_got(key: str, value: object, words: str) -> None:
    assert re.match(f"{key}: {words}", fault(**{key: value}))


def test_a_fault_inside_a_list_has_its_index() -> None:
    faults = faults_of({**HEADER, "lines": [{"baudrate": 9600}, {"baudrate": 5, "parity": "odd"}, {}]})
    assert faults == (
        "lines[1].baudrate: expected at least 50, got 5",
        "lines[1].parity: expected 'none' or 'even', got text 'odd'",
        "lines[2].baudrate: missing; add it",
    )


def test_an_unknown_key_is_reported_with_the_nearest_known_one() -> None:
    assert (
        fault(lines=[{"baudrate": 50, "paritty": 1}]) == "lines[0].paritty: unknown key; did you mean parity?"
    )
    assert faults_of({"bitrat": 1, "bitrate": 1}, Bus) == ("bitrat: unknown key; did you mean bitrate?",)


def test_an_unknown_key_without_a_similar_one_is_reported_with_all_known_ones() -> None:
    assert fault(lines=[{"baudrate": 50, "zz": 1}]) == "lines[0].zz: unknown key; known are baudrate, parity"


def test_of_alternative_sections_the_one_that_fits_best_is_reported() -> None:
    assert fault(line={"baudrate": 5}) == "line.baudrate: expected at least 50, got 5"
    assert fault(line={"bitrate": "fast"}) == "line.bitrate: expected a whole number, got text 'fast'"
    assert fault(line=5) == "line: expected a mapping (key: value), got 5"
    assert fault(line={"bitrate": 5, "bitrat": 1}) == "line.bitrat: unknown key; did you mean bitrate?"


@pytest.mark.parametrize("version", [2, True, 1.0, "1", None])
def test_another_version_is_the_only_fault_reported(version: object) -> None:
    (only,) = faults_of({"format": "test-settings", "version": version, "unheard": 1})
    assert only.startswith("version: expected 1, got ")


def test_another_format_is_the_only_fault_reported() -> None:
    document = {"format": "imu50-site", "version": 1, "latitude_deg": 5}
    assert faults_of(document) == ("format: expected test-settings, got text 'imu50-site'",)


def test_a_missing_header_is_reported() -> None:
    assert faults_of({}) == ("format: missing; add it", "version: missing; add it")


@pytest.mark.parametrize(
    ("text", "came"),
    [("", "nothing"), ("# all quiet", "nothing"), ("5", "5"), ("[a]", "a list of 1"), ("a", "text 'a'")],
)
def test_a_file_that_is_no_mapping_is_reported(file: Path, text: str, came: str) -> None:
    assert f"1 fault\n  expected a mapping (key: value), got {came}" in faults_in(file, text)


def test_many_faults_are_counted_not_all_printed() -> None:
    faults = faults_of({**HEADER, "lines": [{}] * 1000})
    assert len(faults) == MAX_FAULTS + 1
    assert faults[-1] == f"and {1000 - MAX_FAULTS} more"


@pytest.mark.parametrize("value", ["\x1b[31m" * 30, {"\x1b[31m" * 30: 1}, {"k" * 1000: 1}])
def test_what_a_message_quotes_is_short_and_printable(value: object) -> None:
    (message,) = faults_of(
        {**HEADER, "either": [value], "line": None, **(value if isinstance(value, dict) else {})}
    )[-1:]
    assert message.isprintable()
    assert len(message) < 250


# YAML that is refused


def test_a_syntax_error_is_reported_with_line_and_column(file: Path) -> None:
    assert "1 fault\n  line 3, column 6: expected YAML, got: " in faults_in(file, "a: 1\nb: [1,\nc: 2]]\n")


def test_repeated_keys_are_all_reported_with_their_lines(file: Path) -> None:
    message = faults_in(file, "a: 1\nb: {c: 1, c: 2}\na: 3\n")
    assert "line 2, column 11: expected each key once, got c again; keep one" in message
    assert "line 3, column 1: expected each key once, got a again; keep one" in message


def test_anchors_aliases_and_tags_are_refused(file: Path) -> None:
    message = faults_in(file, "a: &x [1]\nb: *x\nc: !!python/name:os.system ''\nd: !!binary aGk=\n")
    assert "line 1, column 4: expected a value, got an anchor (&) or alias (*)" in message
    assert "line 2, column 4: expected a value, got an anchor (&) or alias (*)" in message
    assert "line 3, column 4: expected a value, got a tag (!)" in message
    assert "line 4, column 4: expected a value, got a tag (!)" in message


def test_a_billion_laughs_do_not_grow(file: Path) -> None:
    rows = ["a0: &a0 [ha]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30)]
    assert "anchor" in faults_in(file, "\n".join(rows))


@pytest.mark.parametrize("opening", ["[", "[[1], ", "- ", "{a: "])
def test_deep_nesting_is_refused_not_recursed(file: Path, opening: str) -> None:
    # 500 levels: below the bound that some builds of libyaml have of their own.
    assert f"expected at most {yaml_text.MAX_DEPTH} levels of nesting" in faults_in(file, opening * 500)
    assert "nesting" in faults_in(file, opening * 10_000)


def test_the_documented_depth_of_nesting_is_accepted(file: Path) -> None:
    levels = yaml_text.MAX_DEPTH - 2  # two mappings are around the lists
    file.write_text(f"content: {{a: {'[' * levels}{']' * levels}}}")
    assert read(file, Free)
    assert "levels" in faults_in(file, f"content: {{a: {'[' * (levels + 1)}{']' * (levels + 1)}}}")


def test_too_many_values_are_refused(file: Path) -> None:
    assert f"expected at most {yaml_text.MAX_EVENTS} values" in faults_in(
        file, f"a: [{'1,' * yaml_text.MAX_EVENTS}]"
    )


def test_a_key_that_is_a_list_is_refused(file: Path) -> None:
    assert "line 1, column 3: expected text as a key, got a list or mapping" in faults_in(
        file, "? [1, 2]\n: 3\n"
    )


def test_a_second_document_is_refused(file: Path) -> None:
    assert "line 2, column 1: expected one document, got a second one" in faults_in(file, "a: 1\n---\nb: 2\n")


def test_bytes_that_are_no_utf_8_are_reported_with_their_line(file: Path) -> None:
    assert "line 2: expected UTF-8 text, got the byte 0xe9" in faults_in(file, b"a: 1\nname: caf\xe9\n")


def test_control_characters_are_refused(file: Path) -> None:
    assert "expected text, got the control character 0x00" in faults_in(file, b"a: 1\x00\n")


def test_a_large_file_is_not_read(file: Path) -> None:
    file.write_bytes(b"#" * atomic.MAX_BYTES)
    assert kind_fault(file) == "expected a mapping (key: value), got nothing"
    file.write_bytes(b"#" * (atomic.MAX_BYTES + 1))
    with pytest.raises(InputError, match="expected a settings file of at most 1048576 bytes"):
        read(file, Settings)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=80) | st.text("{}[]:-,?*&!|>'\"%#@ \n\ta1.e", max_size=80).map(str.encode))
def test_any_bytes_give_a_model_or_our_error(content: bytes) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        with contextlib.suppress(InputError):
            assert isinstance(read(file.name, Free), Free)


# Files that cannot be read


def test_a_missing_file_is_reported_in_plain_words(file: Path) -> None:
    for act in (lambda: read(file, Settings), lambda: kind(file), lambda: sha256(file)):
        with pytest.raises(
            InputError, match=r"settings\.yaml: expected a file, there is none; check the path"
        ):
            act()


def test_a_folder_or_device_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a file, got a folder"):
        read(tmp_path, Settings)
    with pytest.raises(InputError, match="expected a file, got a device"):
        read("/dev/zero", Settings)


def test_a_pipe_does_not_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="expected a file, got a pipe"):
        read(tmp_path / "pipe", Settings)


def test_a_file_without_permission_is_reported(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text("a: 1")

    def refuse(*_: object) -> None:  # root, who runs tests in containers, may read anything
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match="cannot be read: permission denied"):
        read(file, Settings)


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000, "/dev/null/x"])
def test_an_impossible_path_is_reported(path: str) -> None:
    with pytest.raises(InputError, match="cannot be read: "):
        read(path, Settings)
    with pytest.raises(InputError, match="cannot be written: "):
        write(path, Bus(bitrate=1))


# Kind and hash


def kind_fault(file: Path) -> str:
    with pytest.raises(FaultyFileError) as caught:
        kind(file)
    (only,) = caught.value.faults
    return only


def test_a_file_says_what_it_is(file: Path) -> None:
    file.write_text("format: imu50-profile\nanything: [else]\n")
    assert kind(file) == "imu50-profile"


def test_a_site_needs_not_say_it(file: Path) -> None:
    file.write_text("latitude_deg: 28.2\nlongitude_deg: 113\nheight_m: 60\n")
    assert kind(file) == "imu50-site"
    file.write_text("format: imu50-scenario\nlatitude_deg: 28.2\n")
    assert kind(file) == "imu50-scenario"


def test_a_file_that_does_not_say_what_it_is_is_refused(file: Path) -> None:
    file.write_text("a: 1\n")
    assert kind_fault(file).startswith("format: expected what the file is")
    file.write_text("format: 3\n")
    assert kind_fault(file).endswith("got 3")


def test_the_hash_is_the_published_one(file: Path) -> None:
    file.write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    assert sha256(file) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_content_hash_and_model_are_of_one_read(
    file: Path, replaced_at_random: Callable[..., contextlib.AbstractContextManager[None]]
) -> None:
    texts = {n: f"format: test-settings\nversion: 1\ncount: {n}\n".encode() for n in (1, 2)}
    file.write_bytes(texts[1])
    with replaced_at_random(file, list(texts.values()), seed=1):
        for _ in range(200):
            found = read_file(file, Settings)
            assert found.content == texts[found.model.count]
            assert found.sha256 == hashlib.sha256(found.content).hexdigest()


@pytest.mark.parametrize(
    "change", [Path.unlink, lambda file: os.truncate(file, 1), lambda file: os.utime(file)]
)
def test_a_file_that_is_read_twice_must_stay_the_same(file: Path, change: Callable[[Path], None]) -> None:
    file.write_bytes(b"abc")
    with unchanged(file):
        sha256(file)
    with pytest.raises(InputError, match="it was changed while it was read; wait"), unchanged(file):
        change(file)


# Writing

ANY_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


def bits(value: object) -> object:
    """The value with its types, and floats as their bytes."""
    if isinstance(value, dict):
        return [(key, bits(item)) for key, item in value.items()]
    if isinstance(value, list):
        return [bits(item) for item in value]
    return (type(value), struct.pack("<d", value) if isinstance(value, float) else value)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.text(), ANY_JSON, max_size=4))
def test_what_is_written_is_read_again_bit_for_bit(content: dict[str, JsonValue]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "free.yaml"
        write(file, parse({"content": content}, Free, "x"))
        assert bits(read(file, Free).content) == bits(content)


@pytest.mark.parametrize(
    "text",
    [
        "1e5",
        "17",
        "0017",
        "1:30",
        "yes",
        "null",
        "~",
        "",
        " a ",
        "2026-11-22",
        "a: b",
        "# a",
        "- a",
        "é\n\x85\u2028\ufeff",
        "0x1F",
    ],
)
def test_text_stays_text(file: Path, text: str) -> None:
    write(file, {"content": {"a": text, "b": [text]}})
    assert read(file, Free).content == {"a": text, "b": [text]}


def test_a_written_file_is_readable_by_people(file: Path) -> None:
    document = {
        "when": "2026-11-22T10:00:00Z",
        "lines": [{"parity": "even", "baudrate": 9600}],
        "axes": [[1, 0, 0], [0, 1e-6, 0], [0, 0, -1.5]],
        "arm": [1, 2, 0.1],
        "name": "0017",
        "rate_hz": 400,
        **HEADER,
    }
    write(file, parse(document, Settings, "x"))
    assert file.read_text() == (
        "format: test-settings\nversion: 1\nrate_hz: 400.0\ncount: 0\nname: '0017'\nstrict: false\n"
        "axes:\n- [1.0, 0.0, 0.0]\n- [0.0, 1.0e-06, 0.0]\n- [0.0, 0.0, -1.5]\n"
        "arm: [1.0, 2.0, 0.1]\nwhen: 2026-11-22T10:00:00Z\nlines:\n"
        "- baudrate: 9600\n  parity: even\neither: 0.0\n"
    )


def test_a_value_that_occurs_twice_is_written_twice(file: Path) -> None:
    row, when = [1, 2], datetime(2026, 11, 22, 10, tzinfo=UTC)
    write(file, {"content": {"a": row, "b": row, "c": when, "d": when}})
    time = "2026-11-22T10:00:00Z"
    assert read(file, Free).content == {"a": [1, 2], "b": [1, 2], "c": time, "d": time}


def at(file: Path, time: datetime) -> None:
    os.utime(file, (time.timestamp(), time.timestamp()))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_file_that_was_there_is_kept_under_its_time(file: Path) -> None:
    file.write_text("old: 1 # with its comment\n")
    at(file, datetime(2026, 11, 22, 10, tzinfo=UTC))
    write(file, Bus(bitrate=1))
    assert file.read_text() == "bitrate: 1\n"
    assert names(file.parent) == ["settings.20261122T100000Z.yaml", "settings.yaml"]
    assert (file.parent / "settings.20261122T100000Z.yaml").read_text() == "old: 1 # with its comment\n"


def test_a_kept_file_is_never_overwritten(file: Path) -> None:
    for i in range(4):
        write(file, Bus(bitrate=i))
        at(file, datetime(2026, 11, 22, 10, tzinfo=UTC))
    kept = [f"settings.20261122T100000Z{n}.yaml" for n in ("", ".2", ".3")]
    assert [(file.parent / name).read_text() for name in kept] == [f"bitrate: {i}\n" for i in range(3)]
    assert names(file.parent) == sorted([*kept, "settings.yaml"])


def test_a_full_disk_leaves_the_old_file_and_nothing_else(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text("old: 1\n")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        write(file, Bus(bitrate=1))
    assert names(file.parent) == ["settings.yaml"]
    assert file.read_text() == "old: 1\n"


def test_the_contents_are_on_the_disk_before_the_name_and_then_the_name(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def fsync_recorded(fd: int) -> None:
        steps.append("fsync folder" if os.path.isdir(f"/proc/self/fd/{fd}") else "fsync file")
        fsync(fd)

    def replace_recorded(path: Path, target: Path) -> Path:
        steps.append("rename")
        assert path.read_text() == "bitrate: 1\n"
        assert path.parent == target.parent
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", fsync_recorded)
    monkeypatch.setattr(Path, "replace", replace_recorded)
    write(file, Bus(bitrate=1))
    assert steps == ["fsync file", "rename", "fsync folder"]


def test_a_written_file_has_the_permissions_of_any_new_file(file: Path) -> None:
    other = file.with_name("other")
    other.touch()
    write(file, Bus(bitrate=1))
    assert file.stat().st_mode == other.stat().st_mode


def test_a_missing_folder_is_reported(file: Path) -> None:
    with pytest.raises(InputError, match=r"expected the folder .*nowhere, there is none; make it first"):
        write(file.parent / "nowhere" / "x.yaml", Bus(bitrate=1))


def test_a_folder_is_not_overwritten(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a file, got a folder"):
        write(tmp_path, Bus(bitrate=1))


def test_nothing_is_written_that_could_not_be_read(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep: object = 1
    for _ in range(yaml_text.MAX_DEPTH):
        deep = [deep]
    with pytest.raises(InputError, match="levels of nesting"):
        write(file, {"content": deep})
    monkeypatch.setattr("imudrv.files.settings_file.MAX_BYTES", 100)
    with pytest.raises(InputError, match="expected at most 100 bytes to write, got 110"):
        write(file, {"content": "x" * 100})
    assert names(file.parent) == []
