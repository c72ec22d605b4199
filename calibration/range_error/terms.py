"""The terms of a frequency's range error as columns of a linear problem, and their way back into a :class:`RangeError`.

The joint alignment and ``calibrate range`` choose from one set of terms, by name: ``offset``, ``scale``, ``radius``, ``image 11``
(the powers of x and y), ``cos 2`` and ``sin 2`` (the order), ``temperature`` and ``darkness``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.poses import Float64
from tofcapture.rig import RangeError

ORDERS = (1, 2, 4)  # the slow first one and the even orders of a square-wave light
IMAGE = ("image 10", "image 01", "image 20", "image 11", "image 02")
WAVES = {"cos": np.cos, "sin": np.sin}


def waves(orders: Sequence[int]) -> tuple[str, ...]:
    """Name the terms of harmonics."""
    return tuple(f"{f} {m}" for m in orders for f in WAVES)


SIMPLE = ("offset", "radius", *waves(ORDERS))  # what is found together with a rig transform


@dataclass(frozen=True)
class Terms:
    """Name the T terms of one frequency's range error."""

    modulation_hz: float
    names: tuple[str, ...] = SIMPLE  #: In the order of the columns
    reference_celsius: float = RangeError.reference_celsius  #: Where the temperature's term is zero

    def columns(
        self,
        range_: Float64,
        radius_px: Float64,
        place: Float64 | None = None,
        celsius: float = np.nan,
        amplitude: Float64 | None = None,
    ) -> Float64:
        """Say what each coefficient multiplies.

        The true ranges (N,), half the path of the light, are in metres, ``radius_px`` (N,) is the distance to the principal point, pixels.
        ``place`` (N, 2) of :func:`tofcapture.rig.image_places` serves terms over the image, ``celsius`` that of the sensor's temperature,
        ``amplitude`` (N,), raw units, that of dark surfaces. The answer is (N, T) float64.
        """
        phase = 4 * np.pi * self.modulation_hz / SPEED_OF_LIGHT * range_
        out = []
        for name in self.names:
            kind, _, index = name.partition(" ")
            if kind in WAVES:
                out.append(WAVES[kind](int(index) * phase))
            elif kind == "image" and place is not None:
                out.append(place[:, 0] ** int(index[0]) * place[:, 1] ** int(index[1]))
            elif kind == "darkness" and amplitude is not None:
                out.append(1 / amplitude)
            elif kind == "temperature":
                out.append(np.full_like(range_, celsius - self.reference_celsius))
            else:
                out.append({"offset": np.ones_like(range_), "scale": range_, "radius": radius_px}[kind])
        return np.stack(out, axis=-1)

    def added(self, error: RangeError, x: Float64) -> RangeError:
        """Add coefficients (T,) to a range error, term by term; what was not fitted stays."""
        found = dict(zip(self.names, x.tolist(), strict=True))
        harmonics = {m: [a, b] for m, a, b in error.harmonics}
        image = {(i, j): c for i, j, c in error.image}
        for name, value in found.items():
            kind, _, index = name.partition(" ")
            if kind in WAVES:
                harmonics.setdefault(int(index), [0.0, 0.0])[list(WAVES).index(kind)] += value
            elif kind == "image":
                powers = int(index[0]), int(index[1])
                image[powers] = image.get(powers, 0.0) + value
        return replace(
            error,
            offset=error.offset + found["offset"],
            scale=error.scale + found.get("scale", 0.0),
            per_pixel_radius=error.per_pixel_radius + found.get("radius", 0.0),
            per_kelvin=error.per_kelvin + found.get("temperature", 0.0),
            per_inverse_amplitude=error.per_inverse_amplitude + found.get("darkness", 0.0),
            harmonics=tuple((m, a, b) for m, (a, b) in sorted(harmonics.items())),
            image=tuple((i, j, c) for (i, j), c in sorted(image.items())),
        )


def jackknife(left_out: Float64) -> tuple[Float64, Float64]:
    """Say what leaving views out says of a result.

    ``left_out`` (N, K) are results without each of the views in turn; transforms as twists from any fixed one near them.

    Returns the influence (N, K), how far each view alone departs from all: Tukey's pseudo-values about their mean. Then the covariance
    (K, K), widened by Student's t so that one sigma holds 68 % of the time however few the views are.
    """
    from scipy.stats import norm, t

    n = len(left_out)
    influence: Float64 = (n - 1) * (left_out.mean(axis=0) - left_out)
    widened = float(t.ppf(norm.cdf(1.0), n - 1)) ** 2
    return influence, widened * influence.T @ influence / (n * (n - 1))
