"""Folder of a session: nothing in it is lost, doubled or changed by accident without notice."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from hashlib import sha256
from io import StringIO
from pathlib import Path
from typing import Any

import bench_session
import numpy as np
import pytest
from bench_session import ACCEPTED, DEGC, PROCEDURE, begin, embedded
from rich.console import Console

from calib.bench import journal as journals
from calib.bench.entries import (
    Decision,
    EmbeddedFile,
    ServiceMessage,
    UnitDetected,
    from_json,
    to_json,
)
from calib.bench.resume import check_files, require_same, require_temperature, resume
from calib.bench.session import Session
from calib.bench.state import INITIAL_CERTIFICATE, JOURNAL, LOCK
from calib.bench.verify import verify
from calib.cli import main
from calib.messages import Message, english
from calib.procedure.events import Entered, Finished, Phase, Redone
from imudrv import profiles
from imudrv.calibration import Calibration, read_calibration_file, write_calibration
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.files.settings_file import SettingsFile
from imudrv.sim.scenario import NOMINAL

FINISHED = Finished(("z-up", "x-up"), (), (), 1900)
Accept = Callable[..., None]


@pytest.fixture
def accept(recorded: Callable[..., Path]) -> Accept:
    """Accepts an attempt with its files; see `bench_session.accept`."""

    def accept(session: Session, step_id: str, *rest: Any, **more: Any) -> None:
        bench_session.accept(session, recorded, step_id, *rest, **more)

    return accept


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    session = begin(tmp_path / "session")
    yield session
    session.close()


@pytest.fixture
def folder(tmp_path: Path, accept: Accept) -> Path:
    """A small closed session."""
    session = begin(tmp_path / "session")
    accept(session, "z-up")
    session.append(Entered(Phase.PLACE, "x-up", 1, 1900))
    session.close()
    return session.folder


def events(session: Session) -> list[str]:
    return [to_json(entry)["event"] for entry in session.entries]


def line_of(data: bytes, at: int) -> int:
    return data.count(b"\n", 0, at) + 1


# Hash chain


def test_a_new_journal_and_its_name_are_on_the_disk(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synchronised = []
    monkeypatch.setattr(os, "fsync", lambda fd: synchronised.append(Path(f"/proc/self/fd/{fd}").resolve()))
    journals.begin(tmp_path / JOURNAL, session.plan)
    assert synchronised == [tmp_path / JOURNAL, tmp_path]


def test_each_line_is_json_with_the_hash_of_its_text_and_of_the_line_before(folder: Path) -> None:
    before = ""
    for line in (folder / JOURNAL).read_text().splitlines():
        entry = json.loads(line)
        assert entry["before"] == before
        before = entry["sha256"]
        assert sha256(line[: line.rindex(', "sha256": ')].encode()).hexdigest() == before


def test_the_first_line_is_the_plan(folder: Path) -> None:
    plan = json.loads((folder / JOURNAL).read_text().splitlines()[0])
    certificate = folder.parent / "unit.yaml"
    assert plan["unit"] == "nominal"
    assert plan["procedure"]["text"] == PROCEDURE
    assert plan["certificate"] == {"path": str(certificate), "sha256": atomic.sha256(certificate)}
    assert (folder / "before.yaml").read_bytes() == certificate.read_bytes()
    assert "latitude_deg: 28.2" in plan["site"]["text"]


def test_an_intact_session_has_no_faults(folder: Path) -> None:
    assert verify(folder).faults == ()


def test_a_flipped_bit_anywhere_in_the_journal_is_found_and_its_line_named(folder: Path) -> None:
    journal = folder / JOURNAL
    data = journal.read_bytes()
    for at in range(0, len(data), 7):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        journal.write_bytes(damaged)
        verified = verify(folder)
        fault = (*verified.faults, *verified.unfinished)[0]  # without its line break the last line is cut
        assert f"{JOURNAL}: line {line_of(data, at)}" in fault, at


@pytest.mark.parametrize(
    "name",
    ["before.yaml", "working.yaml", "run-z-up-1.mcap", "run-z-up-1.npz", "certificate.yaml", "report.html"],
)
def test_a_flipped_bit_in_a_file_is_found_and_the_file_named(folder: Path, name: str) -> None:
    session = Session.open(folder)
    for result in ("certificate.yaml", "report.html"):
        (folder / result).write_text("what came out\n")
        session.record_file(result)
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


def test_a_removed_inserted_or_moved_line_is_named(folder: Path) -> None:
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


def test_a_file_that_is_not_in_the_journal_is_reported(folder: Path) -> None:
    (folder / "notes.txt").write_text("by hand\n")
    verified = verify(folder)
    assert verified.faults == ()
    assert any("notes.txt: not in the journal" in note for note in verified.notes)


@pytest.mark.parametrize("name", [b"\x1b[2J", b"\xff", "é\n".encode()])
def test_the_name_of_such_a_file_cannot_control_the_terminal(
    folder: Path, name: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(os.fsdecode(os.fsencode(folder) + b"/" + name)).touch()
    assert main(["verify", str(folder)]) == 3
    shown = ascii(os.fsdecode(name))
    assert f"{folder}/{shown}: not in the journal, not checked\n" in capsys.readouterr().out


@pytest.mark.parametrize("name", [LOCK, "report.html", "profile.yaml", "certificate.yaml"])
def test_a_symbolic_link_is_no_file_of_a_session_to_write_to(folder: Path, name: str) -> None:
    outside = folder.parent / "outside"
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(outside)
    message = rf"{name}: (expected a file in the|cannot be opened)"
    with pytest.raises(InputError, match=message), closing(Session.open(folder)) as session:
        session.path(name)
    assert not outside.exists()


# One unit


@pytest.mark.parametrize(
    ("recording", "message"),
    [
        ({"unit": "50-0018"}, "expected a recording of unit 'nominal', got one of '50-0018'"),
        ({"profile": "imu50-rs422-acc"}, "expected the profile of the plan, imu50-rs422, got another one"),
        ({"calibration": b"other"}, "expected the calibration working.yaml, got another one"),
    ],
)
def test_a_recording_of_another_unit_profile_or_calibration_is_named(
    session: Session, accept: Accept, recorded: Callable[..., Path], recording: dict[str, Any], message: str
) -> None:
    accept(session, "z-up")
    path = recorded(session.folder / "run-x-up-1.mcap", range(900, 2000), **recording)
    session.record_file(path.name)
    session.append(bench_session.accepted_step("x-up", path.name, DEGC))
    assert f"{path}: {message}" in verify(session.folder).faults


def test_the_certificate_of_another_unit_is_named(folder: Path) -> None:
    other = NOMINAL.model_copy(update={"serial_number": "50-0018"})
    for name in ("before.yaml", "working.yaml"):
        (folder / name).unlink()
        write_calibration(folder / name, other)
    with_right_hashes(folder)
    (fault,) = verify(folder).faults
    assert fault.startswith(
        f"{folder / 'before.yaml'}: expected the calibration of unit 'nominal', got that of"
    )


@pytest.mark.parametrize("name", ["before.yaml", "working.yaml"])
def test_a_certificate_with_other_values_than_the_session_began_with_is_named(
    folder: Path, name: str
) -> None:
    gyro = NOMINAL.gyro.model_copy(update={"bias_deg_per_h": (1.0, 0.0, 0.0)})
    other = NOMINAL.model_copy(update={"gyro": gyro, "size_effect": None})
    (folder / name).unlink()
    write_calibration(folder / name, other)
    with_right_hashes(folder)
    fault = verify(folder).faults[0]
    assert fault.startswith(f"{folder / name}: expected ")


def with_right_hashes(folder: Path) -> None:
    """Give every file and line the hash that it has now."""
    lines = [json.loads(line) for line in (folder / JOURNAL).read_text().splitlines()]
    for line in lines:
        if line["event"] == "file":
            line["sha256_of_file"] = atomic.sha256(folder / line["name"])
    (folder / JOURNAL).write_bytes(bench_session.chained(lines))


# Unfinished


def test_a_session_before_its_end_is_unfinished(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(folder)]) == 3
    text = f"unfinished: accepted steps: z-up; resume with: calib run --session {folder}\n"
    assert capsys.readouterr().out.endswith(text)


def test_a_journal_cut_short_at_any_line_is_unfinished(folder: Path) -> None:
    journal = folder / JOURNAL
    lines = journal.read_bytes().splitlines(keepends=True)
    for n in range(1, len(lines)):
        journal.write_bytes(b"".join(lines[:n]))
        assert main(["verify", str(folder)]) == 3
        journal.write_bytes(b"".join(lines[:n]) + lines[n][:-5])
        assert main(["verify", str(folder)]) == 3


def test_a_certificate_with_a_skew_is_no_fault(tmp_path: Path, accept: Accept) -> None:
    session = begin(tmp_path / "session")
    session.close()
    write_calibration(tmp_path / "skewed.yaml", NOMINAL.model_copy(update={"skew_ms": 0.2}))
    skewed = Session.create(
        tmp_path / "another",
        procedure=session.plan.procedure,
        calibration=tmp_path / "skewed.yaml",
        site=session.plan.site,
        profile="imu50-rs422",
        port="/dev/ttyUSB0",
    )
    skewed.close()
    assert verify(skewed.folder).faults == ()


def test_a_session_at_its_end_without_its_certificate_is_damaged(session: Session) -> None:
    session.end(Decision(False))
    (fault,) = verify(session.folder).faults
    assert "certificate.yaml: expected in the journal of a session at its end" in fault


# Entries


def test_every_entry_of_an_older_journal_is_read_and_written_back_the_same(tmp_path: Path) -> None:
    named = {"name": "f", "text": "x: 1\n", "sha256": sha256(b"x: 1\n").hexdigest()}
    degc = {"gyro": 35.0, "accelerometer_x": None}
    at = {"step_id": "z-up", "attempt": 1, "counter": 7}
    recorded = {"recording": "run-z-up-1.mcap", "temperature_degc": degc}
    lines: list[dict[str, Any]] = [
        {
            "event": "plan",
            "format": "imu50-session",
            "version": 1,
            "software": "imu50 0.1.0",
            "unit": "50-0017",
            "port": "/dev/ttyUSB0",
            "certificate": {"path": "/unit.yaml", "sha256": "0" * 64},
            **dict.fromkeys(("procedure", "site", "profile"), named),
        },
        {"event": "file", "name": "before.yaml", "bytes": 9, "sha256_of_file": "1" * 64},
        {"event": "heard", "counter": 5, "restarted": False, "temperature_degc": degc},
        {"event": "service", "text": "port lost"},
        {"event": "entered", "phase": "place", **at},
        {
            "event": "checked",
            "counter": 7,
            "gravity_m_s2": 9.8,
            "earth_rate_deg_per_h": 15.0,
            "noise_deg_per_s": 0.01,
            "noise_mg": 0.2,
            "temperature_degc": [["gyro", 35.0], ["accelerometer_x", None]],
        },
        {"event": "restarted", "reason": "moved", **at},
        {"event": "file", "name": "run-z-up-1.mcap", "bytes": 9, "sha256_of_file": "1" * 64},
        {"event": "accepted", "step_id": "z-up", "attempt": 1, **ACCEPTED, **recorded},
        {"event": "rejected", "reasons": ["turned 150 deg"], **at},
        *({"event": event, **at} for event in ("skipped", "redone", "aborted")),
        {"event": "finished", "accepted": ["z-up"], "skipped": [], "reasons": [], "counter": 7},
        {"event": "decision", "accepted": True},
        {"event": "resumed", "left": ["run-z-up-1.mcap"]},
        {"event": "dropped", "bytes": 3, "sha256_of_dropped": "2" * 64},
        {"event": "end", "velocity_left_m_s": {"without": 0.1, "compensated": 0.002}},
        {"event": "end", "velocity_left_m_s": None},
    ]
    before, written = "", ""
    for line in lines:
        text = json.dumps({"event": line["event"], "at": "2025-01-01T00:00:00.000+00:00", **line})
        text = f'{text[:-1]}, "before": "{before}"'
        before = sha256(text.encode()).hexdigest()
        written += f'{text}, "sha256": "{before}"}}\n'
    (tmp_path / JOURNAL).write_text(written)
    entries = journals.read(tmp_path / JOURNAL).entries
    for old, entry in zip(lines, entries, strict=True):
        line: dict[str, Any] = dict(old)
        again = to_json(entry)
        # Reasons were texts, and a restart had one.
        if "reason" in line:
            line = {"reasons": [line["reason"]], **{k: v for k, v in line.items() if k != "reason"}}
        if "reasons" in line:
            again["reasons"] = [english(Message(**reason)) for reason in again["reasons"]]
        # `samples` and `turns` of an accepted step, `left` of each file, and who calibrates are newer.
        newer = "samples", "turns", "turns_within_limits", "left", "bench", "operator", "received", "host"
        new = {key for key in newer if key in again and key not in line}
        assert {k: v for k, v in again.items() if k not in new} == line


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ({"event": "invented"}, "event: expected one of .*, got text 'invented'; is it of a newer version"),
        ({"event": "file", "name": "a", "bytes": 1}, "sha256_of_file: missing; add it"),
        (
            {"event": "entered", "phase": "reset", "step_id": "a", "attempt": 1, "counter": 1},
            "phase: expected 'preflight', .* or 'aborted', got text 'reset'; did you mean rest",
        ),
    ],
)
def test_an_entry_that_is_not_valid_is_refused_with_its_key(line: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        from_json(line)


# Power cuts


def test_a_journal_cut_in_its_last_line_is_repaired_and_nothing_before_it_changes(
    folder: Path,
) -> None:
    journal = folder / JOURNAL
    data = journal.read_bytes()
    last = data.rindex(b"\n", 0, -1) + 1
    for end in range(last + 1, len(data), 9):
        journal.write_bytes(data[:end])
        verified = verify(folder)
        assert verified.faults == ()
        assert f"line {line_of(data, last)}, the last, ends after" in verified.unfinished[0]
        session = Session.open(folder)
        assert "as after a power cut; it is dropped" in session.dropped
        assert events(session)[-2:] == ["accepted", "dropped"]
        session.append(ServiceMessage("after"))
        session.close()
        assert journal.read_bytes().startswith(data[:end])
        assert verify(folder).faults == ()
        again = Session.open(folder)
        assert again.dropped == ""
        assert events(again)[-2:] == ["dropped", "service"]
        again.close()


def test_a_second_power_cut_during_the_repair_of_the_first_is_repaired(folder: Path) -> None:
    journal = folder / JOURNAL
    torn = journal.read_bytes()[:-30]
    journal.write_bytes(torn)
    Session.open(folder).close()
    repaired = journal.read_bytes()
    for end in range(len(torn) + 1, len(repaired) + 1, 5):
        journal.write_bytes(repaired[:end])
        Session.open(folder).close()
        assert journal.read_bytes() == repaired


def test_a_dropped_line_cannot_be_changed_later(folder: Path) -> None:
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


def test_a_complete_but_wrong_last_line_is_damage_and_no_power_cut(folder: Path) -> None:
    journal = folder / JOURNAL
    data = journal.read_bytes()
    journal.write_bytes(data[:-200] + data[-200:].replace(b"x-up", b"y-up"))
    with pytest.raises(InputError, match="is damaged: its text does not match its sha256"):
        Session.open(folder)


def test_a_journal_without_a_complete_first_line_is_refused(folder: Path) -> None:
    (folder / JOURNAL).write_bytes(b'{"event": "pl')
    with pytest.raises(InputError, match="expected the plan in line 1"):
        Session.open(folder)


# Steps


def test_a_step_is_accepted_until_it_is_done_again(session: Session, accept: Accept) -> None:
    accept(session, "z-up")
    accept(session, "x-up")
    assert list(session.accepted) == ["z-up", "x-up"]
    session.append(Redone("z-up", 2, -1))
    assert list(session.accepted) == ["x-up"]
    accept(session, "z-up")
    assert session.accepted["z-up"].recording == "run-z-up-2.mcap"


def test_a_recording_that_does_not_cover_its_step_is_named_with_and_without_a_certificate(
    session: Session, accept: Accept
) -> None:
    accept(session, "z-up")
    accept(session, "x-up", since=1234)
    accept(session, "verification", since=1500, samples=900)
    assert not verify(session.folder).notes[1:]
    for result in (False, True):
        if result:
            write_calibration(session.folder / "certificate.yaml", NOMINAL)
            session.record_file("certificate.yaml")
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


def test_withdrawing_a_step_withdraws_the_result(session: Session, accept: Accept) -> None:
    accept(session, "z-up")
    accept(session, "x-up", since=1234)
    session.append(FINISHED)
    (session.folder / "certificate.yaml").write_text("what came out\n")
    session.record_file("certificate.yaml")
    assert session.stage(Finished) is not None
    session.redo(["x-up"])
    assert list(session.accepted) == ["z-up"]
    assert session.stage(Finished) is None
    assert "certificate.yaml" not in session.files
    assert session.next_attempt("x-up") == 2
    assert verify(session.folder).faults == ()
    accept(session, "x-up", samples=900)
    session.append(FINISHED)
    (session.folder / "certificate.yaml").write_text("what came out then\n")
    session.record_file("certificate.yaml")
    assert session.stage(Finished) is not None
    check_files(session)


def test_an_unknown_step_cannot_be_done_again_and_the_steps_are_listed(
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
    session.append(FINISHED)
    session.append(Decision(True))
    accept(session, "verification")
    with pytest.raises(InputError, match=r"expected one of verification, got 'z-up'; the result is accepted"):
        session.redo(["z-up"])
    session.redo(["verification"])
    assert list(session.accepted) == ["z-up"]
    assert session.stage(Decision) is not None


def test_an_interrupted_attempt_counts_and_its_files_are_recorded(session: Session) -> None:
    (session.folder / "run-z-up-1.mcap").write_bytes(b"cut")
    (session.folder / "run-z-up-back-7.mcap").write_bytes(b"of another step")
    assert session.next_attempt("z-up") == 2
    assert session.record_leftovers() == ("run-z-up-1.mcap", "run-z-up-back-7.mcap")
    assert session.record_leftovers() == ()
    assert verify(session.folder).faults == ()


def test_only_one_process_can_open_a_session(session: Session) -> None:
    with pytest.raises(InputError, match="another process has this session open"):
        Session.open(session.folder)


def test_a_new_session_does_not_touch_an_existing_one(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match="expected a new folder, it contains a session"):
        begin(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    Session.open(folder).close()


def test_the_service_gets_the_certificate_without_size_effect(session: Session) -> None:
    assert session.calibration() == NOMINAL.model_copy(update={"size_effect": None})


# Resuming


def test_a_session_resumes_with_the_files_it_began_with(session: Session) -> None:
    files = session.folder.parent
    check_files(session)
    require_same(session)
    require_same(
        session,
        procedure=embedded(files / "bench.yaml"),
        calibration=files / "unit.yaml",
        site=embedded(files / "site.yaml"),
        profile="imu50-rs422",
    )


def test_a_profile_of_the_users_own_is_that_in_the_plan_not_the_file_at_its_path(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_bytes(profiles.content("imu50-rs422") + b"# own\n")
    with closing(begin(tmp_path / "session", str(own))) as session:
        text = own.read_bytes()
        own.unlink()
        os.mkfifo(own)  # would block whoever opens it
        assert session.profile() == str(session.folder / "profile.yaml")
        assert Path(session.profile()).read_bytes() == text
        require_same(session, profile=session.profile())
        assert not any("not checked" in note for note in verify(session.folder).notes)


def test_another_unit_is_refused(session: Session) -> None:
    other = NOMINAL.model_copy(update={"serial_number": "50-0018"})
    write_calibration(session.folder.parent / "unit.yaml", other)
    with pytest.raises(InputError, match=r"cannot be resumed:\n  unit: expected 'nominal', got '50-0018'"):
        require_same(session)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"procedure": EmbeddedFile.of("other.yaml", b"another\n")},
            "procedure: expected .*bench.yaml unchanged, got other",
        ),
        (
            {"site": EmbeddedFile.of("roof.yaml", b"another\n")},
            "site: expected .*site.yaml unchanged, got roof.yaml",
        ),
        ({"profile": "imu50-can"}, "profile: expected imu50-rs422 unchanged, got imu50-can"),
    ],
)
def test_other_files_are_refused(session: Session, given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        require_same(session, **given)


def test_a_certificate_that_was_changed_meanwhile_is_refused_but_the_sessions_own_result_is_not(
    session: Session,
) -> None:
    active = session.folder.parent / "unit.yaml"
    write_calibration(active, session.calibration())
    with pytest.raises(InputError, match="certificate: expected the one that the session began with"):
        require_same(session)
    (session.folder / "certificate.yaml").write_bytes(active.read_bytes())
    session.record_file("certificate.yaml")
    require_same(session)


def test_a_temperature_far_from_the_accepted_runs_is_refused(session: Session, accept: Accept) -> None:
    require_temperature(session, {"gyro": 20.0})
    accept(session, "z-up", {"gyro": 34.0, "accelerometer_x": 36.0})
    accept(session, "x-up", {"gyro": 36.0, "accelerometer_x": 36.0})
    require_temperature(session, {"gyro": 39.9, "accelerometer_x": None})
    with pytest.raises(InputError, match=r"gyro: expected 35\.0 degC within 5 K, .* got 40\.1"):
        require_temperature(session, {"gyro": 40.1, "accelerometer_x": 36.0})
    with pytest.raises(InputError, match="got 29"):
        require_temperature(session, {"gyro": 29.0})


def test_a_session_with_a_damaged_recording_is_not_resumed(session: Session, accept: Accept) -> None:
    accept(session, "z-up")
    (session.folder / "run-z-up-1.mcap").write_bytes(b"other")
    with pytest.raises(InputError, match=r"cannot be resumed:\n  .*run-z-up-1.mcap: was damaged"):
        check_files(session)


@pytest.mark.parametrize("answer", ["y", "n"])
def test_a_session_is_resumed_only_after_the_operator_confirms(
    session: Session, accept: Accept, answer: str
) -> None:
    accept(session, "z-up")
    shown, before = StringIO(), len(session.entries)
    console = Console(file=shown, width=200)
    if answer == "n":
        with pytest.raises(InputError, match="not resumed and not changed"):
            resume(session, console, ["z-up"], "en", lambda: answer == "y")
        assert len(session.entries) == before
    else:
        resume(session, console, ["z-up"], "en", lambda: answer == "y")
        assert events(session)[before:] == ["redone", "resumed"]
    assert "of unit nominal: accepted steps: z-up" in shown.getvalue()
    assert "resume it? [y/n]" in shown.getvalue()


def test_a_number_that_cannot_be_read_back_is_refused_before_it_is_written(session: Session) -> None:
    before = (session.folder / JOURNAL).read_bytes()
    with pytest.raises(InputError, match=r"temperature_degc.gyro: expected a finite number, got nan"):
        session.append(UnitDetected(1, False, {"gyro": float(np.nan)}))
    assert (session.folder / JOURNAL).read_bytes() == before


def test_a_session_keeps_the_certificate_that_it_has_read_though_the_file_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Serial number, SHA-256 and copy come from one read, so that two certificates are never mixed."""
    read: list[bytes] = []

    def read_and_replace(path: Path) -> SettingsFile[Calibration]:
        file = read_calibration_file(path)
        read.append(file.content)
        path.write_bytes(file.content + b"# another\n")
        return file

    monkeypatch.setattr("calib.bench.session.read_calibration_file", read_and_replace)
    session = begin(tmp_path / "session")
    session.close()
    (content,) = read
    assert (session.folder / INITIAL_CERTIFICATE).read_bytes() == content
    assert session.plan.certificate.sha256 == sha256(content).hexdigest()
