"""The noise of a tap, measured from bursts."""

from __future__ import annotations

import numpy as np
import pytest

from tofcapture.errors import DataError
from tofcapture.ops.phase import photon_transfer


def burst(frames, electrons, read, low=20.0, high=3000.0, seed=0, shape=(8, 90, 120)):
    """Frames of a still scene of all brightnesses, rounded as a sensor rounds."""
    rng = np.random.default_rng(seed)
    clean = rng.uniform(low, high, shape)
    taps = rng.poisson(np.broadcast_to(clean, (frames, *shape)) * electrons) / electrons
    return np.rint(taps + read * rng.standard_normal(taps.shape))


@pytest.mark.parametrize("frames", [2, 10])
@pytest.mark.parametrize(("electrons", "read"), [(16.0, 1.25), (2.0, 4.0), (60.0, 0.8)])
def test_gain_and_read_noise_are_found(frames, electrons, read):
    """From two frames as from ten, over a factor of thirty in gain; rounding is not taken for electronics."""
    found = photon_transfer([burst(frames, electrons, read)], 4095)
    assert found.electrons_per_unit == pytest.approx(electrons, rel=0.05)
    assert found.read == pytest.approx(read, rel=0.12)


def test_saturated_hot_and_moving_taps_do_not_count():
    """Half a percent of the pixels flickers by a hundred units, a tenth saturates."""
    taps = burst(10, 16.0, 1.25)
    rng = np.random.default_rng(1)
    hot = rng.random(taps.shape[1:]) < 0.005
    taps[:, hot] += rng.normal(0, 100, (10, hot.sum()))
    taps[:, rng.random(taps.shape[1:]) < 0.1] = 4095
    found = photon_transfer([taps], 4095)
    assert found.electrons_per_unit == pytest.approx(16, rel=0.1)
    assert found.read == pytest.approx(1.25, rel=0.2)


def test_several_bursts_are_one_measurement():
    """A dark one and a bright one make a line, where each alone has hardly a slope."""
    found = photon_transfer([burst(10, 16.0, 1.25, 20, 60), burst(10, 16.0, 1.25, 2500, 3000, seed=2)], 4095)
    assert found.electrons_per_unit == pytest.approx(16, rel=0.03)


def test_noise_that_does_not_grow_has_no_electrons():
    """Read noise alone: infinite electrons per unit, whose shot noise is none."""
    rng = np.random.default_rng(0)
    clean = rng.uniform(100, 3000, (8, 40, 40))
    found = photon_transfer([np.rint(clean + 3 * rng.standard_normal((10, *clean.shape)))], 4095)
    assert found.read == pytest.approx(3, rel=0.05)
    assert found.electrons_per_unit > 1000


def test_what_tells_nothing_is_refused():
    """Single frames, and bursts that are saturated."""
    with pytest.raises(DataError, match="two frames"):
        photon_transfer([burst(1, 16.0, 1.25)], 4095)
    with pytest.raises(DataError, match="below saturation"):
        photon_transfer([np.full((5, 8, 20, 20), 4095)], 4095)
    with pytest.raises(DataError, match="got 0"):
        photon_transfer([], 4095)
