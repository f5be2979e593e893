"""Signatures: the key of the bench, signed certificates and journals, and trusted keys."""

import json
import os
import subprocess
import sys
from base64 import b64decode, b64encode
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from bench_session import begin, chained
from samples import CERTIFICATE

from calib.bench import journal
from calib.bench.entries import Decision, ServiceMessage, Signed
from calib.bench.session import Session
from calib.bench.state import JOURNAL
from calib.bench.verify import verify
from calib.cli import main
from calib.signing.keys import bench_key, key_path, make_bench_key, read_trusted
from calib.signing.signatures import fingerprint, is_valid, sign
from imudrv.calibration import Signature, read_calibration, write_calibration
from imudrv.cli import main as imudrv
from imudrv.errors import InputError

ARMS = """\
size_effect:
  r_mm: {x: [24.0, -11.0, -9.0], y: [-23.0, 29.0, -7.0], z: [-1.0, -18.0, 16.0]}
  gauge: centroid
"""


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without a key, in a folder with a certificate."""
    folder = tmp_path / "home"
    folder.mkdir()
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.chdir(tmp_path)
    Path("unit.yaml").write_text(CERTIFICATE + ARMS)
    return folder


@pytest.fixture
def signed(home: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A certificate signed by bench 3, whose public key is in trusted.yaml."""
    assert main(["key", "new", "--name", "bench 3"]) == 0
    assert main(["gauge", "unit.yaml", "--to", "x", "-o", "signed.yaml"]) == 0
    capsys.readouterr()
    assert main(["key", "show"]) == 0
    Path("trusted.yaml").write_text(capsys.readouterr().out)
    return Path("signed.yaml")


def another_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", os.path.abspath("another"))
    make_bench_key("bench 4")


