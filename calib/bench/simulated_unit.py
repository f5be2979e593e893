"""Simulated unit and certificate of a rehearsal."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from calib.bench.technician import BENCH, technician_scenario
from calib.procedure.schema import Procedure
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.sim.live import speed_of

SEED: Final = 1
"""Of the rehearsal's unit and technician."""


_PATIENCE_S: Final = 60.0


# The unit ends with whoever started it, however that ends (Linux: PR_SET_PDEATHSIG, SIGKILL), and does not
# begin where that has ended already.
_UNIT: Final = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); "
    "os.getppid() == int(sys.argv.pop(1)) or sys.exit(); "
    "from imudrv.cli import main; sys.exit(main())"
)


class SimulatedUnitProcess:
    """A simulated unit in the hands of a simulated technician, in a process of its own, on a pty.

    Parameters
    ----------
    folder : Path
        Of the session.
    speed : str
        Seconds of the rehearsal in a second, or ``max``: as fast as the engine takes it.

    Raises
    ------
    InputError
        Not a speed.
    """

    def __init__(self, folder: Path, speed: str) -> None:
        self._folder = folder / "rehearsal"
        self._speed = speed
        self.waits = speed_of(speed) is None
        self._unit: subprocess.Popen[str] | None = None

    @staticmethod
    def was(folder: Path) -> bool:
        """Whether a session is a rehearsal."""
        return (folder / "rehearsal").is_dir()

    def make(self, procedure: Procedure) -> tuple[str, Path, Path]:
        """Make the unit's papers.

        Parameters
        ----------
        procedure : Procedure
            Of the session.

        Returns
        -------
        str
            Its port.
        Path
            Its certificate, without the arms.
        Path
            Where it stands.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        unit = technician_scenario(procedure, seed=SEED).unit.calibration
        assert unit is not None
        certificate, site = self._folder / "unit.yaml", self._folder / "site.yaml"
        write_calibration(certificate, unit.model_copy(update={"size_effect": None}))
        settings_file.write(site, BENCH)
        return str(self._link), certificate, site

    def begin(self, procedure: Procedure, profile: str) -> None:
        """Carry a procedure out from the beginning, with the unit switched on anew.

        Parameters
        ----------
        procedure : Procedure
            The steps that are left.
        profile : str
            What the unit sends.

        Raises
        ------
        InputError
            The unit does not come up.
        """
        self.end()
        scenario = self._folder / "scenario.yaml"
        settings_file.write(scenario, technician_scenario(procedure, seed=SEED))
        command = ["sim", str(scenario), "--profile", profile, "--port", "pty", "--link", str(self._link)]
        self._unit = subprocess.Popen(
            [sys.executable, "-c", _UNIT, str(os.getpid()), *command, "--speed", self._speed],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        end = time.monotonic() + _PATIENCE_S
        while not self._link.exists():
            if self._unit.poll() is not None or time.monotonic() > end:
                self.end()
                assert self._unit.stderr is not None
                raise InputError(f"the simulated unit did not come up: {self._unit.stderr.read().strip()}")
            time.sleep(0.02)

    def end(self) -> None:
        """Switch the unit off."""
        if self._unit is not None:
            self._unit.kill()
            self._unit.wait()
        self._link.unlink(missing_ok=True)

    @property
    def _link(self) -> Path:
        return self._folder.resolve() / "port"
