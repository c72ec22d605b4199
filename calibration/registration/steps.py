"""Steps: where a ToF image of any scene jumps in depth, against where a known surface says that it should.

Light between surfaces bends a ToF camera's depth by millimetres, smoothly, and never moves a silhouette. About each silhouette the
image is taken to be two surfaces, front and back, whose borders the known surface gives to a fraction of a pixel, with the front's
shadow between them. The brightness of each is free: what its slope to the light says, times a linear complex polynomial. Only the
border's place is left to explain what does not fit (variable projection), so that no depth enters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Mask
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.frames import TofBurst
from tofcapture.ops import phase
from tofcapture.poses import Float64

Complex128 = NDArray[np.complex128]
Index = NDArray[np.intp]

FINE = 6  # samples of the surface along a ToF pixel
HALF = 3  # px on either side of a patch's middle
SIDE = 2 * HALF + 1
FREE = 3  # coefficients of a surface's brightness: constant, along, down
JUMP = 0.012  # m of depth, least
EVERY = 3  # px between patches along a rim
BENT = (0.05, 0.02)  # m by which front and back may depart from planes
HOLES = 0.4  # of a patch that may be unknown
LEAST = 0.15  # of a patch that front and back must fill
SHADOW = 0.008  # m that a shadow is behind what throws it
UNMODELLED = 0.01  # of the brightest, what a patch's residuals are at least
RIDGE = 5e-5
SLOPE = 2  # fine pixels, of the differences that slopes are taken from, and
SMOOTH = 7  # of the window that averages them
DARKEST = 0.02  # cosine; slopes are not known better
SHIFTS = 5  # px, farthest that a start may be off


@dataclass(frozen=True)
class Phasors:
    """A burst, freed of the factory's range errors."""

    image: Complex128  #: (F, H, W) raw units
    noise: Float64  #: (F,) of one component, raw units
    wavenumber: Float64  #: (F,) radians per metre of range
    camera: Camera
    illuminator: Float64  #: (3,) ToF frame, metres


@dataclass(frozen=True)
class Steps:
    """What N patches say of the place of their step, as normal equations of its displacement in the image."""

    pixel: Float64  #: (N, 2) u and v
    outward: Float64  #: (N, 2) unit, from front to back
    front: Float64  #: (N,) depth of the front, metres
    back: Float64  #: (N,) depth behind it
    information: Float64  #: (N, 2, 2) 1 / px^2
    gradient: Float64  #: (N, 2) 1 / px
    misfit: Float64  #: (N,) squared residual over that expected

    def __len__(self) -> int:
        return len(self.front)

    def __getitem__(self, which: Mask) -> Steps:
        return Steps(*(getattr(self, f.name)[which] for f in fields(self)))

    @staticmethod
    def joined(parts: Iterable[Steps]) -> Steps:
        """Put the steps of several images behind each other."""
        given = list(parts)
        return Steps(*(np.concatenate([getattr(p, f.name) for p in given]) for f in fields(Steps)))


@dataclass(frozen=True)
class _Patches:
    """Cut-outs of a fine depth image, one fine pixel wider than ``SIDE`` ToF pixels all round."""

    at: Index  # (N, 2) row and column of the middle pixel
    depth: Float64  # (N, M, M)
    front: Mask  # (N, M, M)
    lit_back: Mask  # (N, M, M)
    whole: Float64  # (N, SIDE^2) one where a ToF pixel is known all over
    near: Float64  # (N,) depths beside the largest jump of the middle
    far: Float64


def phasors_of(burst: TofBurst) -> Phasors:
    """Average a burst and take the factory's range errors off its phases."""
    info = burst.info
    _, signals = phase.Decoder(info).signals(
        burst.raw.mean(axis=0, dtype=np.float64), float(np.mean(burst.celsius))
    )
    hz = np.asarray(phase.frequencies(info.modulation_hz))
    k = 4 * np.pi * hz / SPEED_OF_LIGHT
    amplitude = np.hypot(signals.phasor[:, 0], signals.phasor[:, 1]).astype(np.float64)
    image = np.nan_to_num(amplitude * np.exp(1j * k[:, None, None] * signals.ranges))
    each = phase.phasors(burst.raw, info.modulation_hz, info.phase_rad, offset=info.offset)
    noise = np.zeros(len(hz))
    if len(each) > 1:
        noise = np.sqrt(np.median(each.var(axis=0, ddof=1) / 2, axis=(-1, -2)) / len(each))
    return Phasors(image, noise, k, info.camera, info.illuminator)


