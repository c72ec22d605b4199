"""How cameras' bytes lie: for drivers that receive them and for readers of files. Each names where it was read; no camera was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import FormatError

QUARTERS = (0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi)


def unpack_y12p(data: bytes | NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Unpack bytes (3 N) of Y12P, two pixels in three bytes with their high bits first, into (2 N,) values of 12 bits."""
    b = np.frombuffer(data, np.uint8).reshape(-1, 3).astype(np.uint16)
    return np.stack([b[:, 0] << 4 | b[:, 2] & 15, b[:, 1] << 4 | b[:, 2] >> 4], axis=1).reshape(-1)


def with_sign(values: NDArray[np.uint16], bits: int) -> NDArray[np.int16]:
    """Read the low ``bits`` of values as a signed number."""
    half = 1 << (bits - 1)
    return (((values.astype(np.int32) & (2 * half - 1)) ^ half) - half).astype(np.int16)


@dataclass(frozen=True)
class Arducam:
    """Say how the frames of an Arducam ToF module lie, and what their images are.

    From github.com/void-hoge/tofcam (MIT): Y12P, the low eleven bits signed, depth from atan2(I3 - I1, I0 - I2).
    """

    rows: int  #: Of one frame of the camera.
    width: int
    height: int  #: Of an image.
    starts: tuple[int, ...]  #: Rows at which the images of a frame begin.
    frames: int  #: Of the camera that make one of ours.
    modulation_hz: tuple[float, ...]
    phase_rad: tuple[float, ...]

    @property
    def size(self) -> int:
        """Bytes of one frame of the camera."""
        return self.rows * self.width * 3 // 2

    def images(self, data: bytes) -> NDArray[np.int16]:
        """Take one frame of the camera apart into images (n, H, W); :class:`FormatError`: another size."""
        line = self.width * 3 // 2
        stride, rest = divmod(len(data), self.rows)
        if rest or not line <= stride < 2 * line:
            raise FormatError(
                f"expected {self.size} bytes, or rows padded at their ends, got {len(data)}",
                hint="the camera is in another mode",
            )
        lines = np.frombuffer(data, np.uint8).reshape(self.rows, stride)[:, :line]
        pixels = with_sign(unpack_y12p(np.ascontiguousarray(lines)), 11).reshape(self.rows, self.width)
        return np.stack([pixels[start : start + self.height] for start in self.starts])


_FOUR = tuple(480 * k for k in range(4))
_TURNED = (1.5 * np.pi, 0.0, 0.5 * np.pi, np.pi)
ARDUCAM = {
    "b0410": Arducam(180, 240, 180, (0,), 4, (75e6,) * 4, QUARTERS),
    "b0410-far": Arducam(180, 240, 180, (0,), 4, (37.5e6,) * 4, _TURNED),
    "b0548": Arducam(2405, 640, 480, _FOUR, 1, (90e6,) * 4, QUARTERS),
    "b0548-double": Arducam(
        4810, 640, 480, (*_FOUR, *(2405 + r for r in _FOUR)), 1, (90e6,) * 4 + (15e6,) * 4, QUARTERS * 2
    ),
}

_CHIP = 0x5931  # the first word of a header whose bytes are not padded
_HEADER = 160  # bytes
FEMTO_IMAGES = 9


@dataclass(frozen=True)
class FemtoHeader:
    """Say what the header before an image of an Orbbec Femto Bolt or Azure Kinect names.

    From github.com/orbbec/OrbbecSDK_v2, YeatsFrameHdr.h (MIT); its bytes alternate with padding on some hosts.
    """

    shape: tuple[int, int]  #: (H, W) of an image.
    captures: int  #: Images in the frame.
    modulation_hz: float
    phase_rad: float
    celsius: float  #: Of the laser; NaN when it is not written.


@dataclass(frozen=True)
class Femto:
    """Say in which pictures such a camera sends its nine images, and how large an image is."""

    width: int  #: Of the picture, 16 bits a pixel.
    rows: int
    shape: tuple[int, int]  #: (H, W) of an image.

    @property
    def size(self) -> int:
        """Bytes of a picture."""
        return 2 * self.width * self.rows


FEMTO = {"narrow": Femto(7680, 434, (576, 640)), "wide": Femto(8192, 290, (512, 512))}


def femto_frame(data: bytes, shape: tuple[int, int]) -> tuple[NDArray[np.int16], list[FemtoHeader]]:
    """Take a picture apart into nine images (9, H, W) and their headers, or the one header before all."""
    step = _HEADER * (1 if int.from_bytes(data[:2], "little") == _CHIP else 2)
    image = 2 * shape[0] * shape[1]
    each = [k * (step + image) for k in range(FEMTO_IMAGES)]
    if any(data[at:][:2] != data[:2] for at in each) or data[:2] == b"\0\0":
        starts, heads = [step + k * image for k in range(FEMTO_IMAGES)], [0]
    else:
        starts, heads = [at + step for at in each], each
    images = np.stack([np.frombuffer(data, "<i2", image // 2, at).reshape(shape) for at in starts])
    return images, [_femto_header(data[at : at + step]) for at in heads]


def _femto_header(data: bytes) -> FemtoHeader:
    words = np.frombuffer(data[:: len(data) // _HEADER], "<u2").astype(int)
    step, steps = words[50] & 15, max(words[50] >> 4 & 15, 3)
    millis = words[64] | words[65] << 16
    return FemtoHeader(
        shape=(int(words[7]), int(words[6])),
        captures=int(words[49] >> 6 & 63) + 1,
        modulation_hz=1e4 * float(words[53]),
        phase_rad=2 * np.pi * float(step) / float(steps),
        celsius=millis / 1e3 if millis else float("nan"),
    )
