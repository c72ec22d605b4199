"""The page in headless Chromium: records, shows, pauses, resumes, stops, and says nothing on the console."""

import importlib.util
import os
import shutil
import time
from pathlib import Path

import pytest

from tests import PATIENCE
from tests.test_daemon_api import ROOT, STATION, running

pytestmark = pytest.mark.slow
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NUMBERS = "[...document.querySelectorAll('.pictures img')].map((i) => Number(i.dataset.number || 0))"
MANY = 90  # views of the small station, each of many frames: a slow page still finds it recording
PICTURES = ROOT / "docs" / "pictures"

if importlib.util.find_spec("playwright") is None:
    pytest.skip("playwright is not installed", allow_module_level=True)
if CHROMIUM is None:
    pytest.skip("there is no Chromium: apt install chromium", allow_module_level=True)


@pytest.fixture
def page():
    """A page that must end without an error on its console, but for what the network says of a refusal or a loss."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1200, "height": 1000})
        page.set_default_timeout(1000 * PATIENCE)
        page.may_fail, said = False, []
        page.on(
            "console",
            lambda message: said.append(message.text) if message.type in {"error", "warning"} else None,
        )
        page.on("pageerror", lambda error: said.append(str(error)))
        yield page
        browser.close()
        assert [text for text in said if "Failed to load resource" not in text or not page.may_fail] == []


def _until(page, expression):
    """Wait until an expression holds; the page's own policy forbids Playwright to evaluate text by itself."""
    end = time.monotonic() + PATIENCE
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(50)


def _open(page, daemon):
    page.goto(daemon.url)
    _until(page, "document.querySelector('#phase').textContent.startsWith('idle')")
    assert daemon.token not in page.url


def _picture(page, name):
    """Screenshots go to the docs when they are wanted there."""
    if os.environ.get("TOFCAPTURE_SCREENSHOTS"):
        PICTURES.mkdir(exist_ok=True)
        page.screenshot(path=PICTURES / name, full_page=True)


def small_station():
    """The simulated station with small cameras."""
    spec = importlib.util.spec_from_file_location("daemon_station", STATION)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.SMALL_STATION


def _shown(page):
    return page.evaluate(NUMBERS)


def test_records_pauses_resumes_stops(tmp_path, page):
    """A whole session by mouse and keyboard."""
    station = tmp_path / "station.toml"
    given = os.environ.get("TOFCAPTURE_BROWSER_STATION")
    station.write_text(Path(given).read_text() if given else small_station())
    with running(tmp_path, "--station", station) as daemon:
        _open(page, daemon)
        page.fill("[name=scene]", "mug")
        page.fill("[name=recording]", "mugs")
        page.fill("[name=views]", str(MANY))
        page.fill("[name=frames]", "300")
        page.keyboard.press("Enter")
        _until(page, "document.querySelector('#bar').value >= 2")
        _until(page, f"Math.min(...{NUMBERS}) > 0")  # pictures follow the bar at their own pace
        first, before = min(_shown(page)), page.evaluate("document.querySelector('#depth').src")
        _until(page, "document.querySelector('#bar').value >= 5")
        _until(page, f"document.querySelector('#depth').src !== {before!r}")
        _until(page, f"Math.min(...{NUMBERS}) > {first}")
        assert page.locator("#plan .dot").count() == MANY
        assert page.locator("#plan .dot.sealed").count() >= 4
        assert page.evaluate("document.querySelector('#stereo').naturalWidth") > 0
        _picture(page, "daemon-light.png")
        page.click("#pause")
        _until(page, "document.querySelector('#phase').textContent.startsWith('paused')")
        at_rest = page.evaluate("document.querySelector('#bar').value")
        page.wait_for_timeout(800)
        assert page.evaluate("document.querySelector('#bar').value") == at_rest
        page.click("#resume")
        _until(page, f"document.querySelector('#bar').value > {at_rest}")
        page.click("#stop")
        page.click("#sure-no")
        assert daemon.ask("GET", "/v1/state")["phase"] == "recording"
        page.focus("#stop")
        page.keyboard.press("Enter")
        page.wait_for_selector("#sure[open]")
        page.keyboard.press("Shift+Tab")
        page.keyboard.press("Enter")
        _until(page, "document.querySelector('#phase').textContent.includes('stopped by the operator')")
        _until(page, "document.querySelector('#job').textContent.includes('stopped')")
        assert daemon.ask("GET", "/v1/state")["job"]["state"] == "stopped"
        page.close()  # before the daemon, whose absence it would report


def test_phone_and_dark(tmp_path, page):
    """Narrow and dark nothing is wider than the screen, every control is large enough for a finger, and named."""
    station = os.environ.get("TOFCAPTURE_BROWSER_STATION", "arrays")
    with running(tmp_path, "--station", station) as daemon:
        page.emulate_media(color_scheme="dark")
        page.set_viewport_size({"width": 360, "height": 740})
        _open(page, daemon)
        daemon.ask("POST", "/v1/jobs", {"scene": "mug", "recording": "r", "views": 5, "frames": 2})
        _until(page, "document.querySelectorAll('#views .sealed').length === 5")
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(251, 251, 250)"
        small = "[...document.querySelectorAll('button')].filter((b) => b.offsetParent && b.offsetHeight < 38).length"
        assert page.evaluate(small) == 0
        assert page.evaluate("[...document.querySelectorAll('img')].every((i) => i.alt)")
        _picture(page, "daemon-dark.png")
        page.close()


def test_without_the_token(tmp_path, page):
    """Opened without its token the page says what to do; the refusals are all the console tells."""
    page.may_fail = True
    with running(tmp_path) as daemon:
        page.goto(daemon.url.partition("#")[0])
        page.wait_for_selector("#notice:not([hidden])")
        assert "tofcapture status --url" in page.text_content("#notice")


def test_lost_and_found(tmp_path, page):
    """The page finds a daemon that comes back."""
    page.may_fail = True
    with running(tmp_path) as daemon:
        _open(page, daemon)
        port = daemon.port
    _until(page, "document.querySelector('#phase').textContent.startsWith('connection lost')")
    with running(tmp_path, port=port):
        _until(page, "document.querySelector('#phase').textContent.startsWith('idle')")
