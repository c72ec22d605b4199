"""The page in headless Chromium: records, shows, pauses, resumes, stops, and says nothing on the console."""

import importlib.util
import io
import os
import shutil
import signal
import time
import tomllib
from pathlib import Path

import pytest
import tomli_w

from tests import PATIENCE
from tests.test_daemon_api import ROOT, STATION, running

pytestmark = pytest.mark.slow
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NUMBERS = "[...document.querySelectorAll('.pictures img')].map((i) => Number(i.dataset.number || 0))"
MANY = 90  # views of the small station, each of many frames: a slow page still finds it recording
RED = "rgb(179, 38, 30)"
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


def _says(page, *words):
    """Wait until the band on top says all of it; capitals apart."""
    text = "document.querySelector('#band').innerText.toLowerCase()"
    _until(page, " && ".join(f"{text}.includes({word.lower()!r})" for word in words))


def _colour(page):
    return page.evaluate("getComputedStyle(document.querySelector('#band')).backgroundColor")


def _open(page, daemon):
    page.goto(daemon.url)
    _says(page, "idle")
    assert daemon.token not in page.url


def _picture(page, width, height, scheme):
    """Screenshots go to the docs when they are wanted there, in a palette."""
    if not os.environ.get("TOFCAPTURE_SCREENSHOTS"):
        return
    from PIL import Image

    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": height})
    page.evaluate("scrollTo(0, 0)")
    shot = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    shot.quantize(256).save(PICTURES / f"daemon-{width}-{scheme}.png", optimize=True)


def small_station():
    """The simulated station with small cameras."""
    spec = importlib.util.spec_from_file_location("daemon_station", STATION)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.SMALL_STATION


def shown_station():
    """The same with cameras whose pictures can be looked at."""
    found = tomllib.loads(small_station())
    for camera, scale in (("tof", 5), ("stereo", 4)):
        found["sim"][camera] = {key: scale * value for key, value in found["sim"][camera].items()}
    return tomli_w.dumps(found)


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
        page.click("#pause")
        _says(page, "paused by the operator", "press Resume")
        at_rest = page.evaluate("document.querySelector('#bar').value")
        page.wait_for_timeout(800)
        assert page.evaluate("document.querySelector('#bar').value") == at_rest
        page.click("#resume")
        _until(page, f"document.querySelector('#bar').value > {at_rest}")
        page.focus("#stop")
        page.keyboard.press("Enter")  # one press, and it stops
        _says(page, "stopped by the operator", "Retry")
        _until(page, "document.querySelector('#job').textContent.includes('stopped')")
        assert daemon.ask("GET", "/v1/state")["job"]["state"] == "stopped"
        page.reload()  # what happened before the page was opened is on it
        _says(page, "stopped by the operator")
        _until(page, "document.querySelectorAll('#log .sealed').length >= 5")
        _until(page, "document.querySelector('#history').innerText.includes('stopped by the operator')")
        page.close()  # before the daemon, whose absence it would report


