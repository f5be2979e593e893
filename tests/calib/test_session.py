"""The session's folder: nothing in it can be lost, doubled or changed unseen."""

import json
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.bench.session import JOURNAL, EmbeddedFile, Session
from calib.bench.verify import verify
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site

DEGC = {"gyro": 35.0, "accelerometer_x": 36.0}
PROCEDURE = """
format: imu50-procedure
version: 1
name: two
poses: [{id: z-up, up: +Z, east: +X, turn_deg: 180}, {id: x-up, up: +X, east: +Y, turn_deg: 180}]
"""
Accept = Callable[..., None]


def document(path: Path) -> EmbeddedFile:
    return EmbeddedFile(str(path), path.read_text())


def begin(folder: Path) -> Session:
    """A session whose unit's papers are beside it."""
    papers = folder.parent
    write_calibration(papers / "unit.yaml", NOMINAL)
    settings_file.write(papers / "site.yaml", Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0))
    (papers / "bench.yaml").write_text(PROCEDURE)
    return Session.create(
        folder,
        procedure=document(papers / "bench.yaml"),
        calibration=papers / "unit.yaml",
        site=document(papers / "site.yaml"),
        profile="imu50-rs422",
        port="/dev/ttyUSB0",
    )


@pytest.fixture
def accept(recorded: Callable[..., Path]) -> Accept:
    """Files an attempt with its files; the recording begins at `since`, the evidence at 1000."""

    def accept(
        session: Session, step_id: str, degc: dict[str, float] = DEGC, since: int = 900, **more: object
    ) -> None:
        name = f"run-{step_id}-{session.attempt(step_id)}"
        recorded(session.folder / f"{name}.mcap", range(since, 2000))
        (session.folder / f"{name}.npz").write_bytes(name.encode() * 100)
        for suffix in ("mcap", "npz"):
            session.enter(f"{name}.{suffix}")
        session.append(
            {
                "event": "accepted",
                "step_id": step_id,
                "counter": 1000,
                "first_counter": 1000,
                "last_counter": 1899,
                "recording": f"{name}.mcap",
                "temperature_degc": degc,
                **more,
            }
        )

    return accept


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    session = begin(tmp_path / "session")
    yield session
    session.close()


@pytest.fixture
def folder(tmp_path: Path, accept: Accept) -> Path:
    """A small session that is closed."""
    session = begin(tmp_path / "session")
    accept(session, "z-up")
    session.append({"event": "entered", "step_id": "x-up"})
    session.close()
    return session.folder


def line_of(data: bytes, at: int) -> int:
    return data.count(b"\n", 0, at) + 1


# The chain


def test_each_line_is_json_and_bears_the_hash_of_its_text_and_of_the_line_before(folder: Path) -> None:
    before = ""
    for line in (folder / JOURNAL).read_text().splitlines():
        entry = json.loads(line)
        assert entry["before"] == before
        before = entry["sha256"]
        assert sha256(line[: line.rindex(', "sha256": ')].encode()).hexdigest() == before


def test_the_first_line_holds_the_plan(folder: Path) -> None:
    plan = json.loads((folder / JOURNAL).read_text().splitlines()[0])
    certificate = folder.parent / "unit.yaml"
    assert plan["unit"] == "nominal"
    assert plan["procedure"]["text"] == PROCEDURE
    assert plan["certificate"] == {"path": str(certificate), "sha256": atomic.sha256(certificate)}
    assert (folder / "before.yaml").read_bytes() == certificate.read_bytes()
    assert "latitude_deg: 28.2" in plan["site"]["text"]


def test_a_whole_session_is_found_whole(folder: Path) -> None:
    assert verify(folder).faults == ()


def test_a_flipped_bit_anywhere_in_the_journal_is_found_and_its_line_named(folder: Path) -> None:
    journal = folder / JOURNAL
    data = journal.read_bytes()
    for at in range(0, len(data), 7):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        journal.write_bytes(damaged)
        (fault,) = verify(folder).faults
        assert f"{JOURNAL}: line {line_of(data, at)}" in fault, at


