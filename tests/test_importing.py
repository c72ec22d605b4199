"""Data of others become a recording: any file form gives the same views, and what cannot be right is named with the remedy."""

from __future__ import annotations

import numpy as np
import pytest

from tofcapture.cli import main
from tofcapture.errors import TofError
from tofcapture.files.check import check
from tofcapture.files.view import find_views, open_view
from tofcapture.importing.said import Said
from tofcapture.importing.views import UNFINISHED, import_data

SHAPE = (30, 40)
TOF = {"fx": 45.0, "fy": 46.0, "cx": 19.0, "cy": 15.5}
HZ = np.repeat([20e6, 100e6], 4)
THETA = np.tile(np.arange(4) * np.pi / 2, 2)


def scene(seed=0, shape=SHAPE):
    """Raw taps (8, H, W) uint16 and depth (H, W) of a slanted wall with a box before it."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    x, y = (u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"]
    z = 1 / (1 / (0.9 + 0.1 * rng.random()) + 0.5 * x - 0.3 * y)
    z[8:18, 6:22] -= 0.15
    phi = 4 * np.pi * HZ[:, None, None] / 299_792_458 * z * np.sqrt(1 + x**2 + y**2)
    raw = 1500 + 400 / z**2 * np.cos(phi + THETA[:, None, None]) + rng.normal(0, 3, (8, *shape))
    return np.rint(raw).astype(np.uint16), z.astype(np.float32)


def scenes(views=3):
    """(N, 8, H, W) and (N, H, W)."""
    raw, depth = zip(*(scene(i) for i in range(views)), strict=True)
    return np.stack(raw), np.stack(depth)


def imported(source, out, **said):
    """Views that a source becomes, in order."""
    import_data([source], out, Said(**{"tof": TOF, **said}))
    return [open_view(p) for views in find_views(out).values() for p in views]


def test_a_folder_of_arrays_becomes_a_recording(tmp_path):
    """Numbered arrays pair with numbered depths; views are whole, exact, and the recording is without problems."""
    raw, depth = scenes()
    for i in range(3):
        np.save(tmp_path / f"raw_{i}.npy", raw[i])
        np.save(tmp_path / f"depth_{i}.npy", depth[i])
    words = ["import", str(tmp_path), "--out", str(tmp_path / "rec"), "--camera", "45,46,19,15.5"]
    assert main(words) == 0
    views = [open_view(p) for p in find_views(tmp_path / "rec")[tmp_path.name]]
    for i, view in enumerate(views):
        np.testing.assert_array_equal(view.tof.raw[0], raw[i])
        np.testing.assert_array_equal(view.stereo.points[..., 2], depth[i])
        assert not view.has_arm
    assert check(tmp_path / "rec") == []
    assert not (tmp_path / "rec" / UNFINISHED).exists()


def test_again_does_nothing_and_other_data_are_refused(tmp_path):
    """The same import is finished at once; another source of that name is refused and changes nothing."""
    raw, depth = scenes(2)
    source = tmp_path / "mug"
    source.mkdir()
    np.save(source / "raw.npy", raw[:, None])
    np.save(source / "depth.npy", depth)
    first = imported(source, tmp_path / "rec")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "rec").rglob("*.h5")}
    again = import_data([source], tmp_path / "rec", Said(tof=TOF))
    assert again.skipped == ["mug"]
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "rec").rglob("*.h5")} == before
    np.save(source / "raw.npy", raw[::-1, None])
    with pytest.raises(TofError, match="is not of these data"):
        import_data([source], tmp_path / "rec", Said(tof=TOF))
    assert len(first) == 2
