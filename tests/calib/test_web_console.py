"""The browser console in Debian's chromium: a rehearsal clicked through, a reconnect, two viewers."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Timer
from typing import Any

import pytest
from bench_session import SHORT
from realtime import DEADLINE_S, until

playwright = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this system")

DEADLINE_MS = DEADLINE_S * 1e3


class Bench:
    """A rehearsal whose only keys are the page's."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "short.yaml").write_text(SHORT)
        self.port = "0"
        self.start("--procedure", "short.yaml", "--mistakes", "wrong-way")

    def start(self, *options: str) -> None:
        command = [sys.executable, "-m", "calib", "run", "--rehearse", "--speed", "15", "--session", "s"]
        command += ["--web", f"127.0.0.1:{self.port}", *options]
        self.process = subprocess.Popen(
            command,
            cwd=self.folder,
            env={**os.environ, "XDG_CONFIG_HOME": str(self.folder), "LC_ALL": "C.UTF-8"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert self.process.stdout is not None
        self.limit = Timer(DEADLINE_S, self.process.kill)
        self.limit.start()
        for line in self.process.stdout:
            if found := re.search(r"http://127\.0\.0\.1:(\d+)/\?token=\S+", line):
                self.url, self.port = found[0], found[1]
                return
        raise AssertionError("no address of a page")

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.limit.cancel()

    def events(self, kind: str) -> list[dict[str, Any]]:
        lines = map(json.loads, (self.folder / "s" / "journal.jsonl").read_text().splitlines())
        return [line for line in lines if line["event"] == kind]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.kill()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One for the tests that only look."""
    bench = Bench(tmp_path_factory.mktemp("shared"))
    yield bench
    bench.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def opened(browser: Any, url: str) -> Any:
    page = browser.new_context().new_page()
    page.set_default_timeout(DEADLINE_MS)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on(
        "request", lambda request: page.problems.append(request.url) if "127.0.0.1" not in request.url else 0
    )
    page.goto(url)
    return page


def headline(page: Any, text: str) -> None:
    page.get_by_text(text, exact=False).locator("visible=true").first.wait_for()


def eventually(page: Any, true: str) -> None:
    """Wait for an expression; the page's CSP lets no script poll it."""
    until(lambda: page.wait_for_timeout(20) or page.evaluate(true))


def test_a_rehearsal_is_clicked_through_with_a_rejection_a_reconnect_and_a_viewer(
    bench: Bench, browser: Any
) -> None:
    page, viewer = opened(browser, bench.url), opened(browser, bench.url)
    viewer.select_option("#language", "zh_CN")

    headline(page, "PRESS ENTER")
    headline(viewer, "请按回车")
    assert viewer.locator("#link").inner_text() == "● 仅观看"
    assert viewer.locator("#confirm").is_disabled()
    viewer.keyboard.press("Enter")
    assert viewer.locator("#take").is_hidden()
    page.click("#confirm")
    headline(page, "REJECTED: DO IT AGAIN")
    assert "turn it 180 deg counter-clockwise" in page.locator("#hint").inner_text()
    headline(viewer, "不合格：请重做")

    # a question is answered by a key or a button, and no gives nothing up
    page.click("#skip")
    assert "Skip this step?" in page.locator("#asked").inner_text()
    page.keyboard.press("n")
    assert page.locator("#question").is_hidden()
    assert bench.events("skipped") == []

    # who may act hands over, and the other one takes it
    page.click("#give")
    viewer.locator("#take").wait_for()
    viewer.click("#take")
    page.locator("#give").wait_for(state="hidden")
    assert page.locator("#confirm").is_disabled()
    viewer.keyboard.press("Enter")
    headline(page, "PRESS ENTER")

    # the server is killed; the page says so, and comes back by itself when the session is resumed
    bench.kill()
    headline(page, "no connection, trying again")
    headline(viewer, "连接中断，正在重连")
    viewer.close()
    bench.start()
    while page.locator("#outcome").is_hidden():
        confirm = page.locator("#confirm")
        if confirm.is_enabled():
            confirm.click()
        page.wait_for_timeout(100)
    assert page.locator("#arms tr").count() == 4
    page.click("#accept")
    eventually(page, "view.step === 'verification'")

    assert bench.events("decision")[0]["accepted"]
    assert (bench.folder / "s" / "report.html").exists()
    assert page.problems == []  # no error, and nothing from another host


def test_without_the_token_or_with_another_origin_there_is_nothing(shared: Bench, browser: Any) -> None:
    page = browser.new_page()
    base = shared.url.partition("?")[0]
    assert page.goto(base).status == 403
    assert page.goto(f"{base}?token=wrong").status == 403
    assert page.goto(f"{base}report.html").status == 403
    answer = page.goto(shared.url)
    assert answer.headers["content-security-policy"].startswith("default-src 'self';")
    script = """url => new Promise(done => {
        const socket = new WebSocket(url);
        socket.onopen = () => done(1);
        socket.onerror = () => done(0);
    })"""
    socket = shared.url.replace("http", "ws").replace("/?", "/ws?")
    assert page.evaluate(script, socket) == 1
    page.goto("about:blank")
    assert page.evaluate(script, socket) == 0  # its origin is null


@pytest.fixture(scope="module")
def page(shared: Bench, browser: Any) -> Iterator[Any]:
    page = opened(browser, shared.url)
    eventually(page, "view !== null")
    yield page
    page.close()


@pytest.mark.parametrize("size", [(1280, 720), (800, 480), (375, 667)])
@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("language", ["en", "zh_CN"])
def test_nothing_sticks_out_of_the_page(size: tuple[int, int], theme: str, language: str, page: Any) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.select_option("#language", language)
    if page.evaluate("document.documentElement.dataset.theme") != theme:
        page.click("#theme")
    assert page.evaluate("document.documentElement.dataset.theme") == theme
    whole = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert tuple(whole) == size
    for name in ("#headline", "#confirm", "#abort", "#dial"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= size[0] + 0.5, name  # rounding
        assert box["y"] + box["height"] <= size[1] + 0.5, name
    wide = page.evaluate("[document.getElementById('headline').scrollWidth, innerWidth]")
    assert wide[0] <= wide[1]