@pytest.mark.parametrize(
    "name",
    ["before.yaml", "working.yaml", "run-z-up-1.mcap", "run-z-up-1.npz", "certificate.yaml", "report.html"],
)
def test_a_flipped_bit_in_a_file_is_found_and_the_file_named(folder: Path, name: str) -> None:
    session = Session.open(folder)
    for result in ("certificate.yaml", "report.html"):
        (folder / result).write_text("what came out\n")
        session.enter(result)
    session.close()
    data = bytearray((folder / name).read_bytes())
    for at in (0, len(data) // 2, len(data) - 1):
        damaged = data.copy()
        damaged[at] ^= 4
        (folder / name).write_bytes(damaged)
        (fault,) = verify(folder).faults
        assert fault.startswith(f"{folder / name}: was damaged or changed")
    (folder / name).unlink()
    (fault,) = verify(folder).faults
    assert f"{folder / name}: expected a file, there is none" in fault


def test_a_line_that_was_taken_out_or_put_in_or_moved_is_named(folder: Path) -> None:
    journal = folder / JOURNAL
    lines = journal.read_bytes().splitlines(keepends=True)
    for changed, number in (
        (lines[:2] + lines[3:], 3),
        (lines[:3] + lines[2:], 4),
        ([*lines[:2], lines[3], lines[2], *lines[4:]], 3),
    ):
        journal.write_bytes(b"".join(changed))
        (fault,) = verify(folder).faults
        assert f"line {number}: does not follow the line before it" in fault


def test_a_file_that_the_journal_does_not_know_is_told(folder: Path) -> None:
    (folder / "notes.txt").write_text("by hand\n")
    verified = verify(folder)
    assert verified.faults == ()
    assert any("notes.txt: not in the journal" in note for note in verified.notes)


# Power cuts


def test_a_journal_cut_anywhere_in_its_last_line_goes_on_and_nothing_before_it_changes(folder: Path) -> None:
    journal = folder / JOURNAL
    data = journal.read_bytes()
    last = data.rindex(b"\n", 0, -1) + 1
    for end in range(last + 1, len(data), 9):
        journal.write_bytes(data[:end])
        (fault,) = verify(folder).faults
        assert f"line {line_of(data, last)}, the last, is broken" in fault
        session = Session.open(folder)
        assert "as a power cut leaves it; it is dropped" in session.dropped
        assert [e["event"] for e in session.entries][-2:] == ["accepted", "dropped"]
        session.append({"event": "after"})
        session.close()
        assert journal.read_bytes().startswith(data[:end])
        assert verify(folder).faults == ()
        again = Session.open(folder)
        assert again.dropped == ""
        assert [e["event"] for e in again.entries][-2:] == ["dropped", "after"]
        again.close()


def test_a_second_power_cut_while_the_first_is_mended_does_no_harm(folder: Path) -> None:
    journal = folder / JOURNAL
    torn = journal.read_bytes()[:-30]
    journal.write_bytes(torn)
    Session.open(folder).close()
    mended = journal.read_bytes()
    for end in range(len(torn) + 1, len(mended) + 1, 5):
        journal.write_bytes(mended[:end])
        Session.open(folder).close()
        assert journal.read_bytes() == mended


def test_what_was_dropped_cannot_be_changed_later(folder: Path) -> None:
    journal = folder / JOURNAL
    torn = journal.read_bytes()[:-30]
    journal.write_bytes(torn)
    Session.open(folder).close()
    damaged = bytearray(journal.read_bytes())
    damaged[len(torn) - 10] ^= 1
    journal.write_bytes(damaged)
    (fault,) = verify(folder).faults
    assert f"line {line_of(torn, len(torn))}: is damaged" in fault


def test_a_broken_line_elsewhere_is_an_error_that_names_it(folder: Path) -> None:
    journal = folder / JOURNAL
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[3] = lines[3][:40] + b"\n"
    journal.write_bytes(b"".join(lines))
    with pytest.raises(InputError, match="line 4: is damaged"):
        Session.open(folder)


def test_a_last_line_that_is_whole_but_wrong_is_damage_and_no_power_cut(folder: Path) -> None:
    journal = folder / JOURNAL
    data = journal.read_bytes()
    journal.write_bytes(data[:-200] + data[-200:].replace(b"x-up", b"y-up"))
    with pytest.raises(InputError, match="is damaged: its text does not give its sha256"):
        Session.open(folder)


def test_a_journal_without_its_first_line_is_no_session(folder: Path) -> None:
    (folder / JOURNAL).write_bytes(b'{"event": "pl')
    with pytest.raises(InputError, match="expected the plan in line 1"):
        Session.open(folder)


# Steps


def test_a_step_is_accepted_until_it_is_done_again(session: Session, accept: Accept) -> None:
    accept(session, "z-up")
    accept(session, "x-up")
    assert list(session.accepted) == ["z-up", "x-up"]
    session.append({"event": "redone", "step_id": "z-up"})
    assert list(session.accepted) == ["x-up"]
    accept(session, "z-up")
    assert session.accepted["z-up"]["recording"] == "run-z-up-2.mcap"


def test_a_recording_that_does_not_cover_its_step_is_named_whether_there_is_a_certificate_or_not(
    session: Session, accept: Accept
) -> None:
    accept(session, "z-up")
    accept(session, "x-up", since=1234)
    accept(session, "verification", since=1500, samples=900)
    assert not verify(session.folder).notes[1:]
    for result in (False, True):
        if result:
            write_calibration(session.folder / "certificate.yaml", NOMINAL)
            session.enter("certificate.yaml")
        x_up, verification = verify(session.folder).faults
        again = f"do this step again: calib run --session {session.folder} --redo"
        for fault, step, gap in (
            (x_up, "x-up", "1000..1233"),
            (verification, "verification", "1000..1499"),
        ):
            assert fault == (
                f"{session.folder}/run-{step}-1.mcap: step {step}: its recording does not cover counters "
                f"{gap}; {again} {step}"
            )


def test_a_step_that_is_withdrawn_takes_what_was_concluded_from_it_along(
    session: Session, accept: Accept
) -> None:
    accept(session, "z-up")
    accept(session, "x-up", since=1234)
    session.append({"event": "finished", "accepted": ["z-up", "x-up"]})
    (session.folder / "certificate.yaml").write_text("what came out\n")
    session.enter("certificate.yaml")
    assert session.entry("finished") is not None
    session.redo(["x-up"])
    assert list(session.accepted) == ["z-up"]
    assert session.entry("finished") is None
    assert "certificate.yaml" not in session.files
    assert session.attempt("x-up") == 2
    assert verify(session.folder).faults == ()
    accept(session, "x-up", samples=900)
    session.append({"event": "finished", "accepted": ["z-up", "x-up"]})
    (session.folder / "certificate.yaml").write_text("what came out then\n")
    session.enter("certificate.yaml")
    assert session.entry("finished") is not None
    session.require_whole()


def test_a_step_that_there_is_not_cannot_be_done_again_and_the_steps_are_listed(
    session: Session, accept: Accept
) -> None:
    accept(session, "z-up")
    before = len(session.entries)
    with pytest.raises(InputError, match=r"--redo: expected one of z-up, x-up, got 'y-up'"):
        session.redo(["z-up", "y-up"])
    assert len(session.entries) == before
    session.redo(["x-up"])  # it was skipped


def test_once_the_result_is_accepted_only_the_verification_is_done_again(
    session: Session, accept: Accept
) -> None:
    accept(session, "z-up")
    session.append({"event": "finished", "accepted": ["z-up"]})
    session.append({"event": "decision", "accepted": True})
    accept(session, "verification")
    with pytest.raises(InputError, match=r"expected one of verification, got 'z-up'; the result is accepted"):
        session.redo(["z-up"])
    session.redo(["verification"])
    assert list(session.accepted) == ["z-up"]
    assert session.entry("decision") is not None


def test_an_attempt_that_a_kill_has_ended_counts_and_what_it_left_is_entered(session: Session) -> None:
    (session.folder / "run-z-up-1.mcap").write_bytes(b"cut")
    (session.folder / "run-z-up-back-7.mcap").write_bytes(b"of another step")
    assert session.attempt("z-up") == 2
    assert session.enter_leftovers() == ["run-z-up-1.mcap", "run-z-up-back-7.mcap"]
    assert session.enter_leftovers() == []
    assert verify(session.folder).faults == ()


def test_two_cannot_work_on_one_session(session: Session) -> None:
    with pytest.raises(InputError, match="another process has it open"):
        Session.open(session.folder)


def test_a_new_session_does_not_touch_one_that_is_there(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match="expected a new folder, there is a session in it"):
        begin(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    Session.open(folder).close()


def test_the_service_gets_the_certificate_without_size_effect(session: Session) -> None:
    assert session.calibration() == NOMINAL.model_copy(update={"size_effect": None})


# Resuming


def test_the_same_papers_are_welcome(session: Session) -> None:
    papers = session.folder.parent
    session.require_whole()
    session.require_same()
    session.require_same(
        procedure=document(papers / "bench.yaml"),
        calibration=papers / "unit.yaml",
        site=document(papers / "site.yaml"),
        profile="imu50-rs422",
    )


def test_another_unit_is_refused(session: Session) -> None:
    other = NOMINAL.model_copy(update={"serial_number": "50-0018"})
    write_calibration(session.folder.parent / "unit.yaml", other)
    with pytest.raises(InputError, match=r"cannot be resumed:\n  unit: expected 'nominal', got '50-0018'"):
        session.require_same()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"procedure": EmbeddedFile("other.yaml", "another\n")},
            "procedure: expected .*bench.yaml as it was, got other",
        ),
        (
            {"site": EmbeddedFile("roof.yaml", "another\n")},
            "site: expected .*site.yaml as it was, got roof.yaml",
        ),
        ({"profile": "imu50-can"}, "profile: expected imu50-rs422 as it was, got imu50-can"),
    ],
)
def test_other_papers_are_refused(session: Session, given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        session.require_same(**given)


def test_a_certificate_that_was_changed_meanwhile_is_refused_but_the_sessions_own_result_is_not(
    session: Session,
) -> None:
    active = session.folder.parent / "unit.yaml"
    write_calibration(active, session.calibration())
    with pytest.raises(InputError, match="certificate: expected the one that it began with"):
        session.require_same()
    (session.folder / "certificate.yaml").write_bytes(active.read_bytes())
    session.enter("certificate.yaml")
    session.require_same()


def test_a_temperature_far_from_the_accepted_runs_is_refused(session: Session, accept: Accept) -> None:
    session.require_temperature({"gyro": 20.0})
    accept(session, "z-up", {"gyro": 34.0, "accelerometer_x": 36.0})
    accept(session, "x-up", {"gyro": 36.0, "accelerometer_x": 36.0})
    session.require_temperature({"gyro": 39.9, "accelerometer_x": None})
    with pytest.raises(InputError, match=r"gyro: expected 35\.0 degC within 5 K, .* got 40\.1"):
        session.require_temperature({"gyro": 40.1, "accelerometer_x": 36.0})
    with pytest.raises(InputError, match="got 29"):
        session.require_temperature({"gyro": 29.0})


def test_a_session_with_a_damaged_recording_is_not_resumed(session: Session, accept: Accept) -> None:
    accept(session, "z-up")
    (session.folder / "run-z-up-1.mcap").write_bytes(b"other")
    with pytest.raises(InputError, match=r"cannot be resumed:\n  .*run-z-up-1.mcap: was damaged"):
        session.require_whole()


def test_a_number_that_json_does_not_know_is_refused_before_it_is_written(session: Session) -> None:
    before = (session.folder / JOURNAL).read_bytes()
    with pytest.raises(ValueError, match="not JSON compliant"):
        session.append({"event": "odd", "value": float(np.nan)})
    assert (session.folder / JOURNAL).read_bytes() == before
