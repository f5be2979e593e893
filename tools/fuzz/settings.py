"""Target: the reader of settings files."""

import contextlib
import json
import tempfile
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.random import Generator

import calib
from calib.procedure import plan
from calib.procedure.schema import Procedure
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.files import model, settings_file
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.service.settings import Settings
from imudrv.sim import scenario
from imudrv.site import Site
from imudrv.wire.can import CanAssembler
from imudrv.wire.stream import StreamDecoder

from .chain import CALIBRATION, require_finite
from .properties import Cuts, Setup
from .random_input import mutated, pick, small_number
from .units import SERIAL, SHIPPED, TEXTS, transmit

MODELS: Final = (Calibration, Site, Profile, scenario.Scenario, Settings, Procedure)
PROCEDURES: Final = Path(calib.__file__).parent / "procedures"
SCENARIOS: Final = resources.files("imudrv.sim") / "scenarios"
FILES: Final = (
    yaml.safe_dump(CALIBRATION),
    "{latitude_deg: 28.2, longitude_deg: 113, height_m: 60.0, gravity_m_s2: 9.7917}",
    "{port: a, profile: b, calibration: c.yaml, outputs: ['udp://a:1'], rate_filter: dither, realtime: true}",
    *TEXTS.values(),
    *(path.read_text() for path in PROCEDURES.glob("*.yaml")),
    *((SCENARIOS / f"{name}.yaml").read_text() for name in scenario.shipped()),
)
SITE: Final = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0)
ODD: Final[tuple[Any, ...]] = (
    *(None, True, 0, -1, 7, 1.5, 5e-324, 1e-9, 1e200, -1e308, np.inf, np.nan, 2**63, 10**25, [], {}),
    *("", "x", "\ud800", "\0", "é\u2028", "50\u00a026", "EB 90", "SerialLine", {"SerialLine": {"x": 1}}),
    *("9999-12-31T23:59:59-14:00", "2026-11-22", [1e308] * 3, {"provenance": [{}]}, {"k" * 99: 1}, [[1, 2]]),
)
WORDS: Final = (
    *b"~ .nan -.inf 1e999 0x8000000000000000 0017 1:30 [ ] { } , : ? a: &a *a <<: !!str # - > |".split(),
    *(b"\n", b"\n  ", b"\n- ", b"\n---\n", b"\n...\n", b"%YAML 9.9\n", b"|\n  x", b" ", b"\t", b"- " * 40),
    *(b"'", b'"', b'"\\ud800"', b'"\\UFFFFFFFF"', b"\0", b"\xff", b"\xed\xa0\x80", "\x85".encode()),
    *("\u2028".encode(), "\ufeff".encode(), "\u00a0".encode(), b"format: imu50-site\n"),
)
ROWS: Final = (
    b"k%d: 1\n",
    b"- %d\n",
    b"- [[%d\n",
    b"{a%d: ",
    b"a%d: {latitude_deg: x}\n",
    b"- {rest: {b%d: 1}}\n",
)


def make_yaml(rng: Generator) -> tuple[Setup, bytes]:
    """Return shipped files with changed bytes or values, words of YAML, or one element many times."""
    text, way = pick(rng, FILES), int(rng.integers(60))
    if way < 30:
        return None, mutated(rng, text.encode(), WORDS)
    if way < 52:
        document = yaml.load(text, Loader=yaml.CSafeLoader)
        for _ in range(rng.integers(1, 4)):
            document = changed(rng, document)
        return None, json.dumps(document, default=str).encode()  # a time, as in a calibration
    if way < 59:
        return None, b"".join(pick(rng, WORDS) for _ in range(small_number(rng)))
    head = pick(rng, ("", f"{text}\n", f"{text}\nmotion:\n", f"{text}\nmessages:\n"))
    row = pick(rng, ROWS)
    return None, head.encode() + b"".join(row % n for n in range(16_000))


def changed(rng: Generator, value: Any) -> Any:
    """Return plain data with one element changed, removed or repeated."""
    if not isinstance(value, dict | list) or not value or rng.integers(8) == 0:
        return pick(rng, ODD)
    items = list(value.items() if isinstance(value, dict) else enumerate(value))
    at, action = int(rng.integers(len(items))), int(rng.integers(12))
    key, old = items[at]
    items[at : at + 1] = [] if action == 0 else [(key, changed(rng, old))]
    items += [(str(pick(rng, ODD)), old)] if action == 1 else []
    return dict(items) if isinstance(value, dict) else [item for _, item in items]


def check_yaml(_: Setup, data: bytes, __: Cuts) -> None:
    """Check that a file is refused with an `InputError`, or can be used, and written and read again."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "settings.yaml"
        path.write_bytes(data)
        with contextlib.suppress(InputError):
            settings_file.kind(path)
        for model in MODELS:
            try:
                settings = settings_file.read(path, model)
            except InputError as error:
                if not getattr(error, "faults", True):
                    raise AssertionError("refused without a reason") from error
                continue
            copy = path.with_stem(model.__name__)
            settings_file.write(copy, settings)
            assert settings_file.read(copy, model) == settings, "written settings differ when read"
            use(settings)


def use(settings: model.Model) -> None:
    """Do the first steps of a command with a good file."""
    rng = np.random.default_rng(0)
    if isinstance(settings, Procedure):
        with contextlib.suppress(InputError):  # what it leaves unobservable
            plan.predicted(settings, SITE)
    elif isinstance(settings, scenario.Scenario):
        scenario.samples(settings, 1_000_000)
    elif isinstance(settings, Calibration):
        layout = SHIPPED[SERIAL[0]]
        pulses = SequenceTracker(layout).feed(StreamDecoder(layout).feed(transmit(rng, layout, 9)).frames)
        require_finite(Compensator(coefficients(settings), layout).feed(pulses))
    elif isinstance(settings, Profile):
        layout = settings.layout()
        decoder, tracker = (CanAssembler if layout.can else StreamDecoder)(layout), SequenceTracker(layout)
        pulses = tracker.feed(decoder.feed(transmit(rng, layout, 9)).frames)
        assert tracker.counts.closes
        assert not np.isinf(pulses["temperature_degc"]).any(), "a temperature is not finite"
