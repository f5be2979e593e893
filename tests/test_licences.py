"""The licences of all dependencies are on the allowed list."""

from email.message import Message

import pytest

from tools import licences


def test_all_dependencies_have_an_allowed_licence(capsys: pytest.CaptureFixture[str]) -> None:
    code = licences.main()
    printed = capsys.readouterr().out
    assert code == 0, printed
    for name in (
        "numpy",
        "python-can",
        "llvmlite",
        "msgpack",
        "cantools",
        "hypothesis",
    ):  # of dependencies too
        assert f"ok    {name} " in printed


@pytest.mark.parametrize(
    ("licence", "is_allowed"),
    [
        ("MIT", True),
        ("MIT License", True),
        ("BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0", True),
        ("BSD-2-Clause AND Apache-2.0 WITH LLVM-exception", True),
        ("GPL-3.0-only OR MIT", True),
        ("GPL-3.0-only", False),
        ("GNU General Public License v3 (GPLv3)", False),
        ("MIT AND GPL-3.0-only", False),
        ("Proprietary", False),
        ("", False),
    ],
)
def test_a_licence_is_judged_by_its_parts(licence: str, is_allowed: bool) -> None:
    assert licences.is_allowed(licence) == is_allowed


def test_one_licence_that_is_not_allowed_fails_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(licences, "ALLOWED", licences.ALLOWED - {"LGPL-3.0-only"})
    assert licences.main() == 1
    assert "FAIL  python-can " in capsys.readouterr().out


class Stated:
    """A package with these lines in its metadata."""

    def __init__(self, **lines: str) -> None:
        self.metadata = Message()
        for name, text in lines.items():
            self.metadata[name.replace("_", "-")] = text


@pytest.mark.parametrize(
    ("package", "licence"),
    [
        (Stated(License_Expression="MIT", Classifier="License :: OSI Approved :: BSD License"), "MIT"),
        (Stated(Classifier="License :: OSI Approved :: BSD License", License="x"), "BSD License"),
        (Stated(Classifier="Topic :: Security", License="BSD"), "BSD"),
        (Stated(), ""),
    ],
)
def test_an_expression_counts_before_a_classifier_and_that_before_free_text(
    package: Stated, licence: str
) -> None:
    assert licences.licence_of(package) == licence  # type: ignore[arg-type]
