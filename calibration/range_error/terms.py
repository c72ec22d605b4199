"""The terms of a frequency's range error as columns of a linear problem, and their way back into a :class:`RangeError`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.range_error.views import RangeView
from tofcapture.camera import Camera
from tofcapture.ops.phase import radius_px
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT, RangeError, image_places

ORDERS = (1, 2, 4)
IMAGE = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
# One sigma of what a maker's calibration may leave, or a camera without one may have. They only settle what the views do not.
PRIOR_OFFSET = 0.3  # m
PRIOR_SCALE = 0.01
PRIOR_RADIUS = 3e-4  # m / px
PRIOR_IMAGE = 0.005  # m
PRIOR_WAVE = 0.03  # rad; square waves and four taps make 0.071
PRIOR_KELVIN = 5e-4  # m / K
PRIOR_DARK = 0.003  # m at the median amplitude
MIN_KELVIN = 1.0  # K of spread between views below which temperature says nothing
MIN_GREY = 0.35  # of ln A about its fall with range, below which amplitude and range are one


@dataclass(frozen=True)
class Terms:
    """Which terms a frequency's range error has.

    Attributes
    ----------
    camera
        Of the ToF.
    modulation_hz
        The frequency.
    orders
        Of the harmonics.
    warmth, darkness
        Whether the temperature and the amplitude are among them.
    reference_celsius
        Where the temperature's term is zero.
    amplitude
        Median, raw units: scales the prior of the term of dark surfaces.
    """

    camera: Camera
    modulation_hz: float
    orders: tuple[int, ...]
    warmth: bool
    darkness: bool
    reference_celsius: float
    amplitude: float

    @property
    def names(self) -> list[str]:
        """One word per column."""
        waves = [f"{f} {m}" for m in self.orders for f in ("cos", "sin")]
        image = [f"image {i}{j}" for i, j in IMAGE]
        optional = ["temperature"] * self.warmth + ["darkness"] * self.darkness
        return ["offset", "scale", "radius", *image, *waves, *optional]

    @property
    def prior(self) -> Float64:
        """One sigma of each coefficient."""
        wave = PRIOR_WAVE * SPEED_OF_LIGHT / (4 * np.pi * self.modulation_hz)
        own = [PRIOR_OFFSET, PRIOR_SCALE, PRIOR_RADIUS, *[PRIOR_IMAGE] * len(IMAGE)]
        own += [wave] * (2 * len(self.orders))
        return np.array(own + [PRIOR_KELVIN] * self.warmth + [PRIOR_DARK * self.amplitude] * self.darkness)

    def columns(self, view: RangeView, frequency: int) -> Float64:
        """What each coefficient multiplies, (N, T)."""
        place = image_places(self.camera).reshape(-1, 2)[view.pixels]
        radius = radius_px(self.camera).reshape(-1)[view.pixels]
        return self.at(view.true, place, radius, view.celsius, view.amplitude[frequency])

    def at(
        self, range_: Float64, place: Float64, radius: Float64, celsius: float, amplitude: Float64
    ) -> Float64:
        """Columns (N, T) at true ranges (N,), places (N, 2), radii (N,) in pixels and amplitudes (N,)."""
        turned = 4 * np.pi * self.modulation_hz / SPEED_OF_LIGHT * range_
        out = [np.ones_like(range_), range_, radius]
        out += [place[:, 0] ** i * place[:, 1] ** j for i, j in IMAGE]
        out += [f(m * turned) for m in self.orders for f in (np.cos, np.sin)]
        if self.warmth:
            out.append(np.full_like(range_, celsius - self.reference_celsius))
        if self.darkness:
            out.append(1 / amplitude)
        return np.stack(out, axis=-1)

    def added(self, factory: RangeError, x: Float64) -> RangeError:
        """Sum of the maker's range error and the coefficients (T,)."""
        found = dict(zip(self.names, x.tolist(), strict=True))
        waves = {m: (a, b) for m, a, b in factory.harmonics}
        for m in self.orders:
            a, b = waves.get(m, (0.0, 0.0))
            waves[m] = a + found[f"cos {m}"], b + found[f"sin {m}"]
        image = {(i, j): c for i, j, c in factory.image}
        for i, j in IMAGE:
            image[i, j] = image.get((i, j), 0.0) + found[f"image {i}{j}"]
        return replace(
            factory,
            offset=factory.offset + found["offset"],
            scale=factory.scale + found["scale"],
            per_pixel_radius=factory.per_pixel_radius + found["radius"],
            per_kelvin=factory.per_kelvin + found.get("temperature", 0.0),
            per_inverse_amplitude=factory.per_inverse_amplitude + found.get("darkness", 0.0),
            harmonics=tuple((m, a, b) for m, (a, b) in sorted(waves.items())),
            image=tuple((i, j, c) for (i, j), c in sorted(image.items())),
        )


def warmed(views: Sequence[RangeView]) -> float:
    """Standard deviation of the views' temperatures, kelvin; 0 when the camera does not say."""
    celsius = np.array([v.celsius for v in views])
    return float(celsius.std()) if np.isfinite(celsius).all() else 0.0


def greys(views: Sequence[RangeView], frequency: int) -> float:
    """Spread of ln A about its fall with range: what tells a term of amplitude from one of range."""
    level = np.concatenate([np.log(v.amplitude[frequency]) for v in views])
    far = np.log(np.concatenate([v.true for v in views]))
    fall = np.polyfit(far, level, 2)
    return float(np.std(level - np.polyval(fall, far)))
