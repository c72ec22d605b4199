"""Light transport and direct light against closed forms."""

import numpy as np
import pytest

from tofcapture.camera import Camera
from tofcapture.devices.sim.light import exact_view, light_at_pixels
from tofcapture.devices.sim.scene import Caster, SceneObject, merge
from tofcapture.devices.sim.transport import Lamp, Transport, cut_patches, direct, wavenumbers
from tofcapture.errors import ConfigError
from tofcapture.ops.phase import radial_to_range, wrapped_range
from tofcapture.poses import rotation_exp, transform

HZ = (20e6, 100e6)
CENTRE = Lamp(np.zeros(3))
CAMERA = Camera(24, 18, 30.0, 30.0, 11.5, 8.5)


def wall(z=1.0, size=4.0, albedo=0.5, tilt=(0.0, 0.0, 0.0), target=True):
    vertices = size * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    triangles = np.array([[0, 2, 1], [0, 3, 2]])
    return SceneObject(vertices, triangles, albedo, transform(rotation_exp(tilt), [0, 0, z]), target)


def ball(radius, centre, albedo, rings=40):
    """A sphere as a latitude-longitude mesh."""
    theta, phi = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    vertices = radius * np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = i * 2 * rings + j, i * 2 * rings + (j + 1) % (2 * rings)
    c, d = a + 2 * rings, b + 2 * rings
    triangles = np.concatenate(
        [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)]
    )
    return SceneObject(vertices, triangles, albedo, transform(np.eye(3), centre))


def render(objects, transport=False, illuminator=(0.007, 0.0, 0.0), **kwargs):
    caster = Caster(merge(objects))
    light = Transport(caster, HZ, 600, 128) if transport else None
    return light_at_pixels(caster, CAMERA, np.eye(4), Lamp(np.array(illuminator)), HZ, light, **kwargs)


def test_direct_light_decodes_to_the_exact_range():
    """Without multipath both frequencies decode a tilted wall to its range within a tenth of a millimetre."""
    objects = [wall(1.0, tilt=(0.3, -0.2, 0.0))]
    depth, _, _ = exact_view(Caster(merge(objects)), CAMERA, np.eye(4))
    expected = radial_to_range(CAMERA.depth_to_radial(depth), CAMERA, np.array([0.007, 0, 0]))
    light = render(objects, subpixels=1)
    for i, hz in enumerate(HZ):
        np.testing.assert_allclose(wrapped_range(light.phasor[i], hz), expected, atol=2e-6)


def test_irradiance_follows_the_cosine_and_inverse_square_law():
    """h = cos / d^2 exp(i k d) at a tilted point, and zero from behind."""
    caster = Caster(merge([wall(2.0)]))
    points = np.array([[0.3, 0.0, 2.0], [0.3, 0.0, 2.0]])
    normals = np.array([[0, 0, -1], [0, 0, 1]], dtype=np.float32)
    k = wavenumbers(HZ)
    h = direct(caster, points, normals, CENTRE, k)
    d = np.hypot(0.3, 2.0)
    np.testing.assert_allclose(h[:, 0], [2.0 / d**3 * np.exp(1j * kk * d) for kk in k], rtol=1e-5)
    assert (h[:, 1] == 0).all()


def test_a_surface_in_the_way_casts_a_shadow():
    """A wall behind another gets no direct light."""
    caster = Caster(merge([wall(1.0, size=0.2), wall(2.0)]))
    h = direct(
        caster,
        np.array([[0.0, 0, 2.0], [1.5, 0, 2.0]]),
        np.array([[0, 0, -1.0]] * 2, np.float32),
        CENTRE,
        (0.0,),
    )
    assert h[0, 0] == 0
    assert abs(h[0, 1]) > 0


@pytest.mark.parametrize("albedo", [0.3, 0.75])
def test_integrating_sphere(albedo):
    """Inside a sphere lit from its centre all bounces sum to E rho g / (1 - rho g), g the mean of exp(ikr) over chords."""
    transport = Transport(Caster(merge([ball(1.0, (0, 0, 0), albedo, 60)])), HZ, 1200, 128)
    inside = transport.solve(CENTRE).reshape(3, -1, 2)[:, :, 1]
    for k, solved in zip(transport.k, inside, strict=True):
        r = np.linspace(0, 2, 20001)
        g = np.trapezoid(r / 2 * np.exp(1j * k * r), r)
        expected = np.exp(1j * k) * albedo * g / (1 - albedo * g)
        assert abs(solved.mean() - expected) < 0.004 * abs(expected) + 1e-3
        assert np.abs(solved - expected).max() < 0.02 * abs(expected) + 5e-3


def test_gather_agrees_with_the_patches():
    """The last bounce by rays meets the same closed form as the patch solution."""
    transport = Transport(Caster(merge([ball(1.0, (0, 0, 0), 0.6, 60)])), HZ, 800, 128)
    solution = transport.solve(CENTRE)
    direction = np.array([[0.6, 0.0, 0.8], [0.0, -0.8, 0.6], [0.36, 0.48, -0.8]])
    h = transport.gather(
        0.998 * direction, -direction.astype(np.float32), CENTRE, solution, 256, np.arange(3)
    )
    np.testing.assert_allclose(
        np.abs(h), np.abs(solution[:, 1::2]).mean(axis=1)[:, None].repeat(3, 1), rtol=0.02
    )