def measure_steps(seen: Phasors, depth: Float64) -> Steps:
    """Compare a burst with a surface: ``depth`` (H FINE, W FINE), metres, of the ToF camera scaled by ``FINE``, NaN unknown."""
    patches = _patches(seen, depth)
    n, designs = len(patches.at), _Designs(patches, seen)
    information, gradient = np.zeros((n, 2, 2)), np.zeros((n, 2))
    squared = np.zeros(n)
    for f in range(len(seen.image)):
        y, sigma = _window(seen, f, patches)
        A, solve = designs.solver(f)
        free = solve(y)
        residual = y - (A @ free[..., None])[..., 0]
        steps = [(designs.at(f, *-np.array(d)) - designs.at(f, *d)) * (FINE / 2) for d in ((0, 1), (1, 0))]
        J = np.stack([(s @ free[..., None])[..., 0] for s in steps], axis=-1) * patches.whole[..., None]
        J -= A @ np.stack([solve(J[..., 0]), solve(J[..., 1])], axis=-1)
        Jh = J.conj().swapaxes(1, 2)
        information += (Jh @ J).real / sigma[:, None, None] ** 2
        gradient += (Jh @ residual[..., None]).real[..., 0] / sigma[:, None] ** 2
        squared += np.square(np.abs(residual)).sum(axis=1) / sigma**2
    expected = 2 * len(seen.image) * np.maximum(patches.whole.sum(axis=1) - 2 * FREE, 1)
    pixel, outward = _borders(patches)
    return Steps(pixel, outward, patches.near, patches.far, information, gradient, squared / expected)


def misfits_of_shifts(seen: Phasors, depth: Float64) -> Float64:
    """Sum the logarithms of all patches' squared residuals over those of one smooth surface, where the image lies whole pixels off.

    The answer (2 SHIFTS + 1, 2 SHIFTS + 1) is over shifts down and to the right; ``depth`` as of :func:`measure_steps`.
    """
    patches = _patches(seen, depth, SHIFTS)
    out = np.zeros((2 * SHIFTS + 1, 2 * SHIFTS + 1))
    if not len(patches.at):
        return out
    designs = _Designs(patches, seen)
    solvers = [designs.solver(f) for f in range(len(seen.image))]
    y, x = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j].reshape(2, -1)
    smooth = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=-1))[0]
    for down in range(-SHIFTS, SHIFTS + 1):
        for right in range(-SHIFTS, SHIFTS + 1):
            left = np.full((2, len(patches.at)), float(SIDE))
            for f, (A, solve) in enumerate(solvers):
                z, sigma = _window(seen, f, patches, down, right)
                for k, fit in enumerate(((A @ solve(z)[..., None])[..., 0], z @ smooth @ smooth.T)):
                    left[k] += np.square(np.abs(z - fit)).sum(axis=1) / sigma**2
            out[down + SHIFTS, right + SHIFTS] = np.log(left[0] / left[1]).sum()
    return out


class _Designs:
    """What each free coefficient adds to the pixels of each patch, where the border is and a fine pixel beside it."""

    def __init__(self, patches: _Patches, seen: Phasors) -> None:
        self._patches, self._seen = patches, seen
        u, v = _places(patches)
        ray = _rays(seen.camera, u, v)
        radial = patches.depth * np.linalg.norm(ray, axis=-1)
        self._path = radial - patches.near[:, None, None]
        shade = _shading(patches, ray, seen)
        x, y = ((p - p.mean(axis=(1, 2), keepdims=True)) / HALF for p in (u, v))
        masks = patches.front * shade, patches.lit_back * shade
        self._shares = [mask * basis for mask in masks for basis in (np.ones_like(x), x, y)]

    def at(self, f: int, down: int, right: int) -> Complex128:
        """Coefficients' images (N, SIDE^2, 2 FREE) of frequency f, the surface seen fine pixels further down and right."""
        turned = np.exp(1j * self._seen.wavenumber[f] * self._path)
        n, wide = len(turned), SIDE * FINE
        part = np.s_[:, 1 + down : 1 + down + wide, 1 + right : 1 + right + wide]
        images = [
            (s * turned)[part].reshape(n, SIDE, FINE, SIDE, FINE).mean(axis=(2, 4)) for s in self._shares
        ]
        return np.stack([i.reshape(n, SIDE**2) for i in images], axis=-1)

    def solver(self, f: int) -> tuple[Complex128, Callable[[Complex128], Complex128]]:
        """Images of known pixels (N, SIDE^2, 2 FREE), and what fits them to values (N, SIDE^2)."""
        A = self.at(f, 0, 0) * self._patches.whole[..., None]
        Ah = A.conj().swapaxes(1, 2)
        inverse = np.linalg.inv(Ah @ A + RIDGE * np.eye(2 * FREE)) if len(A) else np.zeros((0, 6, 6))
        return A, lambda y: (inverse @ (Ah @ y[..., None]))[..., 0]


