"""The viewer: every kind of file becomes shots, sheets and Rerun files; nothing that cannot be shown is a traceback."""

import http.client
import json
import shutil
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import PATIENCE, pictures, until
from tests.test_files_shard import RIG, write
from tofcapture.cli import main
from tofcapture.colours import _LADDER, GOOD, GREY, MASK, Scale, palette, scale_for
from tofcapture.errors import DeviceError
from tofcapture.files.layout import MaskBit
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest
from tofcapture.rig import dumps_rig
from tofcapture.viz import open_source
from tofcapture.viz.shots import Panel, Shot, Source, scales_of

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture
def dataset(tmp_path):
    """Two small shards and their manifest."""
    folder = tmp_path / "data"
    (folder / "shards").mkdir(parents=True)
    entries = {}
    for scene in ("mug", "box"):
        digest = write(folder / "shards" / f"{scene}.h5", scene=scene)
        entries[scene] = SceneEntry(f"shards/{scene}.h5", digest, 2, "train")
    write_manifest(folder, Manifest(entries))
    return folder


@pytest.fixture
def calibration(tmp_path):
    """A rig and the evidence of its alignment."""
    (tmp_path / "rig.toml").write_text(dumps_rig(RIG))
    pairs = [
        {"view": f"views/calibration/view-{i:03d}.h5", "accepted": i != 1, "rmse_mm": 1.0 + i}
        for i in range(3)
    ]
    evidence = {
        "format": "tofcapture-evidence",
        "version": 1,
        "backend": "open3d",
        "views": 3,
        "used": 2,
        "pairs": pairs,
    }
    (tmp_path / "evidence.json").write_text(json.dumps(evidence))
    return tmp_path


@pytest.fixture
def prediction(tmp_path):
    """What predict writes."""
    folder = tmp_path / "prediction"
    folder.mkdir()
    depth = np.full((4, 6), 0.8, np.float32)
    np.save(folder / "depth.npy", depth)
    np.save(folder / "error.npy", 0.01 * depth)
    np.save(folder / "normals.npy", np.broadcast_to(np.float32([0, 0, -1]), (4, 6, 3)))
    rows = np.zeros((24, 7), "<f4")
    rows[:, 2] = 0.8
    names = "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz", "expected_error"))
    (folder / "cloud.ply").write_bytes(
        f"ply\nelement vertex 24\n{names}end_header\n".encode() + rows.tobytes()
    )
    return folder


def test_a_prediction_without_expected_error_has_one_panel_less(prediction):
    """The published networks predict none and write none."""
    kinds = [panel.kind for panel in open_source(prediction).load(0).panels]
    (prediction / "error.npy").unlink()
    assert [panel.kind for panel in open_source(prediction).load(0).panels] == [
        kind for kind in kinds if kind != "expected"
    ]


def test_kinds_are_told_apart(dataset, calibration, prediction):
    """Datasets, shards, predictions and calibrations are recognised by what they hold."""
    assert len(open_source(dataset).names) == 2 * len(open_source(dataset / "shards" / "mug.h5").names)
    assert open_source(prediction).load(0).clouds["estimate"].points.shape == (24, 3)
    for name in ("rig.toml", "evidence.json"):
        said = open_source(calibration / name).calibration
        assert [p[2] for p in said.pairs] == [True, False, True]
        assert said.pairs[0][1] == pytest.approx(1e-3)


def test_shots_of_a_shard_are_its_arrays(dataset):
    """Error is sensor minus ground truth exactly where ground truth is good; clouds hold what is finite."""
    shot = open_source(dataset / "shards" / "mug.h5").load(0)
    by = {p.title: p for p in shot.panels}
    error = by["ToF - ground truth"].values
    assert np.isfinite(error).sum() > 0
    assert shot.T_base_tof.shape == (4, 4)
    good = by["mask"].values == 0
    assert (by["ground truth depth"].on_object == good).all()
    np.testing.assert_array_equal(
        np.isfinite(error), by["ToF depth"].on_object & np.isfinite(by["ToF depth"].values)
    )
    assert len(shot.clouds["tof"].points) == np.isfinite(by["ToF depth"].values).sum()


