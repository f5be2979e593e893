"""Messages to the operator: every key is in every catalogue, with the values that the code gives."""

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from string import Formatter

import pytest

import calib
from calib.messages import LANGUAGES, Message, catalogue, english, language, message, text, verbatim
from calib.procedure.events import Rejected
from calib.reports.document import MARKS

HEADLINE = 38  # characters: what a screen of 80 columns has in letters of three rows


def placeholders(text: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(text) if name}


def used() -> Iterator[tuple[str, set[str]]]:
    """Key and value names of each message that the code makes."""
    for path in Path(calib.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "message":
                (key,) = node.args
                assert isinstance(key, ast.Constant), f"{path}:{node.lineno}: the key has to be a literal"
                yield str(key.value), {str(keyword.arg) for keyword in node.keywords}


def on_the_page() -> set[str]:
    """Keys of the labels of the page in a browser."""
    page = Path(calib.__file__).parent / "bench" / "page"
    names = set(re.findall(r'data-(?:label|title)="(\w+)"', (page / "index.html").read_text()))
    for call in re.findall(r"label\(([^()]*)\)", (page / "console.js").read_text()):
        names |= set(re.findall(r'"(\w+)"', call))
    return {f"page_{name}" for name in names | set(MARKS)}


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_code_and_every_catalogue_have_the_same_keys_with_the_same_values(language: str) -> None:
    texts = catalogue(language)
    calls = list(used())

    assert {key for key, _ in calls} | on_the_page() == set(texts)
    for key, names in calls:
        assert placeholders(texts[key]) == names, key


def test_every_catalogue_is_a_language() -> None:
    files = resources.files("calib.messages").iterdir()
    assert {path.name for path in files if path.name.endswith(".yaml")} == {
        f"{name}.yaml" for name in LANGUAGES
    }


@pytest.mark.parametrize("name", LANGUAGES)
def test_a_catalogue_has_a_key_once_and_a_line_for_each(name: str) -> None:
    lines = resources.files("calib.messages").joinpath(f"{name}.yaml").read_text("utf-8").splitlines()
    keys = [line.partition(": ")[0] for line in lines if line and not line.startswith("#")]
    assert sorted(set(keys)) == sorted(keys)
    assert set(keys) == set(catalogue(name))


@pytest.mark.parametrize(
    ("name", "chosen"),
    [
        ("zh_CN", "zh_CN"),
        ("zh-Hans", "zh_CN"),
        ("zh_CN.UTF-8", "zh_CN"),
        ("en_GB", "en"),
        ("fr_FR.UTF-8", "en"),
        ("C", "en"),
        ("../../etc/passwd", "en"),
    ],
)
def test_a_language_without_a_catalogue_is_english(
    name: str, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert language(name) == chosen
    monkeypatch.setenv("LC_ALL", name)
    assert language() == chosen


def test_a_journaled_message_is_shown_in_either_language() -> None:
    entry = json.loads(json.dumps(asdict(message("wrong_direction", angle_deg=-40.0, expected_deg=180))))

    assert text(Message(**entry), "en") == "wrong direction: -40 deg, expected +180"
    assert text(Message(**entry), "zh_CN") == "方向错误：-40度，应为+180度"


def test_values_are_formatted_and_messages_within_a_message_are_rendered() -> None:
    cause = message("samples_missing", missing=700)
    assert (
        english(message("alignment_interrupted", elapsed_s=8.4, cause=cause))
        == "alignment interrupted after 8 s: 700 samples missing"
    )
    assert english(message("fault", faults=("power", "dither"))) == "the unit reports a fault: power, dither"
    readings = tuple(
        message("accelerometer_reads", axis=axis, measured_m_s2=1.0, expected_m_s2=-9.8) for axis in "XY"
    )
    assert english(message("axis_fault", readings=readings, cause=message("unexplained"))).startswith(
        "accelerometer X reads +1.00 m/s^2, expected -9.80; accelerometer Y reads +1.00 m/s^2, "
    )


@pytest.mark.parametrize(("n", "shown"), [(1, "1 rest, about 31 min"), (12, "12 rests, about 31 min")])
def test_a_noun_has_the_number_of_its_count(n: int, shown: str) -> None:
    assert english(message("expected_rests", folder="s", rests=n, minutes=31.0)) == f"session s: {shown}"


def test_text_from_elsewhere_is_shown_as_it_is() -> None:
    assert english(verbatim("{not a placeholder} 5 % +- 1")) == "{not a placeholder} 5 % +- 1"


def test_headlines_are_readable_from_afar_with_the_longest_values() -> None:
    longest = {"side": "-X", "angle_deg": 180.0, "turn_deg": -180, "step": 100, "steps": 100}
    for key, template in catalogue("en").items():
        if "".join(part for part, *_ in Formatter().parse(template)).isupper():
            shown = english(Message(key, {name: longest[name] for name in placeholders(template)}))
            assert len(shown) <= HEADLINE, shown
            assert shown.isascii()


def test_a_journaled_event_has_keys_and_numbers() -> None:
    reason = message("rest_interrupted", elapsed_s=1.5, rest_s=15.0, cause=message("unit_restarted"))

    entry = json.loads(json.dumps(asdict(Rejected("z", 1, (reason,), 5))))

    assert entry["reasons"] == [
        {
            "key": "rest_interrupted",
            "values": {"elapsed_s": 1.5, "rest_s": 15.0, "cause": {"key": "unit_restarted", "values": {}}},
        }
    ]
