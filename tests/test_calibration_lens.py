"""The lens: OpenCV's formula, known distortion recovered from made views and rays, refusals by name."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.lens import LensRefused, LensView, circle_centres, pixels_of
from calibration.lens_fit import fit_lens, fit_lens_to_rays
from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.poses import invert, look_at

TRUE = Camera(240, 180, 205.0, 206.0, 121.3, 88.2, (-0.21, 0.11, 0.0012, -0.0008, -0.03))


def board():
    x, y = np.meshgrid((np.arange(7) - 3) * 0.05, (np.arange(5) - 2) * 0.05)
    return np.stack([x.ravel(), y.ravel(), np.zeros(35)], axis=1)


def views(seed=0, count=12, noise=0.0, tilt=(20, 40), radius=0.0, off_axis=0.04, seen_as=None):
    """Board views inside the image, made by the true lens."""
    rng, out = np.random.default_rng(seed), []
    while len(out) < count:
        angle, turn, far = np.radians(rng.uniform(*tilt)), rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.7)
        way = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
        shift = rng.normal(0, off_axis, 3) * [1, 1, 0]
        T = invert(
            look_at(-far * way + (0 if off_axis else shift), shift, (0, -1, 0), rng.uniform(-0.5, 0.5))
        )
        xy = circle_centres(T, board(), radius) if radius else (board() @ T[:3, :3].T + T[:3, 3])
        pixels = pixels_of(TRUE, xy) if radius else TRUE.project(xy)[0]
        if (pixels > 0).all() and (pixels < [239, 179]).all():
            seen = radius if seen_as is None else seen_as
            out.append(LensView(board(), pixels + rng.normal(0, noise, pixels.shape), seen))
    return out


def farthest(lens):
    """Largest disagreement of two lenses over the image, pixels."""
    return 205 * np.abs(lens.rays - TRUE.rays).max()


@pytest.mark.parametrize("radius", [0.0, 0.02])
def test_exact_views_give_the_exact_lens(radius):
    """Points and ellipse centres without noise recover all nine numbers."""
    fit = fit_lens(views(count=6, radius=radius), 240, 180)
    assert farthest(fit.camera) < 1e-5
    assert fit.rms < 1e-6


def test_ellipses_taken_for_points_are_biased():
    """Ellipse centres taken for the images of points bias the focal length, though they fit to 0.005 pixels."""
    wrong = fit_lens(views(count=6, radius=0.03, seen_as=0.0), 240, 180)
    assert 205 - wrong.camera.fx > 0.3


def test_noisy_views_stay_within_their_error_bars():
    """A twentieth of a pixel of noise moves the lens by less than four sigma and by less than a pixel anywhere."""
    fit = fit_lens(views(1, noise=0.05), 240, 180, k3=False)
    c = fit.camera
    off = np.array([c.fx - 205, c.fy - 206, c.cx - 121.3, c.cy - 88.2])
    assert (np.abs(off) < 4 * fit.sigma[:4]).all()
    assert fit.sigma[8] == 0
    assert farthest(fit.camera) < 1
    assert 0.05 < fit.rms < 0.09


def test_sensor_rays_give_the_lens():
    """The rays a sensor reports, some of them missing, give the lens that made them."""
    rays = TRUE.rays / np.linalg.norm(TRUE.rays, axis=-1, keepdims=True)
    rays[:5, :5] = np.nan
    fit = fit_lens_to_rays(rays)
    assert farthest(fit.camera) < 1e-6
    for spoilt, says in ((-rays, "backwards"), (rays * [-1, 1, 1], "mirrored|right"), (rays[0], "shape")):
        with pytest.raises(DataError, match=says):
            fit_lens_to_rays(spoilt)


def test_views_parallel_to_the_image_determine_no_focal_length():
    """Boards parallel to the image leave the focal length free: refused by name."""
    with pytest.raises(LensRefused, match="focal length undetermined"):
        fit_lens(views(tilt=(0, 0), off_axis=0.0, noise=0.05), 240, 180)


def nowhere(v):
    return LensView(v.points, np.full_like(v.pixels, np.nan))


@pytest.mark.parametrize(
    ("spoil", "kind", "says"),
    [
        (lambda vs: vs[:2], DataError, "at least 3 views"),
        (lambda vs: [*vs[:5], nowhere(vs[5])], DataError, "view 5: expected at least 6 found points, got 0"),
        (lambda vs: [LensView(v.points * [-1, 1, 1], v.pixels) for v in vs], DataError, "mirrored"),
        (lambda vs: [LensView(v.points, v.pixels[:, ::-1]) for v in vs], DataError, "inside 240 x 180"),
        (
            lambda vs: [LensView(v.points + np.array([0, 0, 0.01]), v.pixels) for v in vs],
            DataError,
            "plane target",
        ),
        (lambda vs: [LensView(v.points[:-1], v.pixels) for v in vs], DataError, "expected points"),
        (
            lambda vs: [
                LensView(v.points, np.random.default_rng(i).permutation(v.pixels)) for i, v in enumerate(vs)
            ],
            (LensRefused, DataError),
            "lens",
        ),
    ],
)
def test_bad_views_are_named(spoil, kind, says):
    """Too few, empty, mirrored, transposed, shuffled and not plane views each say what is wrong."""
    with pytest.raises(kind, match=says):
        fit_lens(spoil(views(count=6)), 240, 180)