def test_protective_stop_resume_reorder_retake_connection_lost(tmp_path, page):
    """The arm is a real one: it never moves before a person has said that its reach is clear."""
    page.may_fail = True
    protect, log = tmp_path / "protect", tmp_path / "log"
    page.set_viewport_size({"width": 1280, "height": 900})
    env = {"BENCH_REAL": 1, "BENCH_MOVES": 1, "BENCH_PROTECT": protect, "BENCH_LOG": log, "BENCH_DELAY": 0.05}
    with running(tmp_path, **env) as daemon:
        _open(page, daemon)
        daemon.ask(
            "POST", "/v1/jobs", {"scene": "cup", "recording": "r", "views": 1, "frames": 2, "clear": True}
        )
        _says(page, "idle")
        _until(page, "document.querySelector('#history').innerText.includes('cup into r: done')")
        moves = log.read_text()
        protect.touch()

        for scene in ("mug", "box", "gear"):
            for field, text in (("scene", scene), ("recording", "r"), ("views", "3"), ("frames", "2")):
                page.fill(f"[name={field}]", text)
            page.keyboard.press("Enter")
            page.wait_for_selector("#sure[open]")
            if scene == "mug":
                page.keyboard.press("Enter")  # the focus is on what does not move the arm
                page.wait_for_selector("#sure:not([open])", state="attached")
                page.wait_for_timeout(300)
                assert log.read_text() == moves
                page.click("#new button")
            page.click("#sure-yes")
            page.wait_for_selector("#sure:not([open])", state="attached")
            if scene == "mug":
                _says(page, "protective stop", "the arm is in protective stop", "acknowledge", "press Resume")
        assert _colour(page) == RED
        assert "Protective stop".lower() in page.text_content("#alarm").lower()
        _until(page, "document.querySelectorAll('#queue li').length === 3")

        queue = "[...document.querySelectorAll('#queue li span')].map((line) => line.textContent.match(/mug|box|gear/)[0]).join(' ')"
        _until(page, f"{queue} === 'mug box gear'")
        page.focus("#queue li:nth-child(3) >> text=Earlier")
        page.keyboard.press("Enter")
        _until(page, f"{queue} === 'mug gear box'")
        page.keyboard.press("Enter")  # the focus has gone along
        _until(page, f"{queue} === 'gear mug box'")
        page.click("#queue li:nth-child(1) >> text=Later")
        _until(page, f"{queue} === 'mug gear box'")
        page.click("#queue li:nth-child(3) >> text=Remove")
        _until(
            page,
            "document.querySelector('#history').innerText.includes('box into r: stopped - removed by the operator')",
        )

        _picture(page, 1280, 620, "dark")
        protect.unlink()
        page.click("#resume")
        page.click("#sure-yes")
        _says(page, "idle")
        assert [job["scene"] for job in daemon.ask("GET", "/v1/jobs")["jobs"] if job["state"] == "done"] == [
            "gear",
            "mug",
            "cup",
        ]
        assert _colour(page) != RED

        _until(page, "document.querySelectorAll('#views .sealed').length === 3")
        page.click("[aria-label='Retake view 1']")
        page.click("#sure-yes")
        _until(
            page, "document.querySelector('#history').innerText.includes('gear into r, view 1 again: done')"
        )
        assert len(list(tmp_path.glob("root/r/views/gear/view-*.h5.retaken"))) == 1
        assert page.locator("#views tr", has_text="%").count() == 3  # what was measured of the others stays
        page.click("[aria-label='Retake view 2']")
        page.click("#sure-stop")  # also while it asks, stop is one press
        _says(page, "stopped by the operator")
        assert len(daemon.ask("GET", "/v1/jobs")["jobs"]) == 5
    _says(page, "connection lost", "the arm may still move", "press the red button on the teach pendant")
    assert _colour(page) == RED
    assert "red button" in page.text_content("#alarm")
    assert page.is_disabled("#pause")
    _picture(page, 390, 844, "dark")
    page.click("#stop")
    _until(
        page,
        "document.querySelector('#notice').innerText.includes('STOP WAS NOT HEARD: press the red button')",
    )


def test_a_daemon_that_falls_silent_is_a_lost_connection(tmp_path, page):
    """Its connection stands, and yet it says nothing: the page does not show what was as what is."""
    page.may_fail = True
    with running(tmp_path) as daemon:
        _open(page, daemon)
        os.kill(daemon.process.pid, signal.SIGSTOP)
        try:
            _says(page, "connection lost", "red button")
        finally:
            os.kill(daemon.process.pid, signal.SIGCONT)
        _says(page, "idle")
        page.close()


SIZES = [(390, "light"), (390, "dark"), (1280, "light"), (1280, "dark")]
SMALL_BUTTONS = (
    "[...document.querySelectorAll('button')].filter((b) => b.offsetParent && b.offsetHeight < 38).length"
)
CUT = """[...document.querySelectorAll('#views td, #views th, .jobs li, #band *, button')].filter((e) => {
  const box = e.getBoundingClientRect(); return box.width && (box.left < 0 || box.right > innerWidth + 1); }).length"""