def _window(
    seen: Phasors, f: int, patches: _Patches, down: int = 0, right: int = 0
) -> tuple[Complex128, Float64]:
    """Known pixels (N, SIDE^2) of the patches, zero elsewhere, and what their residuals are (N,)."""
    step = np.arange(-HALF, HALF + 1)
    rows = patches.at[:, 0, None, None] + step[:, None] + down
    y = (
        seen.image[f][rows, patches.at[:, 1, None, None] + step + right].reshape(len(rows), SIDE**2)
        * patches.whole
    )
    return y, np.hypot(seen.noise[f], UNMODELLED * np.abs(y).max(axis=1, initial=1e-9))


def _patches(seen: Phasors, depth: Float64, margin: int = 0) -> _Patches:
    """Cut patches out about all steps where one smooth front ends before one smooth back."""
    at = _stepping(depth, HALF + 1 + margin)
    wide = SIDE * FINE + 2
    rows = (at[:, 0, None] - HALF) * FINE - 1 + np.arange(wide)
    columns = (at[:, 1, None] - HALF) * FINE - 1 + np.arange(wide)
    cut = depth[rows[:, :, None], columns[:, None, :]]
    hole = ~np.isfinite(cut)
    middle = np.s_[:, wide // 2 - FINE : wide // 2 + FINE, wide // 2 - FINE : wide // 2 + FINE]
    good = (hole.mean(axis=(1, 2)) < HOLES) & ~hole[middle].any(axis=(1, 2))
    at, cut, hole, rows, columns = (a[good] for a in (at, cut, hole, rows, columns))
    if not len(at):
        nothing = np.zeros((0, wide, wide))
        return _Patches(
            at, nothing, nothing > 0, nothing > 0, np.zeros((0, SIDE**2)), np.zeros(0), np.zeros(0)
        )
    inverse = 1 / cut
    ordered = np.sort(inverse[middle].reshape(len(at), -1), axis=1)
    gap, each = np.diff(ordered, axis=1).argmax(axis=1), np.arange(len(at))
    near, far = 1 / ordered[each, gap + 1], 1 / ordered[each, gap]
    front = inverse > ((1 / near + 1 / far) / 2)[:, None, None]
    good = far - near > JUMP
    for mask, edge, limit in zip((front, ~front & ~hole), (near, far), BENT, strict=True):
        bent, filled = _departure(np.where(hole, 0, inverse), mask & ~hole)
        good &= (bent * edge**2 < limit) & (filled > LEAST)
    lit = _lit(depth, seen)[rows[:, :, None], columns[:, None, :]]
    whole = ~hole[:, 1:-1, 1:-1].reshape(-1, SIDE, FINE, SIDE, FINE).any(axis=(2, 4)).reshape(len(at), -1)
    known = np.where(hole, near[:, None, None], cut)
    return _Patches(
        at[good], known[good], front[good], (~front & lit)[good], whole[good].astype(np.float64), near[good], far[good]
    )  # fmt: skip


def _stepping(depth: Float64, margin: int) -> Index:
    """Rows and columns (N, 2) of ToF pixels that hold a step, some way apart and off the image's border."""
    edge = np.zeros(depth.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        edge[:, 1:] |= np.abs(np.diff(depth, axis=1)) > JUMP
        edge[1:] |= np.abs(np.diff(depth, axis=0)) > JUMP
    h, w = (s // FINE for s in depth.shape)
    some = edge.reshape(h, FINE, w, FINE).sum(axis=(1, 3)) >= FINE // 2
    some[:margin], some[h - margin :], some[:, :margin], some[:, w - margin :] = (False,) * 4
    at: Index = np.argwhere(some)
    return np.asarray(at[at.sum(axis=1) % EVERY == 0])


def _departure(inverse: Float64, mask: Mask) -> tuple[Float64, Float64]:
    """Most by which inverse depths (N, M, M) depart from a plane where the mask says (N,), 1/m, and the share of it (N,)."""
    n, wide = len(inverse), inverse.shape[-1]
    y, x = np.mgrid[:wide, :wide].reshape(2, -1) / wide - 0.5
    X, w, z = np.stack([np.ones_like(x), x, y], axis=-1), mask.reshape(n, -1), inverse.reshape(n, -1)
    H = np.einsum("pi,np,pj->nij", X, w, X, optimize=True) + 1e-9 * np.eye(3)
    fit = np.linalg.solve(H, ((z * w) @ X)[..., None])[..., 0] @ X.T
    return (np.abs(z - fit) * w).max(axis=1), w.mean(axis=1)


def _lit(depth: Float64, seen: Phasors) -> Mask:
    """Tell which fine pixels the illuminator reaches, of what the camera sees."""
    camera, (x, y, _) = seen.camera.scaled(FINE), seen.illuminator
    h, w = depth.shape
    z = np.where(np.isfinite(depth), depth, np.inf)
    v, u = np.mgrid[:h, :w]
    u = np.clip(np.rint(u - camera.fx * x / z), 0, w - 1).astype(np.intp)
    v = np.clip(np.rint(v - camera.fy * y / z), 0, h - 1).astype(np.intp)
    nearest = np.full((h, w), np.inf)
    np.minimum.at(nearest, (v, u), z)
    return np.asarray(~(nearest[v, u] < z - SHADOW))


def _places(patches: _Patches) -> tuple[Float64, Float64]:
    """Image coordinates u and v (N, M, M) of the fine pixels."""
    step = (np.arange(patches.depth.shape[-1]) - 1 + 0.5) / FINE - 0.5 - HALF
    v, u = (patches.at[:, k, None] + step for k in (0, 1))
    shape = patches.depth.shape
    return np.broadcast_to(u[:, None, :], shape), np.broadcast_to(v[:, :, None], shape)


def _rays(camera: Camera, u: Float64, v: Float64) -> Float64:
    return camera.rays_at(np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(*u.shape, 3)


def _shading(patches: _Patches, ray: Float64, seen: Phasors) -> Float64:
    """Brightness (N, M, M) that the slope to the illuminator and its distance give each surface, about one."""
    from scipy.ndimage import uniform_filter

    inverse, out = 1 / patches.depth, np.ones_like(patches.depth)
    for mask in (patches.front, ~patches.front):
        slopes = []
        for axis, focal in ((2, seen.camera.fx), (1, seen.camera.fy)):
            difference = np.roll(inverse, -SLOPE, axis) - np.roll(inverse, SLOPE, axis)
            good = mask & np.roll(mask, -SLOPE, axis) & np.roll(mask, SLOPE, axis)
            good &= np.abs(difference) * patches.near[:, None, None] ** 2 < 0.02
            ends = np.moveaxis(good, axis, 0)
            ends[:SLOPE], ends[-SLOPE:] = False, False
            some = np.where(good, difference, 0)
            window = (0, SMOOTH, SMOOTH)
            share = uniform_filter(good.astype(np.float64), window, mode="nearest")
            local = uniform_filter(some, window, mode="nearest") / np.maximum(share, 1e-6)
            overall = some.sum(axis=(1, 2)) / np.maximum(good.sum(axis=(1, 2)), 1)
            slopes.append(np.where(share > 0.1, local, overall[:, None, None]) * FINE * focal / (2 * SLOPE))
        m = np.stack([*slopes, inverse - slopes[0] * ray[..., 0] - slopes[1] * ray[..., 1]], axis=-1)
        towards = seen.illuminator - patches.depth[..., None] * ray
        distance = np.linalg.norm(towards, axis=-1)
        cosine = -(m * towards).sum(axis=-1) / np.linalg.norm(m, axis=-1) / distance
        out = np.where(mask, np.maximum(cosine, DARKEST) * (patches.near[:, None, None] / distance) ** 2, out)
    return out


def _borders(patches: _Patches) -> tuple[Float64, Float64]:
    """Where the border crosses the patches' middles, (N, 2) pixels, and its direction (N, 2) from front to back."""
    u, v = _places(patches)
    places = np.stack([u, v], axis=-1)
    area = np.maximum(patches.front.sum(axis=(1, 2)), 1)[:, None]
    outward = places.mean(axis=(1, 2)) - (places * patches.front[..., None]).sum(axis=(1, 2)) / area
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    half = patches.depth.shape[-1] // 2
    middle = np.s_[:, half - FINE : half + FINE, half - FINE : half + FINE]
    inside = patches.front[middle]
    border = np.zeros(inside.shape, dtype=bool)
    border[:, :, :-1] |= inside[:, :, :-1] != inside[:, :, 1:]
    border[:, :-1] |= inside[:, :-1] != inside[:, 1:]
    count = np.maximum(border.sum(axis=(1, 2)), 1)[:, None]
    return (places[middle] * border[..., None]).sum(axis=(1, 2)) / count, outward
