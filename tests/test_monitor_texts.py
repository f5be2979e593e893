"""The monitor in each language: the same keys and values, every name, every label of the page."""

import re
from importlib import resources
from string import Formatter

import pytest

from imudrv.messages import LANGUAGES, catalogue, joined, named
from imudrv.records import Reason
from imudrv.service.latency import Latency, count_latency
from imudrv.service.web_monitor import octaves


def placeholders(text: str) -> list[tuple[str, str]]:
    fields = ((name, form or "") for _, name, form, _ in Formatter().parse(text) if name)
    return sorted((name, form) for name, form in fields if "|" not in form)  # the words of a count


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_catalogues_of_the_monitor_have_the_same_keys_with_the_same_values(language: str) -> None:
    texts, first = catalogue(language), catalogue(LANGUAGES[0])
    assert list(texts) == list(first)
    for key, text in texts.items():
        assert placeholders(text) == placeholders(first[key]), key


def test_every_label_of_the_monitor_page_is_in_the_catalogues_and_no_other() -> None:
    page = resources.files("imudrv.service").joinpath("page")
    html, script = (page.joinpath(name).read_text("utf-8") for name in ("index.html", "monitor.js"))
    names = set(re.findall(r'data-label="(\w+)"', html)) | set(re.findall(r'label\("(\w+)"\)', script))
    labels = {key.removeprefix("page_") for key in catalogue("en") if key.startswith("page_")}
    assert labels == names | {"ok", "warn", "fail"}  # the health


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_reason_of_rejection_has_a_text_in_every_language(language: str) -> None:
    texts = catalogue(language)
    names = {key.removeprefix("rejected_") for key in texts if key.startswith("rejected_")}
    assert names == {reason.name.lower() for reason in Reason}
    assert named(texts, "rejected", "no_sync") == {"en": "no sync", "zh_CN": "无同步字"}[language]
    assert named(texts, "output", "no route to host") == "no route to host"


@pytest.mark.parametrize(
    ("items", "english", "chinese"),
    [
        ([], "", ""),
        (["a; b"], "a; b", "a; b"),
        (["a", "b"], "a, b", "a、b"),
        (["bench, east", "b"], "bench, east; b", "bench, east；b"),
        (["垂直、水平", "b"], "垂直、水平; b", "垂直、水平；b"),
        (["垂直，水平", "b"], "垂直，水平; b", "垂直，水平；b"),
        (["a; b, c", "d"], "(1) a; b, c; (2) d", "（1）a; b, c；（2）d"),
    ],
)
def test_a_list_is_read_in_one_way_whatever_its_items_contain(
    items: list[str], english: str, chinese: str
) -> None:
    assert joined(items, "en") == english
    assert joined(items, "zh_CN") == chinese


def test_the_histogram_of_latencies_has_every_sample_once_in_bins_of_a_factor_of_two() -> None:
    latency = Latency(1_000_000)
    for ns, samples in ((900, 5), (40_000, 300), (63_999, 20), (130_000, 7), (5_000_000, 1)):
        count_latency(ns, samples, latency.state)
    bins = octaves(latency.report.histogram)
    assert dict(bins)[65.536] == 320
    assert dict(bins)[131.072] == 7
    assert sum(count for _, count in bins) == 333
    edges = [edge for edge, _ in bins]
    assert edges == [edges[0] * 2**k for k in range(len(bins))]
    assert octaves(Latency(1).report.histogram) == []
