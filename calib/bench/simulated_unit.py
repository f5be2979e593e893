"""Simulated unit and certificate of a rehearsal."""

import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Timer
from typing import Final

import numpy as np

from calib.bench.technician import (
    BENCH,
    NEW_UNIT,
    LiveTechnician,
    Mistake,
    mistakes_of,
    new_unit_scenario,
    technician_scenario,
    true_calibration,
    true_new_unit,
    unit_scenario,
)
from calib.procedure.events import View
from calib.procedure.schema import VERIFICATION, Kind, Procedure
from imudrv import profiles
from imudrv.calibration import Calibration, write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.loopback import LOOPBACK
from imudrv.posix import termios
from imudrv.sim import scenario as scenarios
from imudrv.sim.scenario import Segment, nominal
from imudrv.url import speed_of
from imudrv.wire.layout import Layout

SEED: Final = 1
"""Random seed of the rehearsal's unit and technician."""


_FOLDER: Final = "rehearsal"


_START_TIMEOUT_S: Final = 60.0


# The unit ends with its parent process, even when that is killed: its standard input then ends.
_UNIT: Final = (
    "import os, sys, threading; "
    "threading.Thread(target=lambda: os.read(0, 1) or os._exit(0), daemon=True).start(); "
    "from imudrv.cli import main; sys.exit(main())"
)


def _free_port() -> int:
    with socket.create_server((LOOPBACK, 0)) as server:
        return int(server.getsockname()[1])


def is_rehearsal(folder: Path) -> bool:
    """Return whether the session in a folder is a rehearsal."""
    return (folder / _FOLDER).is_dir()


class SimulatedUnitProcess:
    """Process with a simulated unit, moved by a simulated technician, on a pty, or on TCP if there are none.

    Parameters
    ----------
    folder : Path
        Folder of the session.
    speed : str
        Seconds of the rehearsal per second, or ``max``: as fast as the engine accepts samples.
    mistakes : str
        What the technician does wrong, see `mistakes_of`; empty: nothing.
    is_live : bool
        The technician follows the screen, while a person presses the keys; otherwise the time.

    Raises
    ------
    InputError
        The speed is invalid.

    Attributes
    ----------
    port : str
        Port of the unit, for the driver.
    """

    def __init__(self, folder: Path, speed: str, mistakes: str = "", is_live: bool = False) -> None:
        self._mistakes, self._is_live = mistakes, is_live
        self._technician: LiveTechnician | None = None
        self._folder = folder / _FOLDER
        self._speed = speed
        self.waits = speed_of(speed) is None
        if is_live and self.waits:
            raise InputError("--speed max: expected a number, as a person presses the keys")
        self._unit: subprocess.Popen[str] | None = None
        if termios is not None:
            self.port, self._target = str(self._link), ["--port", "pty", "--link", str(self._link)]
        else:
            address = f"{LOOPBACK}:{_free_port()}"
            self.port, self._target = f"socket://{address}", ["--port", f"tcp://{address}"]

    def make(self, layout: Layout, kind: Kind) -> tuple[str, Path, Path]:
        """Write the unit's certificate and site.

        Parameters
        ----------
        layout : Layout
            Layout of the profile.
        kind : {'arms', 'sensors', 'noise'}
            Kind of the procedure.

        Returns
        -------
        str
            Port of the unit.
        Path
            Its certificate, without lever arms; of a unit whose sensors are to be calibrated there is none.
        Path
            Site of the bench.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        certificate, site = self._folder / "unit.yaml", self._folder / "site.yaml"
        unit = self.truth(layout, kind)
        if kind != "sensors":
            write_calibration(certificate, unit.model_copy(update={"size_effect": None}))
        settings_file.write(site, BENCH if kind == "arms" else scenarios.load(NEW_UNIT).site)
        return self.port, certificate, site

    def truth(self, layout: Layout, kind: Kind) -> Calibration:
        """Return the true unit, to compare the result of a kind of procedure with at the end."""
        return true_calibration(SEED, nominal(layout)) if kind == "arms" else true_new_unit(nominal(layout))

    def begin(self, procedure: Procedure, profile: str) -> None:
        """Start the unit anew and carry out a procedure with it.

        Parameters
        ----------
        procedure : Procedure
            The remaining steps.
        profile : str
            Wire format of the unit.

        Raises
        ------
        InputError
            The unit does not start.
        """
        self.end()
        scenario = self._folder / "scenario.yaml"
        sends = nominal(profiles.load(profile).layout())
        mistakes: tuple[Mistake, ...] = ()
        if self._mistakes and procedure.steps[0].id != VERIFICATION:
            mistakes = mistakes_of(self._mistakes, procedure, np.random.default_rng())
        if self._is_live:
            self._technician = technician = LiveTechnician(procedure, mistakes, SEED, self._move)
            if procedure.runs:
                truth = true_calibration(SEED, sends)
                scene = unit_scenario(technician.start, technician.begins_with, truth, SEED)
            else:
                scene = new_unit_scenario(technician.start, technician.begins_with, sends, SEED)
            port, link = (self._target[1], self._target[3]) if termios is not None else (self._target[1], "")
            command = ["-m", "calib.bench.live_unit", str(scenario), profile, port, link, self._speed]
        else:
            scene = technician_scenario(procedure, mistakes, seed=SEED, unit=sends)
            sim = ["sim", str(scenario), "--profile", profile, *self._target, "--speed", self._speed]
            command = ["-c", _UNIT, *sim]
        settings_file.write(scenario, scene)
        self._unit = unit = subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        limit = Timer(_START_TIMEOUT_S, unit.kill)
        limit.start()
        is_there = unit.stdout is not None and unit.stdout.readline()  # "... plays on PORT"
        limit.cancel()
        if not is_there:
            _, reason = unit.communicate()
            raise InputError(f"the simulated unit did not start: {reason.strip()}")

    def watch(self, view: View) -> None:
        """Let the technician look at the screen."""
        if self._technician is not None:
            self._technician.watch(view)

    def _move(self, motions: Sequence[Segment]) -> None:
        if self._unit is not None and self._unit.stdin is not None:
            with suppress(OSError):  # it has ended; the service says so
                for motion in motions:
                    self._unit.stdin.write(f"{motion.model_dump_json(exclude_none=True)}\n")
                self._unit.stdin.flush()

    def end(self) -> None:
        """End the unit's process."""
        if self._unit is not None:
            with self._unit:
                self._unit.kill()
        self._link.unlink(missing_ok=True)

    @property
    def _link(self) -> Path:
        return self._folder.resolve() / "port"
