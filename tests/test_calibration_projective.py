"""Our own registration: exact surfaces, transforms recovered, noise weighted as it is, failures named, the same bits."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calibration.backends import register
from calibration.clouds import Cloud
from calibration.projective.grid import surface_grid
from calibration.projective.newton import Match, moved, newton_step, normal_equations, tukey
from calibration.projective.weak import along_weak_motions, weak_motions
from calibration.projective_icp import range_sigma_of, register_projective
from calibration.registration import MIN_POINTS, Refusal, check_registration
from tests.balls import BALLS, GRID, STEREO, TOF, TRUE, errors, guess, stereo_points, tof_points
from tofcapture import poses
from tofcapture.errors import ConfigError, DataError


@pytest.mark.parametrize("seed", range(6))
def test_known_transform_is_recovered(seed):
    """From 3 degrees and 3 cm away, with 3 mm of range noise, the pose comes back within 0.1 degrees and 0.6 mm."""
    points = tof_points(np.random.default_rng(seed), 0.003)
    result = register_projective(points, GRID, guess(seed), 0.003)
    rotation, translation = errors(result.T_target_source)
    assert rotation < 0.1
    assert translation < 0.6
    assert check_registration(result, points, GRID.cloud(), TRUE) is None


def test_exact_data_give_the_exact_transform():
    """Without noise what is left is the surface model's own error: below 0.005 degrees and 0.03 mm."""
    result = register_projective(tof_points(), surface_grid(stereo_points(), STEREO), guess(0))
    rotation, translation = errors(result.T_target_source)
    assert rotation < 0.005
    assert translation < 0.03


def test_plane_is_exact_at_any_tilt():
    """Inverse depth is linear on planes: tangent planes of a tilted wall are the wall, between pixels as on them."""
    n = np.array([0.5, -0.3, 1.0])
    points = STEREO.rays * (0.9 / (STEREO.rays @ n))[..., None]
    at = points.reshape(-1, 3)[::997].T * np.random.default_rng(0).uniform(
        0.97, 1.03, (1, len(points.reshape(-1, 3)[::997]))
    )
    planes = surface_grid(points, STEREO).planes_at(at)
    assert planes.found.mean() > 0.9
    np.testing.assert_allclose(
        planes.normals[:, planes.found].T, np.tile(n / np.linalg.norm(n), (planes.found.sum(), 1)), atol=1e-9
    )
    np.testing.assert_allclose(planes.offsets[planes.found], 0.9 / np.linalg.norm(n), atol=1e-9)


