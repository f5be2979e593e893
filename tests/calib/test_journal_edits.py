"""A journal is untrusted input: an edit of it, with all hashes right, is named by its line and key."""

import json
import math
import re
import shutil
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeAlias

import pytest
from bench_session import accept, begin, chained
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.bench.entries import Decision, EmbeddedFile, Resumed, ServiceMessage, SessionEnded, UnitDetected
from calib.bench.journal import MAX_LINE
from calib.bench.resume import check_files, require_same, require_temperature
from calib.bench.session import Session
from calib.bench.state import JOURNAL
from calib.cli import main
from calib.messages import message
from calib.procedure.events import Checked, Entered, Finished, Phase, Redone, Rejected, Restarted
from imudrv.errors import InputError

Line: TypeAlias = dict[str, Any]
PLAN, BEFORE, WORKING, RECORDING, LOG, ACCEPTED, ENTERED = range(7)
"""Lines of the small session, from 0."""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory, recorded: Callable[..., Path]) -> Path:
    """A session with one accepted step."""
    session = begin(tmp_path_factory.mktemp("small") / "session")
    accept(session, recorded, "z-up")
    session.append(Entered(Phase.PLACE, "x-up", 1, 1900))
    session.close()
    return session.folder


@pytest.fixture
def folder(small: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(small, tmp_path / "session"))


@pytest.fixture(scope="module")
def long(small: Path) -> Path:
    """The same with almost every kind of entry."""
    folder = Path(shutil.copytree(small, small.parent / "long"))
    session = Session.open(folder)
    reasons = (message("verbatim", text="moved"),)
    for entry in (
        UnitDetected(5, False, {"gyro": 35.0, "accelerometer_x": None}),
        Checked(7, 9.8, 15.0, 0.01, 0.2, (("gyro", 35.0),)),
        Restarted("x-up", 1, reasons, 7),
        Rejected("x-up", 1, reasons, 8),
        Redone("x-up", 2, 9),
        ServiceMessage("port lost"),
        Resumed(("run-z-up-1.mcap",)),
        Finished(("z-up",), ("x-up",), (), 10),
        Decision(True),
        SessionEnded(None),
    ):
        session.append(entry)
    session.close()
    return folder


def lines_of(folder: Path) -> list[Line]:
    return [json.loads(line) for line in (folder / JOURNAL).read_text().splitlines()]


def edit(number: int, **values: Any) -> tuple[int, Callable[[Line], Line]]:
    return number, lambda line: {**line, **values}


def without(number: int, key: str) -> tuple[int, Callable[[Line], Line]]:
    return number, lambda line: {k: v for k, v in line.items() if k != key}