def test_colours_say_what_they_mean():
    """No value is grey, zero error is white, the gravest mask bit wins, signed scales are symmetric."""
    error = Panel("e", "error", np.array([[0.0, 10.0], [-2.0, np.nan]]))
    scale = scales_of([error])["error"]
    assert (scale.low, scale.unit) == (-scale.high, "mm")
    image = error.paint(scale)
    assert tuple(image[1, 1]) == GREY
    assert image[0, 0].min() > 240
    mask = Panel("m", "mask", np.array([[0, MaskBit.EDGE | MaskBit.NOT_HIT]], np.uint8)).paint(None)
    assert tuple(mask[0, 0]) == GOOD[0]
    assert tuple(mask[0, 1]) == MASK[MaskBit.NOT_HIT][0]


@pytest.mark.parametrize("name", ["viridis", "cividis", "magma", "RdBu_r"])
def test_palettes_are_those_of_matplotlib(name):
    """The map that a scale names is the one that everybody knows, to a few of 255 levels; the last colour is grey."""
    known = pytest.importorskip("matplotlib").colormaps[name].resampled(255)(np.arange(255), bytes=True)
    found = palette(name)
    assert np.abs(found[:-1].astype(int) - known[:, :3]).max() <= 12
    assert tuple(found[-1]) == GREY


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3), st.sampled_from([1.0, 0.5]))
@settings(max_examples=30)
def test_a_scale_spans_its_colours(low, span, gamma):
    """The ends have the first and the last colour, beyond them nothing changes, NaN is grey."""
    scale = Scale("viridis", low, low + span, "mm", gamma)
    values = np.array([[low, low + span, low - 1, low + span + 1, np.nan]])
    assert scale.indices(values).tolist() == [[0, 254, 0, 254, 255]]
    assert [float(scale.ticks[i]) for i in (0, -1)] == pytest.approx([low, low + span], rel=1e-4, abs=1e-6)


def test_numbers_along_a_scale_are_round():
    """Ends of scales come from a ladder, and so do the numbers between them; a signed scale has its zero."""
    assert Scale("magma", 0, 1.5, "mm").ticks == ["0", "0.5", "1", "1.5"]
    assert Scale("RdBu_r", -7.5, 7.5, "mm").ticks == ["-7.5", "-5", "-2.5", "0", "2.5", "5", "7.5"]
    assert Scale("cividis", 0, 750, "raw units", 0.5).ticks == ["0", "30", "120", "270", "480", "750"]
    assert Scale("viridis", 0.26, 0.52, "m").ticks == ["0.26", "0.39", "0.52"]
    for end in _LADDER:
        assert "0" in Scale("RdBu_r", -end, end, "mm").ticks


def test_the_depth_scale_shows_the_object():
    """Where the object is known the scale is about it, whatever stands behind; else it leaves out the far quarter."""
    depth = np.linspace(0.5, 3.0, 10_000).reshape(100, 100)
    about = scale_for("depth", [depth], [(depth > 0.70) & (depth < 0.80)])
    assert 0.66 < about.low < 0.70
    assert 0.80 < about.high < 0.84
    everything = scale_for("depth", [depth])
    assert everything.low < 0.6
    assert 2.2 < everything.high < 2.5
    nothing = scale_for("depth", [np.full((3, 3), np.nan)], [np.zeros((3, 3), bool)])
    assert nothing.low < nothing.high


def test_views_are_thinned_evenly():
    """First and last are kept, and never more than wanted."""
    source = Source("t", [str(i) for i in range(100)], lambda i: Shot(str(i), []))
    assert source.spread(5) == [0, 25, 50, 74, 99]
    assert source.spread(200) == list(range(100))


