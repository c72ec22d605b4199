"""The module's clock seen from the host: offset by the quickest of several round trips, drift from two of those.

Cristian, "Probabilistic clock synchronization", Distributed Computing 3, 1989: the module read its clock somewhere between
sending and receiving, so half the round trip bounds the error; the quickest round trip has the smallest bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DeviceError

_MOST_DRIFT = 500e-6  # a bad crystal has 100e-6
_SPAN_NS = 2_000_000_000  # below this, drift drowns in the round trip's uncertainty
_LATE_NS = 1_000_000  # a frame may begin this long before the burst was asked for: the clocks' uncertainty


class ClockError(DeviceError):
    """The module's clock jumps or drifts beyond what a crystal does."""


@dataclass(frozen=True)
class Anchor:
    """Both clocks at one moment."""

    host_ns: int  # monotonic
    module_us: int
    error_ns: int  # bound of the error: half the round trip


def anchor(samples: Sequence[tuple[int, int, int]]) -> Anchor:
    """Take the quickest of some round trips ``(sent_ns, module_us, received_ns)``."""
    sent, module, received = min(samples, key=lambda s: s[2] - s[0])
    return Anchor((sent + received) // 2, module, (received - sent + 1) // 2)


def drift(first: Anchor, last: Anchor) -> float:
    """Host seconds per module second minus one; zero while the two are too close to tell."""
    host, module = last.host_ns - first.host_ns, 1000 * (last.module_us - first.module_us)
    if module < max(_SPAN_NS, 20 * (first.error_ns + last.error_ns)):
        return 0.0
    return host / module - 1


def to_host(near: Anchor, rate: float, module_us: int) -> int:
    """Host time (ns) of a module time, from one anchor and the drift; one anchor for a burst keeps its spacing exact."""
    step = 1000 * (module_us - near.module_us)
    return near.host_ns + step + round(step * rate)


def burst_times(anchors: Sequence[Anchor], clocks_us: Sequence[int], period_us: int) -> NDArray[np.int64]:
    """Host times (ns) of a burst's exposures, by the module's clock at the start of each frame and the time between two.

    ``anchors`` are from opening, from before the burst, and from after it.

    Raises :class:`ClockError`: the clock drifts as no crystal's does, or the times do not lie in order within
    the burst.
    """
    first, before, after = anchors
    rate = drift(first, after)
    if abs(rate) > _MOST_DRIFT:
        raise ClockError(
            f"the module's clock runs off by {rate * 1e6:.0f} ppm",
            hint="its clock is not a crystal's, or it jumped",
        )
    near = min(before, after, key=lambda a: a.error_ns)
    times = np.array([to_host(near, rate, clock) for clock in clocks_us], dtype=np.int64)
    low, high = before.host_ns - before.error_ns - _LATE_NS, after.host_ns + after.error_ns + period_us * 1000
    if (np.diff(times) <= 0).any() or times[0] < low or times[-1] > high:
        raise ClockError(
            "the frames' times do not lie in order within the burst", hint="the module's firmware is at fault"
        )
    return times