def test_multipath_lengthens_and_grows_with_albedo():
    """In a 90-degree corner the 20 MHz range is too long, more so with a brighter surface."""
    bias = []
    for albedo in (0.2, 0.8):
        a = wall(1.0, 0.5, albedo, tilt=(0, np.pi / 4, 0))
        b = wall(1.0, 0.5, albedo, tilt=(0, -np.pi / 4, 0))
        exact = render([a, b], subpixels=1)
        full = render([a, b], transport=True, subpixels=1, rays=32)
        bias.append(np.median(wrapped_range(full.phasor[0], 20e6) - wrapped_range(exact.phasor[0], 20e6)))
    assert 0 < bias[0] < bias[1] / 3


def test_solution_has_converged():
    """The solution is a fixed point: one more bounce of source plus solution gives the solution back."""
    transport = Transport(Caster(merge([ball(0.5, (0, 0, 0.6), 0.8, 20), wall(1.5, 1.0, 0.8)])), HZ, 300, 64)
    light = Lamp(np.array([0.0, 0.1, 0.5]))
    solution = transport.solve(light)
    source = transport.source(light)
    for matrix, s, h in zip(transport.matrices, source, solution, strict=True):
        again = matrix @ (s + h)
        assert np.abs(again - h).sum() < 2e-4 * (np.abs(h).sum() + np.abs(s).sum())


def test_a_pixel_on_an_edge_mixes_phasors():
    """A pixel half on a near wall and half on a far one holds half of each phasor, so its range lies between."""
    near = SceneObject(
        np.array([[-4.0, -4, 0], [0, -4, 0], [0, 4, 0], [-4, 4, 0]]),
        np.array([[0, 2, 1], [0, 3, 2]]),
        0.5,
        transform(np.eye(3), [0.0, 0, 1.0]),
    )
    camera = Camera(3, 1, 100.0, 100.0, 1.0, 0.0)
    caster = {
        name: Caster(merge(o))
        for name, o in {"both": [near, wall(1.3)], "far": [wall(1.3)], "near": [wall(1.0)]}.items()
    }
    mixed, far, close = (
        light_at_pixels(caster[n], camera, np.eye(4), CENTRE, HZ, None, subpixels=8).phasor[:, 0, 1]
        for n in ("both", "far", "near")
    )
    np.testing.assert_allclose(mixed, (far + close) / 2, rtol=2e-3)


def test_a_narrow_lamp_lights_its_cone_only():
    """Full strength inside the half angle, nothing beyond the edge, falling in between; all round when it is pi."""
    lamp = Lamp(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.5, 0.2)
    angle = np.array([0.0, 0.49, 0.6, 0.71, 3.0])
    towards = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1).astype(np.float32)
    np.testing.assert_allclose(lamp.strength(towards), [1, 1, 0.5, 0, 0], atol=1e-5)
    assert CENTRE.strength(towards) == 1.0


def test_albedo_scales_direct_light_only():
    """Direct phasors are proportional to albedo."""
    a, b = (render([wall(albedo=x)], subpixels=1).phasor for x in (0.2, 0.6))
    np.testing.assert_allclose(b, 3 * a, rtol=1e-5)


def test_every_hit_belongs_to_one_patch_and_areas_add_up():
    """Patches cover the scene's area once; a ray's side depends on where it comes from."""
    geometry = merge([wall(1.0, 1.0), ball(0.2, (0, 0, 0.5), 0.5, 10)])
    patches = cut_patches(geometry, 200, 50)
    edges = geometry.corners[:, 1:] - geometry.corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2
    assert patches.cell_area.sum() == pytest.approx(area, rel=1e-9)
    rng = np.random.default_rng(0)
    d = rng.standard_normal((5000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    caster = Caster(geometry)
    hits = caster.cast(np.array([0.0, 0.0, 0.1]), d)
    side = patches.side_of(geometry, hits, d)
    assert ((side >= 0) == hits.found).all()
    assert side.max() < 2 * patches.count


def test_exact_view_of_a_tilted_plane():
    """Exact depth is the ray-plane intersection to a micrometre, normals face the camera, the target mask follows the flag."""
    plane = wall(1.1, tilt=(0.4, 0.1, 0), target=False)
    depth, normals, target = exact_view(Caster(merge([plane])), CAMERA, np.eye(4))
    n = rotation_exp((0.4, 0.1, 0)) @ [0, 0, 1]
    np.testing.assert_allclose(depth, 1.1 * n[2] / (CAMERA.rays @ n), atol=1e-6)
    assert (np.einsum("ijk,ijk->ij", normals, CAMERA.rays) < 0).all()
    assert not target.any()


def test_an_empty_scene_is_refused():
    """A scene without surfaces says so."""
    with pytest.raises(ConfigError, match="empty"):
        merge([])