def test_contact_sheets_are_1200_wide(dataset, calibration, prediction, drawn, tmp_path, capsys):
    """All kinds become PNG of 1200 pixels; the same input gives the same bytes, and they look as they did."""
    for path in (dataset, calibration / "rig.toml", prediction):
        sheets = [tmp_path / f"{i}.png" for i in (1, 2)]
        for sheet in sheets:
            assert main(["view", str(path), "--png", str(sheet), "--views", "3"]) == 0
        data = sheets[0].read_bytes()
        assert int.from_bytes(data[16:20]) == 1200
        assert data == sheets[1].read_bytes()
    pictures.hold("sheet", drawn[::2])
    assert "3 of 4 views" in capsys.readouterr().out


def test_rerun_files_are_written(dataset, calibration, tmp_path):
    """A Rerun file of each kind; its own checker accepts it."""
    pytest.importorskip("rerun")
    for path in (dataset, calibration / "evidence.json"):
        out = tmp_path / "x.rrd"
        assert main(["view", str(path), "--save", str(out)]) == 0
        assert out.read_bytes()[:4] == b"RRF2"


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda p: p / "nothing", 5),
        (lambda p: _text(p / "notes.txt", "hello"), 5),
        (lambda p: _text(p / "evidence.json", "{}"), 5),
        (lambda p: _text(p / "rig.toml", "units = 'mm'"), 3),
        (lambda p: _text(p / "half.h5", "\x89HDF\r\n\x1a\nxxxx", "latin-1"), 5),
        (lambda p: p, 5),
    ],
)
def test_what_cannot_be_shown_is_said(make, code, tmp_path, capsys):
    """A sentence and a hint, the right exit code, and nothing written."""
    assert main(["view", str(make(tmp_path)), "--png", str(tmp_path / "out.png")]) == code
    said = capsys.readouterr().err
    assert said.startswith("tofcapture: ")
    assert "try: " in said or "expected" in said
    assert len(said.splitlines()) <= 5
    assert not (tmp_path / "out.png").exists()


def _text(path, text, encoding="utf-8"):
    path.write_bytes(text.encode(encoding))
    return path


PROGRAM = """#!{python}
import http.server, os, sys
port = int(sys.argv[sys.argv.index("--web-viewer-port") + 1])
assert "--serve-web" in sys.argv and sys.argv[sys.argv.index("--bind") + 1] == "127.0.0.1"
os.chdir({folder!r})
http.server.HTTPServer(("127.0.0.1", port), http.server.SimpleHTTPRequestHandler).serve_forever()
"""


@pytest.fixture
def pretended(tmp_path, monkeypatch):
    """A program that serves a page as Rerun's does; the page loads a font from elsewhere."""
    assets = tmp_path / "assets"
    assets.mkdir()
    for name in ("re_viewer.js", "re_viewer_bg.wasm", "favicon.ico"):
        (assets / name).write_text(name)
    fonts = '<link rel="stylesheet" href="https://fonts.example/x.css">'
    (assets / "index.html").write_text(f"<html><head>{fonts}</head><body></body></html>")
    program = tmp_path / "rerun"
    program.write_text(PROGRAM.format(python=sys.executable, folder=str(assets)))
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))