# Contrast of every text with what is behind it (WCAG 2.1), the least of all.
CONTRAST = """(() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((c) => c / 255).map((c) => (c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
    .reduce((sum, c, n) => sum + c * [0.2126, 0.7152, 0.0722][n], 0);
  const behind = (e) => { for (; e; e = e.parentElement) { const c = rgb(getComputedStyle(e).backgroundColor); if (c.length < 4 || c[3]) return c; } return [255, 255, 255]; };
  const texts = [...document.querySelectorAll('body *')].filter((e) => e.offsetParent && !e.disabled && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()));
  return Math.min(...texts.map((e) => { const [a, b] = [light(rgb(getComputedStyle(e).color)), light(behind(e))].sort((x, y) => y - x); return (a + 0.05) / (b + 0.05); }));
})()"""


@pytest.mark.parametrize(("width", "scheme"), SIZES)
def test_every_size_and_scheme(tmp_path, page, width, scheme):
    """Nothing is cut off, every control is large enough for a finger and every text can be read; waiting is no recording."""
    station = tmp_path / "station.toml"
    station.write_text(shown_station())
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 900})
    with running(tmp_path, "--station", station) as daemon:
        _open(page, daemon)
        job = {"scene": "mug", "recording": "r", "views": 6, "frames": 4}
        daemon.ask("POST", "/v1/jobs", job)
        _until(page, "document.querySelectorAll('#views .sealed').length === 6")
        daemon.ask("POST", "/v1/pause")
        for scene in ("cup", "box"):
            daemon.ask("POST", "/v1/jobs", {**job, "scene": scene})
        _says(page, "paused")
        _until(page, "document.querySelectorAll('#queue .queued').length === 2")
        _until(page, "document.querySelectorAll('.scale:not([hidden])').length === 3")
        assert page.locator("#depth + .scale").inner_text().split()[-1] == "m"
        assert page.locator("#stereo + .scale").inner_text() == page.locator("#depth + .scale").inner_text()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(CUT) == 0
        assert page.evaluate(SMALL_BUTTONS) == 0
        assert page.evaluate(CONTRAST) >= 4.5
        assert page.evaluate("[...document.querySelectorAll('img')].every((i) => i.alt)")
        assert (
            page.evaluate("[...document.querySelectorAll('[title]')].length") == 0
        )  # nothing hides in a tooltip
        numbers = page.inner_text("#views tr:first-child")
        assert all(word in numbers for word in ("%", "mm"))
        if (width, scheme) == (1280, "light"):
            _picture(page, 1280, 1250, "light")
        page.close()


def test_waiting_for_a_person_is_not_recording(tmp_path, page):
    """It says what to put where and what to press; the word is the button's."""
    with running(tmp_path, BENCH_ASKS=1) as daemon:
        _open(page, daemon)
        daemon.record(1)
        _says(page, "waiting for a person", "Put mug on the table", "press It is placed")
        assert "recording" not in page.inner_text("#band").lower()
        _picture(page, 390, 844, "light")
        page.click("#confirm")
        _says(page, "idle")
        page.close()


def test_without_the_token(tmp_path, page):
    """Opened without its token the page says what to do; the refusals are all the console tells."""
    page.may_fail = True
    with running(tmp_path) as daemon:
        page.goto(daemon.url.partition("#")[0])
        page.wait_for_selector("#notice:not([hidden])")
        _says(page, "no access")
        assert "tofcapture status --url" in page.text_content("#notice")


def test_lost_and_found(tmp_path, page):
    """The page finds a daemon that comes back."""
    page.may_fail = True
    with running(tmp_path) as daemon:
        _open(page, daemon)
        port = daemon.port
    _says(page, "connection lost")
    with running(tmp_path, port=port):
        _says(page, "idle")
