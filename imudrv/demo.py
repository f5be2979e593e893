"""The demonstration: the whole story on a simulated unit, by the command that a technician types.

`calib` stands above this package, so it is started like any other program.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

STORY: Final = """\
A simulated unit with errors that its certificate does not know is read by the driver service from a virtual
serial port. A simulated technician walks through the bench procedure in fast time: Z, X, Y up, each aligned
and turned by half a circle. From the recordings the inner lever arms are found and a new certificate is made;
one more turn, with and without them compensated, is the proof."""


def demo(say: Callable[[str], None]) -> int:
    """Rehearse the bench procedure from wire bytes to certificate, verification and report.

    Parameters
    ----------
    say : callable
        Told what is going to happen, a line at a time.

    Returns
    -------
    int
        Exit code.
    """
    say(STORY)
    session = Path(tempfile.mkdtemp(prefix="imu50-demo-")) / "session"
    command = ["run", "--rehearse", "--speed", "max", "--session", str(session)]
    code = subprocess.run([sys.executable, "-m", "calib", *command], check=False).returncode
    if code == 0:
        say(f"check it all again from the recordings: tools/run calib verify {session}")
    return code
