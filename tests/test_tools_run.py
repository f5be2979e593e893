"""`tools/run` sets up the checkout that it is in, wherever that is. A script takes the place of Python."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

TOP = Path(__file__).parents[1]
NOBODY = 65534
PYTHON = """\
#!/bin/sh
# `-m venv DIR` copies this script to DIR/bin/python; `-m pip ... -e TOP[dev]` makes the program `where`,
# which prints TOP. As with pip, the program's first line has an absolute path of the environment.
# `-m imudrv warm` fails, as it does where kernels cannot be kept.
for last in "$@"; do :; done
bin=$(dirname "$0")
case "$2" in
venv)
    [ "$3" != --clear ] || rm -rf "$last"
    mkdir -p "$last/bin"
    ln -sf /bin/sh "$last/bin/sh"
    cp "$0" "$last/bin/python" ;;
pip)
    top=${last%?dev?}
    printf '#!%s/.venv/bin/sh\\necho %s\\n' "$top" "$top" >"$bin/where"
    chmod +x "$bin/where" ;;
imudrv)
    [ "$3" = warm ] && echo compiling >&2
    exit 2 ;;
esac
"""
INSTALLING = "tools/run: installing into .venv (once, a minute or two)\ncompiling\n"


@pytest.fixture
def checkout() -> Iterator[Path]:
    """A checkout in a folder that every user can read."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    top = folder / "one"
    (top / "tools").mkdir(parents=True)
    shutil.copy(TOP / "tools" / "run", top / "tools")
    shutil.copy(TOP / "pyproject.toml", top)
    python = folder / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    yield top
    shutil.rmtree(folder)


def where(top: Path, **more: int) -> subprocess.CompletedProcess[str]:
    """Ask the program which checkout it belongs to."""
    return subprocess.run(
        [top / "tools" / "run", "where"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHON": str(top.parent / "python")},
        check=False,
        **more,  # type: ignore[arg-type]
    )


def set_up(top: Path) -> None:
    assert (where(top).stdout, where(top).stderr) == (f"{top}\n", "")


def test_a_checkout_is_set_up_once_and_again_when_its_dependencies_change(checkout: Path) -> None:
    assert where(checkout).stderr == INSTALLING
    set_up(checkout)
    with (checkout / "pyproject.toml").open("a") as file:
        file.write("# one more\n")
    assert where(checkout).stderr == INSTALLING
    set_up(checkout)


def test_a_moved_checkout_is_set_up_again(checkout: Path) -> None:
    where(checkout)
    moved = checkout.rename(checkout.with_name("two"))
    done = where(moved)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{moved}\n", INSTALLING)
    set_up(moved)


def test_a_copied_checkout_runs_its_own_sources(checkout: Path) -> None:
    where(checkout)
    copy = Path(shutil.copytree(checkout, checkout.with_name("two"), symlinks=True))
    done = where(copy)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{copy}\n", INSTALLING)
    set_up(checkout)
    set_up(copy)


def test_a_link_to_a_checkout_is_the_same_checkout(checkout: Path) -> None:
    where(checkout)
    link = checkout.with_name("link")
    link.symlink_to(checkout)
    done = where(link)
    assert (done.stdout, done.stderr) == (f"{checkout}\n", "")


def test_a_checkout_without_its_python_is_set_up_again(checkout: Path) -> None:
    where(checkout)
    (checkout / ".venv" / "bin" / "python").unlink()
    assert where(checkout).stderr == INSTALLING
    set_up(checkout)


def test_a_read_only_checkout_is_named_unless_it_is_set_up(checkout: Path) -> None:
    someone_else = {"user": NOBODY} if os.geteuid() == 0 else {}
    for folder in (checkout, checkout / "tools"):
        folder.chmod(0o555)
    done = where(checkout, **someone_else)
    assert done.returncode == 2
    assert done.stderr.startswith(
        f"tools/run: expected to install into {checkout}/.venv, but this user may not"
    )
    checkout.chmod(0o755)
    where(checkout)
    checkout.chmod(0o555)
    done = where(checkout, **someone_else)
    assert (done.stdout, done.stderr) == (f"{checkout}\n", "")
    checkout.chmod(0o755)
