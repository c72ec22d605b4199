"""Joint alignment on made boards: exact recovery, honest covariance, and what a lone plane cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.alignment.averages import about, fuse, twist_about
from calibration.alignment.joint import joint_icp
from calibration.alignment.methods import (
    composed,
    joint_evidence,
    method_named,
    plane_information,
    suggest_view,
    unconstrained,
)
from calibration.alignment.views import HALO_RADII, TERMS, JointView, halo_errors
from calibration.range_error.terms import jackknife
from calibration.registration.clouds import Cloud
from calibration.registration.rims import Rims, lit_rims, square_rims
from tests import answers
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.rig import SPEED_OF_LIGHT, RangeError

CAMERA = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
TRUE = poses.transform(poses.rotation_exp([0.045, 0.012, 0.009]), [-0.05, 0.075, 0.004])
GUESS = poses.exp([0.004, -0.003, 0.004, 0.01, -0.012, 0.008]) @ TRUE
HZ = (20e6, 100e6)
HALF = (0.25, 0.20)  # m, half a board


def errors_at(range_, radius_px, error):
    """Range error (N,) of a RangeError at true ranges."""
    return error.at(4 * np.pi * error.modulation_hz / SPEED_OF_LIGHT * range_, radius_px, 45.0)


def made_view(index, rng, errors=(), noise=0.0, bias=0.0, away=None, rims=True):
    """A board tilted 20 to 40 degrees, with range errors, noise, and a bias of its own that is linear over the image."""
    tilt, turn = np.radians(rng.uniform(20, 40)), 2.399963 * index
    away = 0.5 + 0.6 * ((index * 0.618) % 1) if away is None else away
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    centre = np.array([0.0, 0.0, away])
    a = np.cross(normal, [np.sin(index), np.cos(index), 0.0])
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    pixels = CAMERA.rays[::5, ::5].reshape(-1, 3)
    unit = pixels / np.linalg.norm(pixels, axis=1, keepdims=True)
    radial = (normal @ centre) / (unit @ normal)
    on = (np.abs((unit * radial[:, None] - centre) @ np.stack([a, b], 1)) < HALF).all(axis=1)
    unit, radial = unit[on], radial[on]
    radius = np.hypot(unit[:, 0] / unit[:, 2] * CAMERA.fx, unit[:, 1] / unit[:, 2] * CAMERA.fy)
    own = unit[:, :2] @ rng.normal(0, 2 * bias, 2) + rng.normal(0, bias)
    by_hz = {e.modulation_hz: e for e in errors}
    ranges = np.stack(
        [
            radial
            + own
            + rng.normal(0, k * noise, len(radial))
            + errors_at(radial, radius, by_hz.get(f, RangeError(f)))
            for f, k in zip(HZ, (4, 1), strict=True)
        ]
    )
    side = np.linspace(-0.25, 0.25, 101)
    grid = centre + side[:, None, None] * a + side[None, :81, None] * b * 1.0
    back = poses.invert(TRUE)
    surface = Cloud(
        poses.transform_points(back, grid.reshape(-1, 3)),
        np.tile(poses.rotate_vectors(back, normal), (grid[..., 0].size, 1)),
    )
    edge, outward = board_rims(centre, a, b)
    seen = edge * (1 + rng.normal(0, 0.2 * noise, len(edge)))[:, None] + outward * rng.normal(
        0, 0.3 * noise, (len(edge), 1)
    )
    across = np.cross(np.where(np.abs(outward @ a)[:, None] > 0.5, b, a), edge)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    image = np.where(np.abs(outward[:, :1]) > np.abs(outward[:, 1:2]), [1.0, 0, 0], [0, 1.0, 0]) * np.sign(
        outward
    )
    held = Cloud(poses.transform_points(back, edge), poses.rotate_vectors(back, across))
    kept = len(edge) if rims else 0
    return JointView(
        illuminator=np.zeros(3),
        modulation_hz=HZ,
        rays=unit,
        radius_px=radius,
        ranges=ranges,
        sigma=np.stack([np.full(len(unit), max(k * noise, 5e-4)) for k in (4, 1)]),
        halos=np.zeros((2, len(unit), len(HALO_RADII))),
        rims=Rims(seen[:kept], image[:kept]),
        factory=(),
        surface=surface,
        held=held,
    )


def board_rims(centre, a, b):
    """Points (N, 3) on a board's outline and the directions outward."""
    s = np.linspace(-0.95, 0.95, 60)[:, None]
    parts = [(centre + k * HALF[0] * a + s * HALF[1] * b, k * a) for k in (-1, 1)]
    parts += [(centre + k * HALF[1] * b + s * HALF[0] * a, k * b) for k in (-1, 1)]
    return np.concatenate([p for p, _ in parts]), np.concatenate([np.tile(o, (60, 1)) for _, o in parts])


