"""A page as PDF, by a browser or weasyprint, whichever is installed."""

import os
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from imudrv.errors import InputError

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
TIMEOUT_S: Final = 120.0


def renderer() -> str:
    """Return the program that makes a PDF.

    Raises
    ------
    InputError
        There is none.
    """
    for name in (*BROWSERS, "weasyprint"):
        if path := shutil.which(name):
            return path
    raise InputError(f"--pdf: expected one of {', '.join(BROWSERS)} or weasyprint, got none; install one")


def write_pdf(page: Path, pdf: Path) -> None:
    """Write an HTML file as PDF.

    Parameters
    ----------
    page : Path
        The file.
    pdf : Path
        What is written.

    Raises
    ------
    InputError
        There is no program for it, or it fails.
    """
    program = renderer()
    with TemporaryDirectory() as profile:
        if program.endswith("weasyprint"):
            command = [program, str(page), str(pdf)]
        else:
            command = [program, "--headless", "--disable-gpu", f"--user-data-dir={profile}"]
            command += ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
            command += ["--no-pdf-header-footer", f"--print-to-pdf={pdf.resolve()}", page.resolve().as_uri()]
        pdf.unlink(missing_ok=True)
        try:
            done = subprocess.run(command, capture_output=True, timeout=TIMEOUT_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"{pdf}: {program} did not make it: {error}") from error
    if not pdf.exists():
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise InputError(f"{pdf}: {program} did not make it, exit code {done.returncode}: {last}")
