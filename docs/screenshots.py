"""Make the pictures of these pages anew: ``python docs/screenshots.py demo-out``, after ``make demo``.

Needs playwright and Debian's chromium. The daemon's page is photographed by its own test (``TOFCAPTURE_SCREENSHOTS=1 pytest -m slow
tests/test_daemon_browser.py``).
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from pathlib import Path

PICTURES = Path(__file__).parent / "pictures"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SHEETS = {"dataset": "view-sheet", "recording": "view-recording", "recording/rig.toml": "view-calibration"}
FIGURES = {"depth": "dataset", "normals": "dataset", "acquisition": "recording", "preprocessing": "recording"}
RERUN_SECONDS = 60  # until a software renderer has drawn the space


def pictures(demo: Path) -> None:
    """Draw the contact sheets and figures, and photograph Rerun and the report."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    from tofcapture.cli import main
    from tofcapture.viz.web import page_server

    for what, name in SHEETS.items():
        main(["view", str(demo / what), "--png", str(PICTURES / f"{name}.png"), "--views", "3"])
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        predictions, rrd = str(Path(folder) / "predictions"), Path(folder) / "view.rrd"
        main(["predict", str(demo / "dataset"), "--view", "0", "--average", "--out", predictions])
        for what, of in FIGURES.items():
            more = ["--prediction", predictions] if of == "dataset" else []
            main(["figure", what, str(demo / of), *more, "--out", str(PICTURES / f"figure-{what}.png")])
        plan = ["--dry-run", "--picture", str(PICTURES / "plan.svg")]
        main(["record", "--scene", "mug", "--out", str(Path(folder) / "mug"), *plan])
        main(["view", str(demo / "dataset"), "--save", str(rrd), "--views", "8"])
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1200, "height": 800})
        with page_server(rrd, 0) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            page.goto(f"http://127.0.0.1:{server.server_port}")
            page.wait_for_timeout(1000 * RERUN_SECONDS)
            page.screenshot(path=PICTURES / "view-rerun.png")
            server.shutdown()
        page.goto((demo / "report.html").resolve().as_uri())
        page.wait_for_timeout(1000)
        page.screenshot(path=PICTURES / "report.png")
        browser.close()
    for name in (
        "view-calibration",
        "view-rerun",
        "report",
    ):  # few colours; a palette would put steps into the others
        path = PICTURES / f"{name}.png"
        Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)


if __name__ == "__main__":
    pictures(Path(sys.argv[1]))
