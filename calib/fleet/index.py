"""SQLite index of the sessions in a tree of folders.

The files are the truth. A session is read again when its journal has changed; its files are checked
against the hashes of the journal then. So an index that is brought up to date equals one made from nothing.
"""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from calib.bench import journal
from calib.bench.entries import Decision
from calib.bench.state import JOURNAL, REPORTS, RESULT, SessionState
from calib.bench.verify import faulty_files
from calib.certificate import lever_arms_of
from calib.fleet.changes import Measurement
from calib.lever_arms.gauge import LeverArms
from imudrv.arrays import Array
from imudrv.calibration import Calibration, read_calibration
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.sensor_calibration import number_paths
from imudrv.units import MM

ARMS: Final = tuple(f"arms.x_minus_{point}_mm.{axis}" for point in "yz" for axis in "xyz")
"""Names of the lever arms: what rotations determine, the same in every gauge."""
_DIFFERENCES: Final = np.kron([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3))
_VERSION: Final = 1
_SECONDS_PER_DAY: Final = 86_400
_TABLES: Final = """
CREATE TABLE session (
    folder TEXT PRIMARY KEY,      -- relative to the tree
    journal_sha256 TEXT NOT NULL,
    fault TEXT NOT NULL,          -- why it is not used; empty: it is
    unit TEXT NOT NULL,
    bench TEXT NOT NULL,
    operator TEXT NOT NULL,
    host TEXT NOT NULL,
    software TEXT NOT NULL,
    created TEXT NOT NULL,        -- of the certificate, UTC
    arms_covariance_mm2 TEXT NOT NULL  -- JSON, 6 x 6
) STRICT;
CREATE TABLE quantity (
    folder TEXT NOT NULL REFERENCES session (folder) ON DELETE CASCADE,
    name TEXT NOT NULL,
    value REAL NOT NULL,
    sigma REAL,                   -- NULL: not known
    PRIMARY KEY (folder, name)
) STRICT;
CREATE INDEX session_of_unit ON session (unit, created);
"""


class Updated(NamedTuple):
    """Number of sessions by what an update did with them, and what is wrong with any."""

    new: int
    unchanged: int
    removed: int
    faults: tuple[str, ...]


def update(tree: Path, path: Path) -> Updated:
    """Bring an index up to date, or make it.

    Parameters
    ----------
    tree : Path
        Folder with sessions, at any depth.
    path : Path
        The index.

    Returns
    -------
    Updated

    Raises
    ------
    InputError
        There is no such folder, or the index cannot be read or written.
    """
    if not tree.is_dir():
        raise InputError(f"{tree}: expected a folder with sessions, there is none; check the path")
    with opened(path, create=True) as database:
        known = dict(database.execute("SELECT folder, journal_sha256 FROM session").fetchall())
        found: dict[str, str] = {}
        new = 0
        for file in sorted(tree.rglob(JOURNAL)):
            folder = file.parent.relative_to(tree).as_posix()
            found[folder] = digest = atomic.sha256(file)
            if known.get(folder) != digest:
                _insert(database, tree, folder, digest)
                new += 1
        removed = set(known) - set(found)
        database.executemany("DELETE FROM session WHERE folder = ?", [(folder,) for folder in removed])
        faults = database.execute(
            "SELECT folder || ': ' || fault FROM session WHERE fault <> '' ORDER BY folder"
        )
        return Updated(new, len(found) - new, len(removed), tuple(text for (text,) in faults))


def measurements(database: sqlite3.Connection) -> list[Measurement]:
    """Return the lever arms of all accepted sessions, mm, in the order of their dates."""
    rows = database.execute(
        "SELECT folder, unit, bench, created, arms_covariance_mm2 FROM session WHERE fault = '' "
        "ORDER BY created, folder"
    ).fetchall()
    values: dict[str, dict[str, float]] = {}
    for folder, name, value in database.execute("SELECT folder, name, value FROM quantity"):
        values.setdefault(folder, {})[name] = value
    return [
        Measurement(
            unit,
            bench,
            datetime.fromisoformat(created).timestamp() / _SECONDS_PER_DAY,
            np.array([values[folder][name] for name in ARMS]),
            np.array(json.loads(covariance)),
        )
        for folder, unit, bench, created, covariance in rows
    ]