def test_ball_is_touched():
    """On a ball of 9 cm the tangent planes lie within 20 micrometres and half a degree of the ball's own."""
    *centre, radius = BALLS[0]
    centre = poses.transform_points(TRUE, np.array(centre))
    rng = np.random.default_rng(0)
    outward = rng.normal(size=(400, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    outward = outward[outward @ (centre / np.linalg.norm(centre)) < -0.6]
    points = centre + radius * outward
    planes = surface_grid(stereo_points(), STEREO).planes_at(points.T)
    assert planes.found.all()
    off = (points.T * planes.normals).sum(axis=0) - planes.offsets
    assert np.abs(off).max() < 2e-5
    assert np.degrees(np.arccos(-(planes.normals.T * outward).sum(axis=1))).max() < 0.5


def test_edges_and_holes_belong_to_no_surface():
    """Within a block of a depth edge, in a hole and outside the image no plane is found; elsewhere on the wall all are."""
    depth = np.full(STEREO.shape, 1.0)
    depth[:, :300] = 0.9
    depth[200:240, 400:440] = np.nan
    grid = surface_grid(STEREO.unproject(depth), STEREO)

    def found(u, v, z=1.0):
        return grid.planes_at(
            z * np.array([[(u - STEREO.cx) / STEREO.fx], [(v - STEREO.cy) / STEREO.fy], [1]])
        ).found[0]

    assert not any(found(u, 100) for u in (298, 299, 300, 301))
    assert all(found(u, 100) for u in (290, 294, 306, 310))
    assert not found(420, 220)
    assert not found(-5, 100)
    assert not found(100, 100, z=-1.0)


def test_jacobian_is_the_derivative_of_the_cost():
    """The gradient of the normal equations agrees with central differences of half the weighted squared distances."""
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(3, 50)), rng.normal(size=(3, 50))
    normals /= np.linalg.norm(normals, axis=0)
    offsets, weights, centre = rng.normal(size=50), rng.uniform(0.1, 1, 50), np.array([0.1, 0.2, 0.3])

    def distance(step):
        at = poses.transform_points(moved(np.eye(4), step, centre), points.T).T
        return (at * normals).sum(axis=0) - offsets

    match = Match(np.arange(50), points, normals, distance(np.zeros(6)), np.ones(50), np.zeros(50))
    H, g = normal_equations(match, weights, centre)
    h = 1e-5 * np.eye(6)
    numeric = [(weights * (distance(e) ** 2 - distance(-e) ** 2)).sum() / 4e-5 for e in h]
    J = np.array([(distance(e) - distance(-e)) / 2e-5 for e in h])
    np.testing.assert_allclose(g, numeric, rtol=1e-6)
    np.testing.assert_allclose(H, (J * weights) @ J.T, rtol=1e-6, atol=1e-8)


def test_long_steps_are_shortened():
    """A step never leaves the neighbourhood in which the planes hold, and keeps its direction."""
    step = newton_step(np.eye(6), -np.array([1.0, 0, 0, 0, 0.1, 0]))
    assert np.linalg.norm(step[:3]) == pytest.approx(0.05)
    assert step[4] / step[0] == pytest.approx(0.1)


def test_information_predicts_the_scatter():
    """The inverse information is the covariance of the estimates over many draws of the range noise, within 40 %."""
    start = poses.exp([1e-3, 0, 0, 0, 1e-3, 0]) @ TRUE
    results = [
        register_projective(tof_points(np.random.default_rng(k), 0.002), GRID, start, 0.002, ())
        for k in range(40)
    ]
    c = results[0].centre
    xi = []
    for r in results:
        D = r.T_target_source @ poses.invert(TRUE)
        xi.append(np.concatenate([poses.transform_points(D, c) - c, poses.rotation_log(D[:3, :3])]))
    predicted = np.sqrt(np.diag(np.linalg.inv(results[0].information)))
    np.testing.assert_allclose(np.std(xi, axis=0), predicted, rtol=0.4)


def test_information_measures_the_scale_itself():
    """A noise model that is wrong by a factor changes neither the transform nor the information by more than the floor's share."""
    points = tof_points(np.random.default_rng(1), 0.004)
    one, other = (register_projective(points, GRID, TRUE, s, ()) for s in (0.004, 0.008))
    np.testing.assert_allclose(one.T_target_source, other.T_target_source, atol=2e-4)
    np.testing.assert_allclose(np.diag(one.information), np.diag(other.information), rtol=0.15)


def test_weights_reduce_the_error_under_uneven_noise():
    """Where half the pixels are ten times as noisy, knowing which halves the mean error over six draws."""
    sigma = np.where(np.arange(TOF.height * TOF.width) % 2 == 0, 0.001, 0.010)
    known, unknown = [], []
    for k in range(6):
        points = tof_points(np.random.default_rng(k), sigma.reshape(TOF.shape))
        known.append(errors(register_projective(points, GRID, TRUE, sigma, ()).T_target_source))
        unknown.append(errors(register_projective(points, GRID, TRUE, 0.005, ()).T_target_source))
    assert (np.mean(known, axis=0) < 0.7 * np.mean(unknown, axis=0)).all()


def test_rotation_of_the_source_frame_turns_the_result():
    """Rays turned about their camera and a guess turned back give the same registration, composed with the turn."""
    points = tof_points(np.random.default_rng(2), 0.003)
    turn = poses.transform(poses.rotation_exp([0.4, -0.2, 0.9]), [0, 0, 0])
    plain = register_projective(points, GRID, guess(2), 0.003)
    turned = register_projective(
        poses.transform_points(turn, points), GRID, guess(2) @ poses.invert(turn), 0.003
    )
    np.testing.assert_allclose(turned.T_target_source @ turn, plain.T_target_source, atol=5e-5)
    np.testing.assert_allclose(
        turned.information, plain.information, rtol=0.02, atol=0.002 * plain.information.max()
    )


def test_motion_of_a_source_cloud_moves_the_result():
    """Clouds know no rays: the backend on a source moved anywhere answers the same registration, composed with the motion."""
    points, target = tof_points(np.random.default_rng(3), 0.002), GRID.cloud()
    target = Cloud(target.points[::4], target.normals[::4])
    motion = poses.transform(poses.rotation_exp([0.4, -0.2, 0.9]), [1.0, -2.0, 0.5])
    plain = register("projective", points, target, guess(3, 1.0, 0.01))
    there = poses.transform_points(motion, points)
    other = register("projective", there, target, guess(3, 1.0, 0.01) @ poses.invert(motion))
    np.testing.assert_allclose(other.T_target_source @ motion, plain.T_target_source, atol=2e-5)
    rotation, translation = errors(plain.T_target_source)
    assert rotation < 0.1
    assert translation < 0.6


def test_order_of_the_points_does_not_matter():
    """Shuffled points come to the same transform far within its standard error."""
    rng = np.random.default_rng(4)
    points = tof_points(rng, 0.003)
    plain = register_projective(points, GRID, guess(4), 0.003)
    other = register_projective(rng.permutation(points), GRID, guess(4), 0.003)
    np.testing.assert_allclose(other.T_target_source, plain.T_target_source, atol=5e-5)


def test_flying_pixels_are_refused():
    """One point in twenty anywhere between the balls and the wall moves the result by less than 0.3 mm."""
    rng = np.random.default_rng(5)
    points = tof_points(rng, 0.002)
    flying = rng.choice(len(points), len(points) // 20, replace=False)
    spoilt = points.copy()
    spoilt[flying] *= rng.uniform(0.75, 1.0, (len(flying), 1))
    clean, dirty = (register_projective(p, GRID, guess(5), 0.002) for p in (points, spoilt))
    assert np.linalg.norm(clean.T_target_source[:3, 3] - dirty.T_target_source[:3, 3]) < 3e-4
    assert errors(dirty.T_target_source)[1] < 0.6


def test_partial_overlap_with_holes_is_enough():
    """With a third of the stereo image gone and a tenth of its pixels lost at random the pose still comes back."""
    stereo = stereo_points(3e-4)
    stereo[:, :200] = np.nan
    stereo[np.random.default_rng(0).random(STEREO.shape) < 0.1] = np.nan
    result = register_projective(
        tof_points(np.random.default_rng(6), 0.003), surface_grid(stereo, STEREO), guess(6), 0.003
    )
    rotation, translation = errors(result.T_target_source)
    assert rotation < 0.2
    assert translation < 1.0


def test_weak_motions_are_named():
    """Normals that all but agree leave the two slides along their plane weak, and a ball's worth of others none."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (3, 400))
    points[2] *= 0.1
    normals = np.tile([[0.0], [0.0], [1.0]], 400) + rng.normal(0, 0.03, (3, 400))

    def ways(normals):
        n = normals / np.linalg.norm(normals, axis=0)
        match = Match(np.arange(400), points, n, np.zeros(400), np.ones(400), np.ones(400))
        return weak_motions(normal_equations(match, np.ones(400), np.zeros(3))[0], 0.25)

    assert len(ways(normals)) == 2
    assert all(np.abs(way[2]) < 0.1 for way in ways(normals))
    assert ways(rng.normal(size=(3, 400))) == []


def test_walk_ends_where_most_rays_are_explained():
    """Of the places along a motion the one is kept whose rays lie nearest, wherever the pose rested before."""
    way = np.array([1.0, 0, 0, 0, 0, 0])

    def refine(T):
        off = np.full(1000, T[0, 3] - 0.0101)
        return T, Match(
            np.arange(1000), *np.zeros((2, 3, 1000)), off, np.full(1000, 1e-6), np.ones(1000), 1000
        )

    T = along_weak_motions(np.eye(4), [way], np.zeros(3), refine, 4.685)
    assert T[0, 3] == pytest.approx(0.010)


def test_few_points_are_refused_as_empty():
    """Fewer rays than the gate's least stay at the guess and are refused as empty; so is a blank stereo image."""
    points = tof_points()[:: TOF.height * TOF.width // (MIN_POINTS // 2)]
    blank = surface_grid(np.full((*STEREO.shape, 3), np.nan, dtype=np.float32), STEREO)
    for source, grid in ((points, GRID), (tof_points(), blank), (np.zeros((0, 3)), GRID)):
        result = register_projective(source, grid, TRUE)
        np.testing.assert_array_equal(result.T_target_source, TRUE)
        assert check_registration(result, source, grid.cloud(), TRUE) is Refusal.EMPTY


def test_disjoint_views_are_refused():
    """Rays that leave beside the stereo image have no overlap."""
    away = TRUE @ poses.transform(poses.rotation_exp([0, 1.6, 0]), [0, 0, 0])
    result = register_projective(tof_points(), GRID, away)
    assert check_registration(result, tof_points(), GRID.cloud(), away) is Refusal.NO_OVERLAP


def test_lone_wall_is_refused():
    """A wall without relief determines three of six motions: refused by name, and the result has not run away."""
    points = tof_points(np.random.default_rng(7), 0.002, balls=[])
    grid = surface_grid(stereo_points(3e-4, balls=[]), STEREO)
    result = register_projective(points, grid, TRUE, 0.002)
    assert check_registration(result, points, grid.cloud(), TRUE) is Refusal.PLANAR


@pytest.mark.parametrize(
    ("source", "sigma"),
    [
        (np.full((500, 3), np.nan), None),
        (np.ones((500, 2)), None),
        (np.zeros((500, 3)), None),
        (np.ones((500, 3)), 0.0),
        (np.ones((500, 3)), np.ones(3)),
    ],
)
def test_bad_input_is_refused(source, sigma):
    """Missing points, wrong shapes and noise that is no noise are data errors."""
    with pytest.raises(DataError, match="expected"):
        register_projective(source, GRID, TRUE, sigma)


def test_map_of_another_camera_is_refused():
    """A point map that is not of the camera's shape is a data error."""
    with pytest.raises(DataError, match="stereo points"):
        surface_grid(np.ones((10, 10, 3)), STEREO)


def test_range_noise_of_an_amplitude():
    """Phase noise of 0.0469 rad at 100 MHz is 11.2 mm (method.md 4.2)."""
    assert range_sigma_of(500.0, 100e6, 500 * 0.0469) == pytest.approx(0.0112, rel=0.01)


def test_kernel_falls_from_one_to_zero():
    """Tukey's weight is one at zero, zero from its scale on."""
    np.testing.assert_allclose(tukey(np.array([0.0, 0.5, 1.0, 3.0])), [1.0, 0.5625, 0.0, 0.0])


def digest():
    """Bits of both registrations of one pair."""
    points = tof_points(np.random.default_rng(8), 0.003)
    cloud = GRID.cloud()
    one = register_projective(points, GRID, guess(8), 0.003)
    other = register("projective", points, Cloud(cloud.points[::4], cloud.normals[::4]), guess(8, 1.0, 0.01))
    bits = [
        one.T_target_source,
        one.information,
        one.step,
        np.array([one.rmse, one.condition]),
        other.T_target_source,
    ]
    return hashlib.sha256(b"".join(b.tobytes() for b in bits)).hexdigest()


def test_same_bits_in_another_process_with_another_number_of_threads():
    """A fresh process limited to one BLAS thread gives the bits of this one."""
    code = "from tests.test_calibration_projective import digest; print(digest())"
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == digest()


def test_missing_small_gicp_says_what_to_install(monkeypatch):
    """The optional library's absence is a configuration error with a hint."""
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(ConfigError) as caught:
        register("small-gicp", tof_points(), GRID.cloud(), TRUE)
    assert "pip install small-gicp" in str(caught.value.hint)


def test_small_gicp_recovers_a_known_transform():
    """Where it is installed, the library comes within half a degree and 3 mm."""
    pytest.importorskip("small_gicp")
    cloud = GRID.cloud()
    target = Cloud(cloud.points[::4], cloud.normals[::4])
    result = register("small-gicp", tof_points(np.random.default_rng(9), 0.001), target, guess(9, 1.0, 0.01))
    rotation, translation = errors(result.T_target_source)
    assert rotation < 0.5
    assert translation < 3.0
