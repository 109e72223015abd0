"""The page of `cgid label` in a browser, by keys alone; skipped without chromium, its driver and selenium."""

from __future__ import annotations

import json
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_label import Page, ended, rows_of
from tests.test_labels import rung

webdriver: Any = pytest.importorskip(
    "selenium.webdriver", reason="selenium is not installed: pip install selenium", exc_type=ImportError
)
PROGRAMS = [shutil.which(name) for name in ("chromium", "chromedriver")]
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(None in PROGRAMS, reason="no browser: apt-get install chromium chromium-driver"),
]


@pytest.fixture
def browser() -> Iterator[Callable[..., Any]]:
    opened = []

    def make(width: int = 1280, height: int = 900) -> Any:
        options = webdriver.ChromeOptions()
        options.binary_location = PROGRAMS[0]
        switches = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking")
        for switch in (*switches, "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"):
            options.add_argument(switch)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(PROGRAMS[1]))
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        opened.append(driver)
        return driver

    yield make
    for driver in opened:
        driver.quit()


def until(driver: Any, script: str, seconds: float = 30.0) -> Any:
    ends = time.monotonic() + seconds
    while not (found := driver.execute_script(f"return {script}")):
        assert time.monotonic() < ends, (script, driver.get_log("browser"))
        time.sleep(0.1)
    return found


def pressed(driver: Any, *keys: str) -> None:
    for key in keys:
        driver.find_element("tag name", "body").send_keys(key)


def asked(driver: Any) -> set[str]:
    """Return the addresses that the browser has asked for, and fail for what its console says."""
    # A server that is killed refuses what is asked next, and answers half of what it was asked, or nothing.
    halves = ("ERR_EMPTY_RESPONSE", "ERR_INCOMPLETE_CHUNKED", "ERR_CONTENT_LENGTH_MISMATCH")
    gone = ("ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", *halves, "403")
    assert [line for line in driver.get_log("browser") if not any(one in line["message"] for one in gone)] == []
    messages = [json.loads(line["message"])["message"] for line in driver.get_log("performance")]
    sent = [one["params"]["request"]["url"] for one in messages if one["method"] == "Network.requestWillBeSent"]
    return {address.split("?")[0].rpartition("/api")[0] or address.split("#")[0] for address in sent}


@pytest.fixture
def pages() -> Iterator[Callable[..., Page]]:
    opened = []

    def make(folder: Path, port: int) -> Page:
        opened.append(Page(folder, "--port", str(port)))
        opened[-1].wait(ended)
        return opened[-1]

    yield make
    for page in opened:
        if page.process.returncode is None:
            page.end(signal.SIGKILL)


@pytest.fixture
def site(tmp_path: Path) -> tuple[Path, list[str], np.ndarray]:
    samples, labels, onsets = rung(8)
    np.save(tmp_path / "a.npy", samples)
    return tmp_path, labels, onsets


def test_a_new_user_labels_by_keys_alone(site: Any, browser: Any, pages: Any) -> None:
    """Draw, label, undo, a stretch, an unsure one; a name that is markup; save; and nothing is asked elsewhere."""
    folder, labels, onsets = site
    page, driver = pages(folder, 8971), browser()
    driver.get(f"http://127.0.0.1:8971/#{page.key}")
    until(driver, "page.selected >= 0 && page.detail")
    driver.execute_script("document.getElementById('by').value = '<b id=evil>x</b>'")
    for number in range(26):
        time_ = driver.execute_script("return page.impacts[page.selected][1]")
        truth = labels[int(np.argmin(np.abs(onsets - time_)))]
        if number == 3:
            pressed(driver, "c" if truth == "gangue" else "g", "z")  # a slip, and undo
        pressed(driver, truth[0])
    pressed(driver, "u")
    until(driver, "!page.outbox.length && page.state.n_unsure === 1 && page.state.n_labels === 26")
    until(driver, "page.state.learning.results.new && page.state.learning.results.new.drawn")
    # The page has the state before it has the impacts, and draws both then.
    until(driver, "document.getElementById('headline').textContent.startsWith('new model')")
    assert driver.find_element("id", "headline").text.startswith("new model: right on ")
    until(driver, "document.getElementById('control').textContent")  # of one recording: not tried, and why
    pressed(driver, "o")  # by time
    first, last = (int(np.argmin(np.abs(onsets - time_))) for time_ in (8.0, 9.5))
    driver.execute_script(f"select({first}, false)")
    pressed(driver, "[")
    driver.execute_script(f"select({last}, false)")
    pressed(driver, "]", "C")
    until(driver, "!page.outbox.length && page.stretches.length === 1")
    driver.find_element("id", "save").click()
    until(driver, "page.state.saved.length === 2")
    pressed(driver, "+", "+", "-", "0", "\ue00f", "\ue00e", "p", "b")  # zoom, pages, the model's opinion, sound
    driver.find_element("id", "language").click()
    assert "随机抽取" in driver.find_element("css selector", '[data-key="Enter"]').text
    assert not driver.execute_script("return document.getElementById('evil')")
    assert asked(driver) <= {
        f"http://127.0.0.1:8971{path}"
        for path in ("", "/", "/label.css", "/common.css", "/label.js", "/common.js", "/words.json")
    }
    page.end()
    rows = rows_of(folder / "labels.csv")
    assert [row["label"] for row in rows if row["chosen"] == "stretch"] == ["coal"]
    truth_of = dict(zip(np.round(onsets, 1).tolist(), labels, strict=True))
    drawn = [row for row in rows if row["chosen"] == "random"]
    assert len(drawn) == 26 and {row["by"] for row in drawn} == {"<b id=evil>x</b>"}
    assert all(
        row["label"] == truth_of[round(float(row["time_s"]) - 0.002, 1)]
        for row in drawn
        if abs(float(row["time_s"]) % 0.1 - 0.05) > 0.01
    )