def test_fusion_is_the_weighted_mean_of_small_motions():
    """For small motions the fused twist is (sum H)^-1 sum H xi."""
    rng = np.random.default_rng(0)
    xi = 1e-5 * rng.standard_normal((5, 6))
    H = [A @ A.T + 0.1 * np.eye(6) for A in rng.standard_normal((5, 6, 6))]
    fused = fuse([TRUE @ poses.exp(x) for x in xi], H)
    expected = np.linalg.solve(np.sum(H, axis=0), np.einsum("nij,nj->i", np.array(H), xi))
    np.testing.assert_allclose(poses.log(poses.invert(TRUE) @ fused), expected, atol=1e-9)


def test_fusion_of_large_motions_is_stationary():
    """At the fused transform no small motion lowers the cost, however far the transforms lie apart."""
    rng = np.random.default_rng(1)
    T = [TRUE @ poses.exp(0.3 * rng.standard_normal(6)) for _ in range(4)]
    H = [A @ A.T + np.eye(6) for A in rng.standard_normal((4, 6, 6))]

    def cost(S):
        return sum(
            float(e @ h @ e) for t, h in zip(T, H, strict=True) for e in [poses.log(poses.invert(t) @ S)]
        )

    fused = fuse(T, H)
    for d in np.concatenate([np.eye(6), -np.eye(6)]) * 1e-2:
        assert cost(fused @ poses.exp(d)) > cost(fused)


def test_fusion_demands_that_every_motion_is_held():
    """Informations that together leave a motion free are a data error."""
    with pytest.raises(DataError, match="undetermined"):
        fuse([TRUE, TRUE], [np.diag([1.0, 1, 1, 1, 1, 0])] * 2)


def test_information_moves_with_its_centre():
    """A twist costs the same about the origin and about a centre."""
    rng = np.random.default_rng(2)
    A = rng.standard_normal((6, 6))
    centre, xi = rng.standard_normal(3), rng.standard_normal(6)
    there = np.r_[xi[:3] + np.cross(xi[3:], centre), xi[3:]]
    assert xi @ about(A @ A.T, centre) @ xi == pytest.approx(there @ A @ A.T @ there)


def test_joint_recovers_transform_and_range_errors():
    """An offset of 17 mm, 6 mm waves and a radial term come off to 1 mm RMS over 0.3 to 1.5 m; the transform is found exactly."""
    rng = np.random.default_rng(3)
    wrong = (
        RangeError(20e6, offset=0.010),
        RangeError(100e6, offset=0.017, harmonics=((2, 0.006, 0.001),), per_pixel_radius=2e-5),
    )
    views = [made_view(i, rng, wrong, 3e-4, away=0.35 + 0.09 * i) for i in range(12)]
    found = joint_icp(views, GUESS)
    error = twist_about(found.T_tof_stereo @ poses.invert(TRUE), found.centre)
    assert np.linalg.norm(error[:3]) < 3e-4
    assert np.degrees(np.linalg.norm(error[3:])) < 0.03
    high = composed((), HZ, found.range_coefficients)[1]
    range_ = np.linspace(0.3, 1.5, 200)
    left = errors_at(range_, 40.0, wrong[1]) - errors_at(range_, 40.0, high)
    assert np.sqrt(np.mean(left**2)) < 1e-3