@pytest.fixture
def no_cryptography(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the extra were not installed."""
    for name in [name for name in sys.modules if name.startswith("cryptography.hazmat.primitives")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.asymmetric", None)


# The primitive


def test_a_signature_is_that_of_rfc_8032() -> None:
    """Section 7.1, TEST 2."""
    private = b64encode(
        bytes.fromhex("4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb")
    ).decode()
    public = "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c"
    signature = (
        "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da"
        "085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00"
    )
    made = sign(b"\x72", private)
    assert b64decode(made.public_key).hex() == public
    assert b64decode(made.ed25519).hex() == signature
    assert is_valid(made, b"\x72")
    assert not is_valid(made, b"\x73")


def test_a_public_key_that_is_no_point_of_the_curve_signs_nothing() -> None:
    no_point = b64encode(b"\x02" + bytes(31)).decode()
    assert not is_valid(Signature(public_key=no_point, ed25519=b64encode(bytes(64)).decode()), b"")


# The key of the bench


def test_a_new_key_is_readable_by_its_owner_only_and_never_overwritten(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["key", "new", "--name", "bench 3"]) == 0
    path = home / ".config" / "imu50" / "signing-key.yaml"
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    content, printed = path.read_bytes(), capsys.readouterr().out
    key = bench_key()
    assert key is not None
    assert key.private_key in content.decode()
    assert printed.startswith(f"{path}: the key of bench 3 ({fingerprint(key.public_key)})\n")
    assert key.private_key not in printed + repr(key)
    assert main(["key", "new"]) == 2
    assert "expected a bench without a key, got one that has it" in capsys.readouterr().err
    assert path.read_bytes() == content


def test_a_fingerprint_is_the_sha256_of_the_public_key_in_the_form_of_openssh() -> None:
    # printf '%032d' 0 | openssl dgst -sha256 -binary | base64
    assert fingerprint(b64encode(b"0" * 32).decode()) == "SHA256:hODA6vqpWjTCk/J4rFLkXOU3urXnUqAOaVmhOuEDtlo"


def test_what_show_prints_is_a_file_of_trusted_keys(signed: Path) -> None:
    key = bench_key()
    assert key is not None
    assert read_trusted("trusted.yaml") == {key.public_key: "bench 3"}
    assert key.private_key not in Path("trusted.yaml").read_text()


def test_the_key_is_where_xdg_says_unless_that_is_relative(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert key_path() == tmp_path / "config" / "imu50" / "signing-key.yaml"
    for name in ("config", ""):
        monkeypatch.setenv("XDG_CONFIG_HOME", name)
        assert key_path() == home / ".config" / "imu50" / "signing-key.yaml"


def test_a_user_without_a_home_has_no_key_and_cannot_make_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert bench_key() is None
    assert main(["key", "new"]) == 2
    assert "expected a user with a home folder, got none; set XDG_CONFIG_HOME" in capsys.readouterr().err


def test_without_a_key_there_is_nothing_to_show(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["key", "show"]) == 2
    assert "expected a key, got none; make one: calib key new" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["", " bench", "bench\n4", "\x1b[2J", "x" * 65])
def test_a_name_that_is_no_printable_text_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["key", "new", "--name", name]) == 2
    assert "name: expected" in capsys.readouterr().err
    assert bench_key() is None


def test_a_key_that_others_can_read_signs_nothing(signed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = key_path()
    assert path is not None
    path.chmod(0o640)
    assert main(["gauge", "unit.yaml", "--to", "y", "-o", "new.yaml"]) == 2
    assert "expected a key that only its owner can access, got mode 640" in capsys.readouterr().err
    assert not Path("new.yaml").exists()


def test_a_damaged_key_is_named_but_not_shown(signed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, key = key_path(), bench_key()
    assert path is not None
    assert key is not None
    path.write_text(path.read_text().replace(key.private_key, key.private_key[:-5]))
    assert main(["key", "show"]) == 2
    err = capsys.readouterr().err
    assert f"{path}: expected the key of calib key new" in err
    assert key.private_key[:10] not in err


# Certificates


def test_a_signature_is_the_last_line_and_signs_all_bytes_before_it(signed: Path) -> None:
    *before, last = signed.read_bytes().splitlines(keepends=True)
    signature = read_calibration(signed).signature
    assert signature is not None
    text = f"signature: {{public_key: {signature.public_key}, ed25519: {signature.ed25519}}}\n"
    assert last == text.encode()
    assert is_valid(signature, b"".join(before))


def test_openssl_verifies_a_certificate(signed: Path, tmp_path: Path) -> None:
    """With the standard tools alone; the prefix is that of an Ed25519 SubjectPublicKeyInfo, RFC 8410."""
    *before, _ = signed.read_bytes().splitlines(keepends=True)
    signature = read_calibration(signed).signature
    assert signature is not None
    Path("data").write_bytes(b"".join(before))
    Path("key").write_bytes(bytes.fromhex("302a300506032b6570032100") + b64decode(signature.public_key))
    Path("signature").write_bytes(b64decode(signature.ed25519))
    options = "-pubin -inkey key -keyform DER -rawin -in data -sigfile signature"
    try:
        process = subprocess.run(["openssl", "pkeyutl", "-verify", *options.split()], capture_output=True)
    except FileNotFoundError:
        pytest.skip("needs openssl")
    assert process.returncode == 0, process.stdout + process.stderr


def test_verify_says_who_signed_a_certificate(
    signed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    key = bench_key()
    assert key is not None
    shown = fingerprint(key.public_key)
    for arguments, code, text in (
        (["signed.yaml"], 0, f"signed.yaml: signed by bench 3 ({shown})\n"),
        (["signed.yaml", "--key", "trusted.yaml"], 0, f"signed.yaml: signed by bench 3 ({shown})\n"),
        (["unit.yaml"], 0, "unit.yaml: unsigned\n"),
        (
            ["unit.yaml", "--key", "trusted.yaml"],
            4,
            "expected the signature of a trusted key, it is unsigned\n",
        ),
    ):
        assert main(["verify", *arguments]) == code
        assert capsys.readouterr().out.endswith(text)
    another_bench(monkeypatch)
    assert main(["verify", "signed.yaml"]) == 0
    assert capsys.readouterr().out == f"signed.yaml: signed by an unknown key ({shown})\n"
    assert main(["verify", "signed.yaml", "--key", "trusted.yaml"]) == 0
    assert main(["gauge", "unit.yaml", "--to", "y", "-o", "foreign.yaml"]) == 0
    capsys.readouterr()
    assert main(["verify", "foreign.yaml", "--key", "trusted.yaml"]) == 4
    assert "foreign.yaml: signed by an unknown key (SHA256:" in capsys.readouterr().out


def test_no_changed_byte_of_a_signed_certificate_verifies(
    signed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = signed.read_bytes()
    signature = data.rindex(b"signature:")
    for at in (*range(0, signature, 11), *range(signature, len(data))):
        damaged = bytearray(data)
        damaged[at] ^= 1
        signed.write_bytes(damaged)
        assert main(["verify", "signed.yaml"]) == 2, bytes(damaged)
    capsys.readouterr()
    signed.write_bytes(data.replace(b"x: [0.0", b"x: [-0.0", 1))
    assert main(["verify", "signed.yaml"]) == 2
    key = bench_key()
    assert key is not None
    assert (
        f"signed.yaml: signature: expected that of the {signature + 1} bytes before it by the key "
        f"{fingerprint(key.public_key)}, got one that does not match; the file was changed after"
    ) in capsys.readouterr().out


@pytest.mark.parametrize("after", [b"# a remark\n", b"temperature: null\n", b"\n"])
def test_nothing_follows_the_signature(
    signed: Path, after: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    signed.write_bytes(signed.read_bytes() + after)
    assert main(["verify", "signed.yaml"]) == 2
    assert "signature: expected it in the last line" in capsys.readouterr().out


def test_a_changed_certificate_has_a_new_signature_or_none(
    signed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = read_calibration(signed).signature
    assert main(["gauge", "signed.yaml", "--to", "y", "-o", "again.yaml"]) == 0
    assert main(["verify", "again.yaml", "--key", "trusted.yaml"]) == 0
    assert read_calibration("again.yaml").signature != first
    assert main(["export-arms", "signed.yaml", "--to", "kalibr"]) == 0
    lines = capsys.readouterr().out.splitlines()
    Path("imu.yaml").write_text("\n".join(lines[next(i for i, x in enumerate(lines) if "imu0" in x) :]))
    imported = ["import-arms", "imu.yaml", "--from", "kalibr", "--calibration", "signed.yaml", "-o", "i.yaml"]
    assert main(imported) == 0
    assert main(["verify", "i.yaml", "--key", "trusted.yaml"]) == 0
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "nobody"))
    assert main(["gauge", "signed.yaml", "--to", "y", "-o", "unsigned.yaml"]) == 0
    assert read_calibration("unsigned.yaml").signature is None
    write_calibration("copy.yaml", read_calibration(signed))
    assert "signature" not in Path("copy.yaml").read_text()


def test_the_driver_reads_a_signed_certificate(signed: Path) -> None:
    assert imudrv(["check", "signed.yaml"]) == 0
    assert read_calibration(signed).without_size_effect().size_effect is None


# Trusted keys


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("keys: []", "keys: expected at least 1 "),
        ("keys: [{name: a, public_key: x}]", r"keys\[0\].public_key: expected text that matches"),
        ("keys: [{name: a}]", r"keys\[0\].public_key: missing"),
        (
            f"keys: [{{name: a, public_key: {'A' * 43}=}}, {{name: b, public_key: {'A' * 43}=}}]",
            "each public key once",
        ),
        (f"keys: [{{name: '', public_key: {'A' * 43}=}}]", r"keys\[0\].name: expected printable text"),
        (
            f"keys: [{{name: a, public_key: {'A' * 42}B=}}]",
            r"keys\[0\].public_key: expected text that matches",
        ),
    ],
)
def test_a_file_of_trusted_keys_is_checked(text: str, message: str) -> None:
    Path("trusted.yaml").write_text(f"format: imu50-trusted-keys\nversion: 1\n{text}\n")
    with pytest.raises(InputError, match=message):
        read_trusted("trusted.yaml")


# Journals


@pytest.fixture
def session(signed: Path, tmp_path: Path) -> Iterator[Session]:
    """A session that ends with a result that was rejected, of a bench with a key."""
    with closing(begin(tmp_path / "session")) as session:
        session.end(Decision(False))
        yield session


def test_the_end_of_a_journal_is_signed(session: Session) -> None:
    assert session.is_over
    contents = journal.read(session.folder / JOURNAL)
    assert isinstance(contents.entries[-1], Signed)
    ((number, signature, data),) = contents.signatures
    assert number == len(contents.entries)
    assert is_valid(signature, data)
    lines = (session.folder / JOURNAL).read_text().splitlines()
    assert data.decode() == f"imu50-session {lines[-2][-66:-2]}"


def test_a_bench_without_a_key_signs_nothing(tmp_path: Path) -> None:
    with closing(begin(tmp_path / "session")) as session:
        session.end(Decision(False))
        assert session.is_over
    assert not journal.read(session.folder / JOURNAL).signatures


def test_a_signed_journal_that_is_rewritten_with_right_hashes_is_a_forgery(session: Session) -> None:
    path = session.folder / JOURNAL
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[0]["port"] = "/dev/ttyUSB1"
    path.write_bytes(chained(lines))
    (fault, *_) = verify(session.folder).faults
    key = bench_key()
    assert key is not None
    assert fault.startswith(
        f"{path}: line {len(lines)}: expected the signature of the lines before it by the key "
    )
    assert fingerprint(key.public_key) in fault


def test_the_signature_and_the_end_are_written_at_once(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[bytes] = []
    write = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: written.append(bytes(data)) or write(fd, data))
    session.end(Decision(False))
    (data,) = written
    assert data.count(b"\n") == 2


@pytest.mark.usefixtures("signed")
def test_a_cut_signature_is_unfinished_and_made_again_when_the_session_is_resumed(tmp_path: Path) -> None:
    with closing(begin(tmp_path / "session")) as session:
        session.end(Decision(False))
    path = session.folder / JOURNAL
    path.write_bytes(path.read_bytes()[:-20])
    assert "the last, ends after" in verify(session.folder).unfinished[0]
    with closing(Session.open(session.folder)) as again:
        assert not again.is_over
        again.end(Decision(False))
        assert again.is_over
    assert len(journal.read(path).signatures) == 1


def test_what_follows_a_signature_is_not_signed(session: Session) -> None:
    path = session.folder / JOURNAL
    assert journal.read(path).signature is not None
    session.append(ServiceMessage("later"))
    assert not session.is_over
    assert journal.read(path).signature is None


@pytest.mark.usefixtures("signed")
def test_a_journal_with_a_line_that_a_power_cut_left_is_signed_as_a_whole(tmp_path: Path) -> None:
    with closing(begin(tmp_path / "session")) as session:
        session.append(ServiceMessage("cut"))
    path = session.folder / JOURNAL
    path.write_bytes(path.read_bytes()[:-20])
    with closing(Session.open(session.folder)) as again:
        again.end(Decision(False))
        assert again.is_over
    contents = journal.read(path)
    assert contents.signature is not None
    assert is_valid(contents.signature, contents.signatures[-1].data)


# Without the extra


@pytest.mark.usefixtures("no_cryptography")
def test_without_the_extra_everything_works_unsigned(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gauge", "unit.yaml", "--to", "y", "-o", "new.yaml"]) == 0
    assert main(["verify", "new.yaml"]) == 0
    assert capsys.readouterr().out.endswith("new.yaml: unsigned\n")


def test_without_the_extra_whatever_needs_a_key_says_which_extra_to_install(
    signed: Path, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    request.getfixturevalue("no_cryptography")
    for command in (
        ["key", "show"],
        ["verify", "signed.yaml"],
        ["gauge", "unit.yaml", "--to", "y", "-o", "new.yaml"],
    ):
        assert main(command) == 2
        assert "expected the package cryptography: pip install 'imu50[sign]'" in capsys.readouterr().err
    assert not Path("new.yaml").exists()
