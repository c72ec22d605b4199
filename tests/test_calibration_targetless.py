"""Alignment without a board: silhouettes to a hundredth of a pixel under multipath, and only those that somebody saw past."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.alignment_seeds import run_scenes
from calibration.align import align
from calibration.registration.relief import Relief
from calibration.registration.steps import (
    FINE,
    SHIFTS,
    SIDE,
    Phasors,
    measure_steps,
    misfits_of_shifts,
)
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.ops.project import triangulate
from tofcapture.poses import transform

TOF = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
FINER = 3  # samples along a fine pixel
K = 4 * np.pi * np.array([20e6, 100e6]) / 299792458.0
STEREO = Camera(256, 192, 240.0, 240.0, 127.5, 95.5)
FRONT, BACK = 0.6, 0.8


def boxed(camera, right=0.0, down=0.0):
    """Depth of a lozenge before a wall, its image that many ToF pixels off, and which of it is the front."""
    u, v = (
        c / camera.width * TOF.width
        for c in np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    )
    x, y = u - 32 - right, v - 24 - down
    front = (np.abs(x + 0.3 * y) < 14) & (np.abs(y - 0.2 * x) < 11)
    return np.where(front, FRONT, BACK), front


def seen(right=0.0, down=0.0, multipath=0.0, noise=0.0):
    """Image of the lozenge: irradiance of a lamp at the lens, light from elsewhere that bends its phases, noise."""
    fine = TOF.scaled(FINE * FINER)
    depth, front = boxed(fine, right, down)
    path = depth * fine.ray_lengths
    u, v = np.meshgrid(np.linspace(-1, 1, fine.width), np.linspace(-1, 1, fine.height))
    rng, out = np.random.default_rng(0), []
    for k in K:
        z = np.where(front, 0.7, 0.4) * depth / path / path**2 * np.exp(1j * k * path)
        z += multipath * np.where(front, 0.2 + 0.1 * u, 0.3 - 0.1 * v) * np.exp(1j * k * (path + 0.15))
        z = 500 * z.reshape(TOF.height, FINE * FINER, TOF.width, -1).mean(axis=(1, 3))
        out.append(z + noise * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape)))
    return Phasors(np.array(out), np.full(2, max(noise, 1e-6)), K, TOF, np.zeros(3))


def displacement(steps):
    """What all steps say together, px."""
    return np.linalg.solve(steps.information.sum(axis=0), steps.gradient.sum(axis=0))


@pytest.mark.parametrize("multipath", [0.0, 0.3])
def test_steps_are_found_to_a_hundredth_of_a_pixel(multipath):
    """The image's place is told, whatever light from elsewhere does to the phases; depth there is centimetres off."""
    depth, _ = boxed(TOF.scaled(FINE))
    image = seen(0.12, -0.07, multipath, noise=1.0)
    bent = np.angle(image.image[1] * seen(0.12, -0.07).image[1].conj()) / K[1]
    assert np.abs(bent).max() > 0.01 * bool(multipath)
    steps = measure_steps(image, depth)
    assert len(steps) > 20
    np.testing.assert_allclose(steps.front, FRONT)
    np.testing.assert_allclose(displacement(steps), [0.12, -0.07], atol=0.012)
    outer = np.einsum("ni,ni->n", steps.outward, steps.pixel - [31.5, 23.5])
    assert (outer > 0).all()


def test_a_start_whole_pixels_off_is_found():
    """Of all shifts that of the image fits best."""
    misfits = misfits_of_shifts(seen(3.0, -2.0), boxed(TOF.scaled(FINE))[0])
    assert np.array_equal(np.argwhere(misfits == misfits.min()) - SHIFTS, [[-2, 3]])


def test_unknown_pixels_do_not_count():
    """A patch with a hole beside its step says the same, one whose step is unknown nothing."""
    depth, _ = boxed(TOF.scaled(FINE))
    whole = measure_steps(seen(0.1), depth)
    holed = depth.copy()
    holed[: 16 * FINE] = np.nan
    some = measure_steps(seen(0.1), holed)
    assert 0 < len(some) < len(whole)
    assert displacement(some)[0] == pytest.approx(0.1, abs=0.02)
    assert len(measure_steps(seen(0.1), np.full_like(depth, np.nan))) == 0
    assert len(measure_steps(seen(0.1), np.full_like(depth, BACK))) == 0
    assert SIDE == 7


def relief_of(*places):
    """What stereo cameras at the places (3,) see of the lozenge as a plate before the wall."""
    sheets = []
    for at in places:
        x, y = (STEREO.rays[..., k] * FRONT + at[k] for k in (0, 1))
        u, v = x / FRONT * TOF.fx, y / FRONT * TOF.fy
        front = (np.abs(u + 0.3 * v) < 14) & (np.abs(v - 0.2 * u) < 11)
        depth = np.where(front, FRONT, BACK)
        depth[np.roll(front, 6, 1) ^ front] = np.nan  # beside the front one eye sees no wall
        sheets.append(triangulate(depth, STEREO))
    return Relief(sheets, np.stack([transform(np.eye(3), at) for at in places]), STEREO)


def test_only_rims_that_somebody_saw_past_count():
    """Right of the plate nobody knows how it goes on from one side; from both sides all is known."""
    one, two = relief_of([0.05, 0, 0]), relief_of([0.05, 0, 0], [-0.05, 0, 0])
    depth = one.seen_by(TOF, np.eye(4))
    good = np.isfinite(depth)
    assert np.median(np.abs(depth - boxed(TOF.scaled(FINE))[0])[good]) < 1e-6
    steps = measure_steps(seen(), boxed(TOF.scaled(FINE))[0])
    alone, together = (r.empty_beside(steps, TOF, np.eye(4)) for r in (one, two))
    assert together.sum() >= alone.sum()
    assert alone.any()
    wall = relief_of([0.05, 0, 0])
    wall.sheets[0].vertex[:] = False
    assert not wall.empty_beside(steps, TOF, np.eye(4)).any()


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_scenes_align_the_cameras_as_well_as_the_board(tmp_path):
    """From a drawing degrees off: within three times of what averaged board views give, and of the stated error."""
    row = run_scenes(32, 0, tmp_path)[0]
    assert row["rotation_deg"] < 3 * 0.019
    assert row["translation_mm"] < 3 * 0.28
    assert max(map(abs, row["standardised"])) < 3


def test_what_it_cannot_start_from_is_named(tmp_path):
    """A recording without scenes, and no rig at all."""
    with pytest.raises(ConfigError, match="starts from a rig"):
        align(tmp_path, method="targetless", initial="none")
    (tmp_path / "views").mkdir()
    with pytest.raises(DataError, match="views of scenes"):
        align(tmp_path, method="targetless")