def test_stated_sigmas_cover_the_error():
    """With bias of its own in every view, one sigma holds the error about as often as it should: 72 components."""
    inside = []
    for seed in range(12):
        rng = np.random.default_rng([4, seed])
        found = joint_icp([made_view(i, rng, noise=1e-3, bias=1e-3) for i in range(8)], GUESS)
        error = twist_about(found.T_tof_stereo @ poses.invert(TRUE), found.centre)
        inside.append(np.abs(error) < np.sqrt(np.diag(found.covariance)))
    assert 0.5 < np.mean(inside) < 0.97


def test_joint_refuses_what_does_not_overlap():
    """Too few views, or a guess half a metre off, are quality errors."""
    views = [made_view(i, np.random.default_rng(5)) for i in range(3)]
    with pytest.raises(QualityError, match="at least 3"):
        joint_icp(views[:2], GUESS)
    with pytest.raises(QualityError, match="overlap"):
        joint_icp(views, poses.exp([0.5, 0.5, 0.5, 0, 0, 0]) @ TRUE)


def test_lone_plane_leaves_its_own_motions_unconstrained():
    """A facing plane without holes slides in x and y and turns about z, and is said to."""
    centre = np.array([0.0, 0.0, 0.8])
    free = unconstrained(plane_information(np.array([0.0, 0.0, -1.0]), centre, centre))
    assert len(free) == 3
    said = " ".join(free)
    assert all(name in said for name in ("along x", "along y", "about z"))


def test_suggested_view_helps_the_weakest_motion():
    """What is suggested lowers the largest sigma, and tilts in the direction that is weak."""
    centre = np.array([0.0, 0.0, 0.8])
    base = np.diag([1e4, 1e8, 1e8, 1e7, 1e7, 1e7])
    hint = suggest_view(base, centre)
    assert hint["motion"].startswith("along x")
    assert hint["expected_sigma_mm"] < hint["sigma_mm"]
    assert hint["towards_deg"] % 180 == 0


def test_range_errors_add_to_the_factory_s():
    """Fitted terms are added to the factory's, order by order; what was not fitted stays."""
    own = np.zeros(2 * TERMS + len(HALO_RADII))
    own[TERMS : TERMS + 4] = [0.001, 1e-5, 0.002, 0.003]
    factory = (RangeError(100e6, offset=-0.7, harmonics=((2, 0.006, 0.0),), per_kelvin=1e-4),)
    low, high = composed(factory, HZ, own)
    assert high.offset == pytest.approx(-0.699)
    assert high.per_kelvin == 1e-4
    assert {m: (a, b) for m, a, b in high.harmonics}[1] == (0.002, 0.003)
    assert {m: (a, b) for m, a, b in high.harmonics}[2] == (0.006, 0.0)
    assert low.modulation_hz == 20e6


@pytest.mark.parametrize("darkening", [0.0, 0.012])
@pytest.mark.parametrize("shadow", [0.0, 0.7])
def test_rim_is_found_through_shadow_and_shading(darkening, shadow):
    """A front that ends within a pixel is found to a thousandth: with a shadow beside it, and with light that fades towards it."""
    camera, lamp = Camera(60, 40, 200.0, 200.0, 29.5, 19.5), np.zeros(3)
    z_front, z_back, ends = 0.6, 0.8, 30.3  # m, m, px: where the front's last light falls
    lamp[0] = -shadow / (camera.fx * (1 / z_front - 1 / z_back))  # throws a shadow of that many pixels
    u = np.arange(camera.width)
    share = np.clip(ends - u + 0.5, 0.0, 1.0)
    lit = np.clip(u + 0.5 - np.maximum(ends + shadow, u - 0.5), 0.0, 1.0)
    k = 4 * np.pi * np.array(HZ)[:, None] / SPEED_OF_LIGHT
    front = 2.0 * np.exp(1j * k * z_front - darkening * (u - ends))
    row = share * front + lit * np.exp(1j * k * z_back)
    phasor = np.repeat(row[:, None], camera.height, axis=1)
    depth = np.tile(np.where(share > 0.5, z_front, z_back), (camera.height, 1))
    rims = lit_rims(phasor, depth, camera, lamp)
    assert len(rims.points) == camera.height
    np.testing.assert_array_equal(rims.outward, np.tile([1.0, 0.0, 0.0], (camera.height, 1)))
    at = camera.project(rims.points)[0][:, 0]
    np.testing.assert_allclose(at, ends, atol=1e-3)
    np.testing.assert_allclose(rims.points[:, 2], z_front, rtol=1e-6)