def test_no_key_is_lost_however_fast(site: Any, browser: Any, pages: Any) -> None:
    """Keys while the page loads are told; a label that is on its way outlives answers that were asked before it."""
    folder, _, _ = site
    page, driver = pages(folder, 8974), browser()
    slow = """const real = window.fetch, sleep = ms => new Promise(done => setTimeout(done, ms));
        window.held = [];
        window.fetch = async (path, how) => {
          const kind = String(path).split("?")[0];
          if (kind === "api/state" && !window.loaded) { window.loaded = true; await sleep(1500); }
          if (kind === "api/label") await (window.hold ? new Promise(done => held.push(done)) : sleep(60));
          const answer = await real(path, how);
          if (kind === "api/impacts") await (window.hold ? new Promise(done => held.push(done)) : sleep(300));
          return answer;
        };"""
    driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": slow})
    driver.get(f"http://127.0.0.1:8974/#{page.key}")
    pressed(driver, "c")
    assert "keys count from the first one" in driver.find_element("id", "alarm").text
    until(driver, "page.selected >= 0 && page.detail")
    assert driver.find_element("id", "alarm").text == ""
    # The order of the answers, by hand: all impacts are asked, then a label is written, then the answer comes.
    until(driver, "window.loaded && !held.length && (window.hold = true)")
    first = driver.execute_script("return page.selected")
    pressed(driver, "c")
    driver.execute_script(
        "page.version = -1; seen = ''; window.refreshed = false; refresh().then(() => refreshed = true)"
    )
    until(driver, "held.length >= 2")
    driver.execute_script("held.shift()()")
    until(driver, "!page.outbox.length")
    driver.execute_script("window.hold = false; held.forEach(one => one())")
    until(driver, "refreshed")
    assert driver.execute_script(f"return page.impacts[{first}][5]") == "coal"
    # And as fast as no hand, while models are trained.
    driver.execute_script("""let n = 0;
        const timer = setInterval(() => {
          if (n === 37) { clearInterval(timer); window.over = true; return; }
          document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "cg"[n++ % 2], bubbles: true }));
        }, 120);""")
    until(driver, "window.over && !page.outbox.length && page.state.n_labels === 38")
    asked(driver)
    page.end()
    assert sum(bool(row["label"]) for row in rows_of(folder / "labels.csv")) == 38


def test_labels_wait_while_the_server_is_down(site: Any, browser: Any, pages: Any) -> None:
    """The server is killed; two labels wait in the page; the next server has them, by its own address."""
    folder, _, _ = site
    page, driver = pages(folder, 8972), browser()
    driver.get(f"http://127.0.0.1:8972/#{page.key}")
    until(driver, "page.selected >= 0")
    pressed(driver, "c")
    until(driver, "!page.outbox.length && page.state.n_labels === 1")
    page.end(signal.SIGKILL)
    pressed(driver, "g", "g")
    until(driver, "page.away === 'away' && page.outbox.length === 2")
    assert "labels wait here" in driver.find_element("id", "alarm").text
    page = pages(folder, 8972)
    until(driver, "page.away === 'key'")
    assert "open the one that cgid printed" in driver.find_element("id", "alarm").text
    driver.get("about:blank")
    driver.get(f"http://127.0.0.1:8972/#{page.key}")
    until(driver, "page.state && !page.outbox.length && page.state.n_labels === 3")
    asked(driver)
    page.end()
    assert sorted(row["label"] for row in rows_of(folder / "labels.csv") if row["label"]) == [
        "coal",
        "gangue",
        "gangue",
    ]


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits(width: int, site: Any, browser: Any, pages: Any) -> None:
    page, driver = pages(site[0], 8973), browser(width, 844)
    driver.get(f"http://127.0.0.1:8973/#{page.key}")
    until(driver, "page.selected >= 0 && page.detail")
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    for button in driver.find_elements("css selector", "main button"):
        assert not button.is_displayed() or button.rect["x"] + button.rect["width"] <= width
    asked(driver)
    page.end()