@pytest.mark.parametrize(
    ("edited", "message"),
    [
        (without(PLAN, "unit"), "unit: missing"),
        (without(PLAN, "certificate"), "certificate: missing"),
        (edit(PLAN, certificate="unit.yaml"), r"certificate: expected a mapping \(key: value\)"),
        (
            edit(PLAN, certificate={"path": "unit.yaml", "sha256": "0" * 64}),
            "certificate.path: expected an abs",
        ),
        (edit(PLAN, procedure={"name": "p", "text": "x"}), "procedure.sha256: missing"),
        (
            edit(PLAN, procedure={"name": "p", "text": "x", "sha256": "0" * 64}),
            "procedure: expected text of the SHA-256 000000000000",
        ),
        (edit(PLAN, version=2), "version: expected 1, got 2"),
        (edit(PLAN, unit="\x1b[2J"), "unit: expected printable text"),
        (edit(PLAN, port=17), "port: expected text, got 17"),
        (edit(PLAN, event="plans"), "event: expected one of .*, got text 'plans'"),
        (edit(PLAN, event=["plan"]), "event: expected one of .*, got a list"),
        (without(PLAN, "event"), "event: expected one of .*, got nothing"),
        (edit(BEFORE, name=7), "name: expected text, got 7"),
        (edit(BEFORE, bytes=-1), "bytes: expected at least 0, got -1"),
        (edit(BEFORE, bytes=2**70), "bytes: expected at most"),
        (edit(BEFORE, sha256_of_file="short"), "sha256_of_file: expected text that matches"),
        (edit(BEFORE, left="no"), "left: expected true or false, got text 'no'"),
        (edit(BEFORE, size=1), "size: unknown key"),
        (without(RECORDING, "name"), "name: missing"),
        (without(ACCEPTED, "recording"), "recording: missing"),
        (without(ACCEPTED, "last_counter"), "last_counter: missing"),
        (
            edit(ACCEPTED, recording="run-x-up-1.mcap"),
            "recording: expected a file that a line before this one",
        ),
        (edit(ACCEPTED, first_counter=2**70), "first_counter: expected at most 9007199254740992"),
        (edit(ACCEPTED, last_counter=-(2**70)), "last_counter: expected at least 0"),
        (edit(ACCEPTED, first_counter=5000), "last_counter: expected at least first_counter, 5000, got 1899"),
        (edit(ACCEPTED, samples=10**6), "samples: expected at most the 900 of the counters"),
        (edit(ACCEPTED, samples=0.5), "samples: expected a whole number"),
        (edit(ACCEPTED, v_n=[0.0, 0.0]), "v_n: expected 3 numbers, got 2"),
        (edit(ACCEPTED, v_n=[0.0, 0.0, None]), r"v_n\[2\]: expected a number, got nothing"),
        (edit(ACCEPTED, angle_deg=math.inf), "angle_deg: expected a finite number"),
        (edit(ACCEPTED, angle_deg="180"), "angle_deg: expected a number, got text '180'"),
        (edit(ACCEPTED, temperature_degc=[35.0]), "temperature_degc: expected a mapping"),
        (edit(ACCEPTED, temperature_degc={"gyro": "hot"}), "temperature_degc.gyro: expected a number"),
        (edit(ACCEPTED, step_id={}), "step_id: expected text, got a mapping"),
        (edit(ENTERED, phase="sleep"), "phase: expected 'preflight'"),
        (edit(ENTERED, attempt=True), "attempt: expected a whole number, got true"),
        (edit(ENTERED, counter=2**70), "counter: expected at most"),
        (edit(ENTERED, at="yesterday"), "at: expected a time"),
        (edit(ENTERED, event="rejected", reasons=3), "reasons: expected a list"),
        (edit(ENTERED, event="rejected", reasons=[3]), r"reasons\[0\]: expected a mapping"),
    ],
)
def test_an_edited_line_is_named_with_its_key(
    folder: Path,
    edited: tuple[int, Callable[[Line], Line]],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    number, change = edited
    lines = lines_of(folder)
    lines[number] = change(lines[number])
    (folder / JOURNAL).write_bytes(chained(lines))
    assert main(["verify", str(folder)]) == 2
    printed = "".join(capsys.readouterr())
    assert f"{JOURNAL}: line {number + 1}: " in printed
    assert re.search(rf"^ *(.*line \d+: )?{message}", printed, re.MULTILINE), printed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"[" * 1_000_000, "expected at most 32 levels of nesting"),
        (b'{"event": "service", "text": ' + b"[" * 100 + b"]" * 100, "expected at most 32 levels of nesting"),
        (b'{"event": "service", "text": "' + b"x" * MAX_LINE + b'"', f"expected at most {MAX_LINE} bytes"),
        (b'{"event": "service", "text": "\xff"', "expected JSON: .*can't decode byte 0xff"),
        (b'{"event": "service", "text": "\\ud800"', r"expected text, got an escape .* of half a character"),
        (b'{"event": "service", "text": "a", "text": "b"', "expected each key once, got text again"),
        (b'{"event": "service", "text": ' + b"9" * 5000, "expected JSON: .*digits"),
        (b'{"event": "service", "text": nothing', "expected JSON: "),
        (b"", "expected JSON: "),
        (b'"event"', "expected JSON: "),
    ],
    ids=lambda value: "" if isinstance(value, bytes) else value,
)
def test_a_line_that_is_no_bounded_json_is_named(
    folder: Path, text: bytes, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines: list[Line | bytes] = [*lines_of(folder), text]
    (folder / JOURNAL).write_bytes(chained(lines))
    assert main(["verify", str(folder)]) == 2
    printed = "".join(capsys.readouterr())
    assert f"{JOURNAL}: line {len(lines)}: " in printed
    assert re.search(message, printed), printed


def test_a_deep_line_without_its_end_is_unfinished(folder: Path) -> None:
    with (folder / JOURNAL).open("ab") as journal:
        journal.write(b"[" * 1_000_000)
    assert main(["verify", str(folder)]) == 3


def test_a_plan_elsewhere_and_a_journal_without_one_are_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = lines_of(folder)
    for changed, number in (([*lines, lines[0]], len(lines) + 1), (lines[1:], 1)):
        (folder / JOURNAL).write_bytes(chained(changed))
        assert main(["verify", str(folder)]) == 2
        printed = "".join(capsys.readouterr())
        assert f"line {number}: expected the plan of an imu50-session in line 1, and only there" in printed


@pytest.mark.parametrize("kind", ["procedure", "site", "profile"])
def test_a_faulty_file_in_the_plan_is_named(
    folder: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = lines_of(folder)
    lines[PLAN][kind] = vars(EmbeddedFile.of("forged.yaml", b"latitude_deg: 91\n"))
    (folder / JOURNAL).write_bytes(chained(lines))
    assert main(["verify", str(folder)]) == 2
    printed = "".join(capsys.readouterr())
    assert f"{JOURNAL}: line 1: {kind}.text (forged.yaml): " in printed


# Paths


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../unit.yaml", "..", ".", "", "a/b.mcap", "run\0.mcap", "x" * 300, "\x1b[2J"]
)
@pytest.mark.parametrize("number", [BEFORE, ACCEPTED])
def test_a_name_that_leaves_the_folder_is_refused(
    folder: Path, number: int, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = lines_of(folder)
    key = "name" if number == BEFORE else "recording"
    lines[number][key] = name
    (folder / JOURNAL).write_bytes(chained(lines))
    assert main(["verify", str(folder)]) == 2
    printed = "".join(capsys.readouterr())
    assert f"{JOURNAL}: line {number + 1}: " in printed
    assert re.search(rf"^ *{key}: expected", printed, re.MULTILINE)
    assert "\x1b" not in printed
    with pytest.raises(InputError, match=f"line {number + 1}"):
        Session.open(folder)


@pytest.mark.parametrize("name", ["before.yaml", "working.yaml", "run-z-up-1.mcap", "run-z-up-1.npz"])
def test_a_symbolic_link_is_not_followed_out_of_the_folder(
    folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    outside = folder.parent / "outside"
    (folder / name).rename(outside)
    (folder / name).symlink_to(outside)
    assert main(["verify", str(folder)]) == 2
    assert f"{folder / name}: expected a file in the session's folder, got a symbolic link" in (
        "".join(capsys.readouterr())
    )
    with closing(Session.open(folder)) as session, pytest.raises(InputError, match="got a symbolic link"):
        check_files(session)


def test_a_folder_name_that_the_system_cannot_have_is_no_session(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("x" * 300, "a\0b"):
        assert main(["verify", name]) == 2
        assert "expected a session" in capsys.readouterr().err


# Any edit

VALUES = st.one_of(
    st.sampled_from(
        [
            None,
            True,
            0,
            -1,
            2**53,
            2**70,
            -(2**70),
            10**4000,
            1.5,
            1e308,
            math.inf,
            math.nan,
            "",
            "\0",
            "..",
            "é",
        ]
    ),
    st.sampled_from(
        ["\ud800", "x" * 5000, "run-z-up-1.mcap", "before.yaml", "verification", "9999-12-31", "0" * 64]
    ),
    st.recursive(
        st.none() | st.text(max_size=5), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)
    ),
)


@st.composite
def edits(draw: st.DrawFn, document: Any) -> Any:
    """The document with one value replaced, removed or added, at any depth."""
    if not isinstance(document, dict | list) or not document or draw(st.integers(0, 5)) == 0:
        return draw(VALUES)
    items = list(document.items() if isinstance(document, dict) else enumerate(document))
    at = draw(st.integers(0, len(items) - 1))
    key, value = items[at]
    action = draw(st.integers(0, 9))
    items[at : at + 1] = [] if action == 0 else [(key, draw(edits(value)))]
    if action == 1:
        items.append((draw(st.text(max_size=5)), value))
    return dict(items) if isinstance(document, dict) else [item for _, item in items]


@given(data=st.data())
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("base", ["small", "long"])
def test_any_edited_journal_is_verified_or_refused_without_a_traceback(
    base: str, data: st.DataObject, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    folder: Path = request.getfixturevalue(base)
    whole, lines = (folder / JOURNAL).read_bytes(), lines_of(folder)
    number = data.draw(st.integers(0, len(lines) - 1))
    edited = data.draw(edits(lines[number]))
    line = edited if isinstance(edited, dict) else json.dumps(edited)[:-1].encode()
    journal = bytearray(chained([*lines[:number], line, *lines[number + 1 :]]))
    if data.draw(st.integers(0, 3)) == 0:
        at = data.draw(st.integers(0, len(journal) - 1))
        journal[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    (folder / JOURNAL).write_bytes(journal)
    try:
        code = main(["verify", str(folder)])
        printed = "".join(capsys.readouterr())
        assert code in (0, 2, 3), printed
        if code == 2:
            assert re.search(rf"{JOURNAL}: line \d+|/[\w-]+\.(yaml|mcap|npz): ", printed), printed
        with suppress(InputError), closing(Session.open(folder)) as session:
            for check in (check_files, require_same):
                with suppress(InputError):
                    check(session)
            with suppress(InputError):
                require_temperature(session, {"gyro": 35.0})
    finally:
        (folder / JOURNAL).write_bytes(whole)
