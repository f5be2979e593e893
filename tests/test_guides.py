"""The commands of README and guides work when pasted in their order.

A fenced block names what the test does with it: ``sh`` is pasted, ``sh live`` runs until the guide ends,
``sh status`` is repeated until samples flow, ``sh hardware`` needs a unit, ``sh long`` minutes and
``python live`` a terminal of its own (none is run), ``yaml NAME.yaml`` and ``python NAME.py`` are written to
a file.
"""

import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, get_args

import pytest
from realtime import DEADLINE_S

from imudrv.files.model import Model
from imudrv.profiles.schema import Profile

TOP = Path(__file__).resolve().parents[1]
GUIDES = sorted((TOP / "tools" / "guides").glob("*.md"))
BLOCK = re.compile(r"^```(\w+)(?: ([\w.-]+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FLOWING = (0, 3)
"""Exit codes of `imudrv status` while samples flow: ok, and warning."""
KINDS = {"sh": {"", "live", "status", "hardware", "long"}, "python": {"", "live"}, "yaml": {""}}
KEY = re.compile(r"^\| `([\w.]+)` \|.*\| ([^|]*) \|[^|]*\|$", re.MULTILINE)
"""Row of the table of all keys: path and default."""


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in which ``tools/run`` runs what follows it, without an installation."""
    run = tmp_path / "tools" / "run"
    run.parent.mkdir()
    run.write_text('#!/bin/sh\nexec "$@"\n')
    run.chmod(0o755)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(TOP))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


@contextmanager
def running(text: str, folder: Path) -> Iterator[None]:
    """Run a block until the end."""
    process = subprocess.Popen(["bash", "-c", f"exec {text}"], cwd=folder, start_new_session=True)
    try:
        yield
        assert process.poll() is None, f"ended early: {text}"
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        process.wait(DEADLINE_S)


def pasted(text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = ["bash", "-e", "-o", "pipefail", "-c", text]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=DEADLINE_S)


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_the_commands_of_a_guide_work_in_their_order(guide: Path, shell: Path) -> None:
    with ExitStack() as live:
        # Names in /tmp are the same for whoever runs this beside it.
        for language, kind, text in BLOCK.findall(guide.read_text().replace("/tmp/", f"{shell}/")):
            if "." in kind:
                (shell / kind).write_text(text)
            elif (language, kind) == ("sh", "live"):
                live.enter_context(running(text, shell))
            elif (language, kind) == ("sh", "status"):
                end = time.monotonic() + DEADLINE_S
                while pasted(text, shell).returncode not in FLOWING:
                    assert time.monotonic() < end, f"waited in vain: {text}"
            elif not kind:
                done = pasted(text if language == "sh" else f"python - <<'END'\n{text}\nEND", shell)
                assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_each_block_of_a_guide_says_what_to_do_with_it(guide: Path) -> None:
    for language, kind, _ in BLOCK.findall(guide.read_text()):
        assert "." in kind or kind in KINDS[language], f"{language} {kind}"


def keys(model: type[Model], path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the default of each key of a model, and of the models inside."""
    for name, field in model.model_fields.items():
        default = "-" if field.default in (None, ()) else str(field.default)
        yield f"{path}{name}", "required" if field.is_required() else default.replace("False", "false")
        for inner in models(field.annotation):
            yield from keys(inner, f"{path}{name}.")


def models(annotation: Any) -> Iterator[type[Model]]:
    if isinstance(annotation, type) and issubclass(annotation, Model):
        yield annotation
    for argument in get_args(annotation):
        yield from models(argument)


def test_the_guide_of_profiles_has_each_key_with_its_default() -> None:
    table = (TOP / "tools" / "guides" / "profiles.md").read_text().partition("## All keys")[2]
    assert dict(KEY.findall(table)) == dict(keys(Profile))


def test_what_check_prints_is_in_the_guide(shell: Path) -> None:
    guide = (TOP / "tools" / "guides" / "profiles.md").read_text()
    (profile,) = (text for _, kind, text in BLOCK.findall(guide) if kind == "tern.yaml")
    (shell / "tern.yaml").write_text(profile)
    done = pasted("imudrv check tern.yaml", shell)
    assert textwrap.indent(done.stdout, "    ") in guide


def test_the_readme_is_short_and_its_links_lead_somewhere() -> None:
    readme = (TOP / "README.md").read_text()
    assert len(readme) < 5500
    for link in re.findall(r"\]\(([^)]+)\)", readme):
        assert (TOP / link).exists(), link
    assert {f"tools/guides/{guide.name}" for guide in GUIDES} == set(
        re.findall(r"tools/guides/\w+\.md", readme)
    )