@contextmanager
def opened(path: Path, *, create: bool = False) -> Iterator[sqlite3.Connection]:
    """Open an index; what was changed is kept if nothing is raised.

    Parameters
    ----------
    path : Path
        The index.
    create : bool
        Make it if there is none.

    Yields
    ------
    sqlite3.Connection

    Raises
    ------
    InputError
        There is none, or it is another file.
    """
    if not create and not path.is_file():
        raise InputError(f"{path}: expected an index, there is none; make it: calib fleet index TREE")
    try:
        with closing(sqlite3.connect(path)) as database, database:
            database.execute("PRAGMA foreign_keys = ON")
            (version,) = database.execute("PRAGMA user_version").fetchone()
            if version == 0 and create:
                database.executescript(f"{_TABLES}; PRAGMA user_version = {_VERSION};")
            elif version != _VERSION:
                raise InputError(
                    f"{path}: expected an index of version {_VERSION}, got {version}; delete it, and make it "
                    "again from the sessions"
                )
            yield database
    except sqlite3.Error as error:
        raise InputError(f"{path}: expected an index that can be read and written: {error}") from error


def _insert(database: sqlite3.Connection, tree: Path, folder: str, digest: str) -> None:
    row: dict[str, Any] = dict.fromkeys(
        ("fault", "unit", "bench", "operator", "host", "software", "created"), ""
    )
    row["arms_covariance_mm2"] = "[]"
    quantities: list[tuple[str, float, float | None]] = []
    try:
        session = SessionState(tree / folder, journal.read(tree / folder / JOURNAL).entries)
        plan = session.plan
        row |= {
            "unit": plan.unit,
            "bench": session.bench().bench,
            "operator": plan.operator,
            "host": plan.host,
            "software": plan.software,
            "fault": _fault(session),
        }
        if not row["fault"]:
            calibration = read_calibration(session.path(RESULT), plan.unit)
            arms = lever_arms_of(calibration, str(session.path(RESULT)))
            value, covariance = _differences(arms)
            row["created"] = calibration.created.astimezone(UTC).isoformat()
            row["arms_covariance_mm2"] = json.dumps(covariance.tolist())
            sigma = np.sqrt(np.diag(covariance)).tolist()
            quantities = [*zip(ARMS, value.tolist(), sigma, strict=True), *_of_sensors(calibration)]
    except InputError as error:
        row["fault"] = str(error)
    row["fault"] = row["fault"].replace(f"{tree}/", "")
    names = ", ".join(row)
    database.execute("DELETE FROM session WHERE folder = ?", (folder,))
    database.execute(
        f"INSERT INTO session (folder, journal_sha256, {names}) VALUES (?, ?{', ?' * len(row)})",
        (folder, digest, *row.values()),
    )
    database.executemany(
        "INSERT INTO quantity VALUES (?, ?, ?, ?)", [(folder, *quantity) for quantity in quantities]
    )


def _fault(session: SessionState) -> str:
    """Return why a session does not count; empty if it does."""
    if session.procedure().kind == "noise":
        return "a session of the noise: nothing of its certificate was measured again"
    decision = session.stage(Decision)
    if RESULT not in session.files or decision is None or not decision.accepted:
        return "no accepted result"
    others = session.files.keys() - set(REPORTS.values())  # a report may be written anew
    return "; ".join(faulty_files(session, others))


def _differences(arms: LeverArms) -> tuple[Array, Array]:
    """Return r_x - r_y and r_x - r_z, mm, and their covariance."""
    if arms.covariance is None:
        raise InputError("expected a certificate with the covariance of its lever arms, got one without")
    value: Array = _DIFFERENCES @ arms.r_b.ravel() / MM
    covariance: Array = _DIFFERENCES @ arms.covariance @ _DIFFERENCES.T / MM**2
    return value, covariance


def _of_sensors(calibration: Calibration) -> Iterator[tuple[str, float, float | None]]:
    """Yield the numbers of the sensors, in the units of the file, with their sigma where it is known."""
    covariance = None if calibration.sensors is None else calibration.sensors.covariance
    sigma: dict[str, float] = {}
    if covariance is not None:
        sigma = dict(zip(covariance.names, np.sqrt(np.diag(covariance.matrix)).tolist(), strict=True))
    document: Any = calibration.model_dump(include={"gyro", "accelerometer"}, exclude_none=True)
    for path in number_paths(document):
        value = document
        for part in path.replace("[", ".").replace("]", "").split("."):
            value = value[int(part)] if part.isdecimal() else value[part]
        yield path, float(value), sigma.get(path)
