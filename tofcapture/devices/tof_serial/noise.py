"""A bad link: bytes that are dropped, flipped, doubled, inserted, and packets that are cut short."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class Noise:
    """Damages pieces of a stream.

    Attributes
    ----------
    rng
        Source of damage.
    drop, flip, duplicate, insert
        Chance of each byte to vanish, to have bits flipped, to come twice, to be followed by a random one.
    truncate
        Chance of each byte that it and the rest of its piece never arrive.
    """

    rng: np.random.Generator
    drop: float = 0.0
    flip: float = 0.0
    duplicate: float = 0.0
    insert: float = 0.0
    truncate: float = 0.0

    @classmethod
    def every(cls, rng: np.random.Generator, rate: float) -> Noise:
        """All five kinds at the same rate per byte."""
        return cls(rng, rate, rate, rate, rate, rate)

    def __call__(self, piece: bytes) -> bytes:
        """Damage one piece, usually a packet."""
        rates = (self.drop, self.flip, self.duplicate, self.insert, self.truncate)
        if not piece or not any(rates):
            return piece
        # How many bytes are hit is binomial; which ones and how, uniform and by rate.
        hits = self.rng.binomial(len(piece), min(1.0, sum(rates)))
        if not hits:
            return piece
        out = bytearray(piece)
        places = np.sort(self.rng.choice(len(piece), hits, replace=False))[::-1]
        kinds = self.rng.choice(len(rates), hits, p=np.array(rates) / sum(rates))
        for place, kind in zip(places.tolist(), kinds.tolist(), strict=True):
            self._hit(out, place, kind)
        return bytes(out)

    def _hit(self, out: bytearray, place: int, kind: int) -> None:
        if kind == 0:
            del out[place]
        elif kind == 1:
            out[place] ^= int(self.rng.integers(1, 256))
        elif kind == 2:
            out.insert(place, out[place])
        elif kind == 3:
            out.insert(place + 1, int(self.rng.integers(256)))
        else:
            del out[place:]