@pytest.mark.usefixtures("pretended")
def test_the_page_is_rerun_s_and_asks_nobody_else(tmp_path):
    """Every file comes from the program's own server, which is gone afterwards; what lies elsewhere is not loaded."""
    from tofcapture.viz.web import page_server

    rrd, before = tmp_path / "x.rrd", _servers()
    rrd.write_bytes(b"RRF2 and more")
    with page_server(rrd, 0) as server:
        until(lambda: _servers() <= before)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        link = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE)
        answers = {}
        for path in ("/", "/index.html", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico", "/view.rrd"):
            link.request("GET", path)
            answer = link.getresponse()
            answers[path] = answer.status, answer.read()
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
            where = answer.headers.get("Location", "")
            assert (f"url=http://127.0.0.1:{server.server_port}/view.rrd" in where) == (path == "/")
        link.request("GET", "/", headers={"Host": "evil.example:80"})
        assert link.getresponse().status == 403
        link.close()
        server.shutdown()
        thread.join()
    assert {path: status for path, (status, _) in answers.items()} == {
        p: 303 if p == "/" else 200 for p in answers
    }
    assert answers["/view.rrd"][1] == b"RRF2 and more"
    assert answers["/re_viewer.js"][1] == b"re_viewer.js"
    page = answers["/index.html"][1].decode()
    assert "fonts.example" not in page
    assert page.startswith("<html><head><script>\nconst own = window.fetch;")


def test_a_program_that_never_answers_is_given_up(monkeypatch, tmp_path):
    """The reason is said, and what to do instead."""
    from tofcapture.viz import web

    program = tmp_path / "rerun"
    program.write_text(f"#!{sys.executable}\nimport time; time.sleep(600)\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(web, "_PATIENCE", 0.5)
    with pytest.raises(DeviceError, match="did not come") as caught, web.page_server(tmp_path / "x.rrd", 0):
        pass
    assert "--png" in caught.value.hint


@pytest.fixture
def server(dataset, tmp_path):
    """The page on a free port."""
    pytest.importorskip("rerun")
    from tofcapture.viz.web import page_server

    rrd = tmp_path / "x.rrd"
    assert main(["view", str(dataset), "--save", str(rrd)]) == 0
    with page_server(rrd, 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.mark.slow
def test_page_is_for_this_machine_only(server):
    """It listens on the loopback interface, refuses other names, and its policy lets the browser ask nobody else."""
    assert server.server_address[0] == "127.0.0.1"
    link = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE)
    for host, path, status in (
        ("127.0.0.1", "/", 303),
        ("localhost", "/view.rrd", 200),
        ("127.0.0.1", "/etc/passwd", 404),
        ("evil.example", "/view.rrd", 403),
    ):
        link.request("GET", path, headers={"Host": f"{host}:{server.server_port}"})
        answer = link.getresponse()
        body = answer.read()
        assert answer.status == status, path
        if status == 200:
            assert "connect-src 'self'" in answer.headers["Content-Security-Policy"]
            assert body[:4] == b"RRF2"
    link.close()


@pytest.mark.slow
def test_page_opens_in_chromium_and_asks_nobody_else(server):
    """Rerun's page shows the data without an error on its console; no request leaves the machine."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt install chromium")
    asked, said = [], []
    with playwright.sync_playwright() as play:
        flags = [
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--ignore-gpu-blocklist",
        ]
        browser = play.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 1200, "height": 800})
        page.set_default_timeout(1000 * PATIENCE)
        page.on("request", lambda r: asked.append(r.url))
        page.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: said.append(str(e)))
        page.goto(f"http://127.0.0.1:{server.server_port}")
        end = time.monotonic() + PATIENCE
        while not any(url.endswith("/view.rrd") for url in asked) and time.monotonic() < end:
            page.wait_for_timeout(500)
        page.wait_for_timeout(5000)
        browser.close()
    assert said == []
    assert any(url.endswith("/view.rrd") for url in asked)
    assert [url for url in asked if not url.startswith(("http://127.0.0.1:", "blob:", "data:"))] == []


def test_reports_nothing(tmp_path):
    """The window's environment carries a configuration that says no."""
    from tofcapture.viz.web import quiet_environment

    env = quiet_environment(tmp_path)
    assert (
        json.loads((Path(env["XDG_CONFIG_HOME"]) / "rerun/analytics.json").read_text())["analytics_enabled"]
        is False
    )


@pytest.mark.slow
def test_rerun_leaves_no_process_behind(tmp_path):
    """The server that the page is taken from is gone afterwards."""
    pytest.importorskip("rerun")
    from tofcapture.viz.web import save_page

    before = _servers()
    save_page(tmp_path)
    assert "const own" in (tmp_path / "index.html").read_text()
    until(lambda: _servers() <= before)


def _servers():
    """Processes of Rerun's server."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if b"--serve-web" in path.read_bytes():
                found.add(path.parent.name)
        except OSError:
            continue
    return found