def test_rims_whose_cut_is_seen_are_dropped():
    """Of a slit's two sides, only that whose cut turns away from both cameras is kept, with its normal across rim and ray."""
    y = np.linspace(-0.1, 0.1, 400)
    normal = poses.rotation_exp([0.0, 0.5, 0.0]) @ [0.0, 0.0, -1.0]
    along = np.cross([0.0, 1.0, 0.0], normal)
    along *= np.sign(along[0])
    side = [
        np.array([0, 0, 0.8]) + k * 0.05 * along + y[:, None] * np.array([0.0, 1.0, 0.0]) for k in (-1, 1)
    ]
    rims = Rims(np.concatenate(side), np.repeat([[1.0, 0, 0], [-1.0, 0, 0]], len(y), axis=0))
    a, b = np.meshgrid(np.linspace(-0.2, 0.2, 60), np.linspace(-0.2, 0.2, 60))
    points = np.array([0, 0, 0.8]) + a.reshape(-1, 1) * along + b.reshape(-1, 1) * np.array([0.0, 1.0, 0.0])
    held = square_rims(rims, Cloud(points, np.tile(normal, (len(points), 1))), np.array([0.05, -0.08, 0.0]))
    receding = side[0] if along[2] > 0 else side[1]
    assert len(held) > 300
    assert np.abs((held.points[:, None] - receding[None, ::20]) @ along).max() < 1e-9
    assert np.abs((held.normals * (held.points - [0.05, -0.08, 0.0])).sum(axis=-1)).max() < 1e-12


def test_jackknife_is_the_covariance_of_a_mean():
    """For a mean it gives the sample covariance over N, widened by Student's t, and the views' departures."""
    x = np.random.default_rng(7).standard_normal((9, 6))
    influence, covariance = jackknife(np.stack([np.delete(x, i, axis=0).mean(axis=0) for i in range(9)]))
    np.testing.assert_allclose(influence, x - x.mean(axis=0))
    np.testing.assert_allclose(covariance, 1.0669**2 * np.cov(x.T) / 9, rtol=1e-3)


def test_halo_lengthens_a_dark_front_before_a_bright_back():
    """Light scattered from a deeper background makes a front too long; a flat image is not changed."""
    k = 4 * np.pi * 100e6 / SPEED_OF_LIGHT
    image = np.full((2, 32, 40), np.exp(1j * k * 0.5))
    assert np.abs(halo_errors(image, HZ)).max() < 1e-9
    image[:, :, 20:] *= 5 * np.exp(1j * k * 0.2)
    assert (halo_errors(image, HZ)[1, :, :15] > 0).all()


def test_unknown_method_is_named():
    """The method's name is checked."""
    assert method_named("joint") == "joint"
    with pytest.raises(ConfigError, match="averaged"):
        method_named("best")


def test_joint_evidence_holds_covariance_and_suggestion():
    """Evidence gains a (6, 6) covariance, eigenvalues and a next view, all JSON numbers."""
    rng = np.random.default_rng(6)
    found = joint_icp([made_view(i, rng, noise=5e-4) for i in range(4)], GUESS)
    evidence = joint_evidence(found, HZ)
    answers.hold("joint", {"evidence": evidence, "T": found.T_tof_stereo}, off=0.05, least=1e-5)
    assert np.array(evidence["covariance"]).shape == (6, 6)
    assert len(evidence["observability"]["eigenvalues"]) == 6
    assert evidence["observability"]["unconstrained"] == []
    assert evidence["observability"]["suggestion"]["tilt_deg"] in (20.0, 30.0, 40.0)
