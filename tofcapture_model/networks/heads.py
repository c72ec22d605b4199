"""The parts of the networks: what they read, the three heads, the refinement.

Every head answers at twice the resolution. Depth starts as the decoded ToF depth, the paper's normals towards the camera,
compact's as those of planes fitted to the depth. So an untrained model that sees the decoded depth is the sensor, and
training can only be judged by what it adds.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.config import SOURCES, Network
from tofcapture_model.frame import Frame, eight_taps
from tofcapture_model.geometry.maps import (
    depth_to_normals,
    doubled_parts,
    local_planes,
    plane_normals,
    propagate_depth,
    rays,
    side_window_planes,
    unit,
)
from tofcapture_model.geometry.multipath import usual_phasor
from tofcapture_model.networks.unet import (
    CONVEX_CHANNELS,
    bilinear_logits,
    convex_upsample,
    double_conv,
    he_initialised,
)

# what one may expect of each cue: most lenses scatter about one percent; the fifth is no error of the depth, but a gap
CUE_SCALE = (1.0, 1.0, 0.01, 0.3, 1.0)
CORRECTIONS = 4  # cues that are errors of the depth
RESIDUAL_UNIT = 0.01  # m; a head's output of 1 moves the depth by a centimetre
# m; where depth starts, and a head's unit, where the decoded depth is not to be seen
MIDDLE, REACH = (0.8, 0.4)
FIT_RADII = (1, 2)  # px of the sensor, of the planes that compact fits to its own depth
_HEAD_WIDTH = 24
_HOLE = 1e-3  # weight of a filled pixel
_PHASOR_FLOOR = 1e-4  # SIGNAL is 0.04; below it an amplitude is noise
_LEAST_REACH, _NO_LIMIT = 0.001, 0.5  # m
_ANYTHING = 6e4  # float16 holds it
_TAIL = 1e-3  # of a channel's values that count as strange in training
_MARGIN = 0.25  # of its range that is allowed beyond
_SOFT, _LEAST_SOFT = (
    0.1,
    0.05,
)  # of its range, and of the unit: from there on beyond, a channel is all strange
# channels that tell where a pixel is and whether it was measured: training on crops never sees all of them
_WHERE = slice(13, 16)
_MIN_ERROR = 1e-3  # m; the same floor as in eq. 1
_GAIN_UNIT = 5.0  # gains learn at the pace of the weights of a layer, which move by much less than 1


class Features(NamedTuple):
    """Hold what the heads read."""

    image: Tensor  #: (B, C, H, W) for the convolutions, about unit scale
    candidates: Tensor  #: (B, K, H, W) classically denoised or corrected depths, m; K may be 0
    reach: Tensor | None  #: (B, 1, H, W) m by which physics lets the depth be wrong, or None: by anything
    trust: Tensor | None  #: (B, 1, H, W) 1 where all that is read is like what was learned from, 0 where not
    normals: Tensor  #: (B, 3, H, W) unit normals to start from
    rays: Tensor  #: (B, 3, H, W) of the sensor's pixels, z = 1; a lens takes some time to invert


class PaperInputs(nn.Module):
    """Stack the paper's inputs in their order: 8 raw channels, confidence, decoded depth; 10 channels in all."""

    def __init__(self, sources: tuple[str, ...]) -> None:
        super().__init__()
        self.sources = sources
        self.channels = sum(SOURCES[s] for s in sources)

    def forward(self, frame: Frame) -> Features:
        """Take the chosen sources of a frame; normals start towards the camera."""
        taken = {"raw": eight_taps(frame)[0], "confidence": frame.confidence, "depth": frame.depth}
        image = torch.cat([taken[s] for s in self.sources], dim=1)
        r = rays(frame.intrinsics, *frame.depth.shape[-2:])
        return Features(image, frame.depth[:, :0], None, None, -unit(r), r)


class CompactInputs(nn.Module):
    """Compute what physics says matters and any camera has: reflectances, the frequencies and their gap, cues, plane fits.

    Lamp, gain and contrast are divided out (``Frame.light``): a network cannot tell a camera by them.
    """

    def __init__(self, windows: tuple[int, ...]) -> None:
        super().__init__()
        self.windows = windows
        self.channels = 11 + len(CUE_SCALE) + 4 * len(windows)
        self.register_buffer("cue_scale", torch.tensor(CUE_SCALE).reshape(1, -1, 1, 1), persistent=False)
        self.cue_scale: Tensor
        ends = torch.tensor([-_ANYTHING, _ANYTHING])
        self.register_buffer("familiar", ends[:, None].repeat(1, self.channels))
        self.familiar: Tensor  #: (2, C) least and largest value of each channel in training
        judged = torch.ones(1, self.channels, 1, 1)
        judged[:, _WHERE] = 0
        self.register_buffer("judged", judged, persistent=False)
        self.judged: Tensor

    def remember(self, images: Iterable[Tensor]) -> None:
        """Take the range of each channel over images (B, C, H, W) that were learned from, and what was taken before."""
        tails = torch.tensor([_TAIL, 1 - _TAIL])
        seen = torch.stack(
            [torch.quantile(x.float().cpu().transpose(0, 1).flatten(1), tails, dim=1) for x in images]
        )
        low, high = seen[:, 0].amin(0), seen[:, 1].amax(0)
        margin = _MARGIN * (high - low)
        found = torch.stack([low - margin, high + margin]).to(self.familiar)
        nothing = self.familiar.abs() >= _ANYTHING  # no knowledge, which widens nothing
        before = torch.where(nothing, found, self.familiar)
        self.familiar[0] = torch.minimum(found[0], before[0])
        self.familiar[1] = torch.maximum(found[1], before[1])

    @torch.no_grad()
    def forward(self, frame: Frame) -> Features:
        """Compute features; nothing here is learned."""
        r = rays(frame.intrinsics, *frame.depth.shape[-2:])
        planes = [side_window_planes(frame.depth, frame.valid + _HOLE, w) for w in self.windows]
        smooth = [1 / c[:, :1].clamp_min(1e-2) for c, _ in planes]
        normals = [plane_normals(c, frame.intrinsics, r) for c, _ in planes]
        channels = [
            *_reflectances(usual_phasor(frame)),
            *_frequencies(frame),
            (frame.depth - MIDDLE) / REACH,
            (frame.gap * 10).clamp(-2, 2),  # 20 MHz is noisy by centimetres
            (frame.cues * self.cue_scale * 100).clamp(-2, 2),  # multipath costs up to some cm
            frame.valid,
            r[:, :2],
            *((s - frame.depth).mul(50).clamp(-2, 2) for s in smooth),  # noise is some mm
            *((var.sqrt() * 50).clamp(0, 2) for _, var in planes),
            *((n[:, :2]) for n in normals),
        ]
        errors = frame.cues[:, :CORRECTIONS] * self.cue_scale[:, :CORRECTIONS]
        candidates = torch.cat([*smooth, frame.depth - errors], 1)
        reach = _reach(frame, errors, planes[0][1].sqrt() * frame.depth.square())
        image = torch.cat(channels, 1)
        return Features(image, candidates, reach, self._trust(image), normals[len(normals) // 2], r)

    def _trust(self, image: Tensor) -> Tensor:
        """Tell where every channel is within what was learned from, (B, 1, H, W); a few strangers are noise.

        It fades beyond the bounds: at a step, the rounding of a backend would decide.
        """
        if self.training:
            return torch.ones_like(image[:, :1])
        low, high = self.familiar[:, None, :, None, None]
        beyond = torch.maximum(low - image, image - high) / (_SOFT * (high - low) + _LEAST_SOFT)
        strange = (self.judged * beyond).clamp(0, 1).amax(1, keepdim=True)
        near = F.avg_pool2d(strange, 5, 1, 2, count_include_pad=False)
        return 1 - (4 * near).clamp_max(1.0)


def _reflectances(phasor: Tensor) -> list[Tensor]:
    """Log amplitude of each frequency, and the log of their ratio."""
    low, high = (z.square().sum(1, keepdim=True).sqrt() + _PHASOR_FLOOR for z in phasor.chunk(2, dim=1))
    return [low.log() / 3 + 1, high.log() / 3 + 1, (high / low).log()]


def _frequencies(frame: Frame) -> list[Tensor]:
    """Octaves of the lowest and the highest frequency from the paper's, and whether there is one only, as even maps."""
    low, high = frame.modulation[:, :1], frame.modulation[:, 1:2]
    told = [(low / 20e6).log2() / 2, (high / 100e6).log2() / 2, (low == high).to(low)]
    return [x[..., None, None].expand_as(frame.depth) for x in told]


def _reach(frame: Frame, errors: Tensor, noise: Tensor) -> Tensor:
    """Tell how wrong the decoded depth may be, (B, 1, H, W) m: by some times its noise, expected multipath, and gap.

    ``errors`` (B, 4, H, W) and ``noise`` (B, 1, H, W) are in metres. Where nothing was measured there is no limit.
    """
    expected = errors[:, :3].abs().sum(1, keepdim=True)
    limit = _LEAST_REACH + 0.7 * expected + 0.2 * frame.cues[:, 3:4].abs() + noise
    return torch.where(frame.valid > 0, limit, torch.full_like(limit, _NO_LIMIT))


def zeroed_conv(inputs: int, outputs: int) -> nn.Conv2d:
    """Make a 1 x 1 convolution that starts at zero."""
    conv = nn.Conv2d(inputs, outputs, 1)
    nn.init.zeros_(conv.weight)
    nn.init.zeros_(conv.bias) if conv.bias is not None else None
    return conv


def _planes(image: Tensor) -> Tensor:
    """Single precision, a plane for each channel: taking channels apart is slow where they lie side by side."""
    return image.to(torch.float32, memory_format=torch.contiguous_format)


class Raw2Depth(nn.Module):
    """Decoded depth + gated steps to its candidates + residual, then convex upsampling.

    ``net`` maps the shared image to ``candidates + 1 + CONVEX_CHANNELS`` channels. Where the network does not see the decoded
    depth, the answer is no correction of it but a depth about ``MIDDLE``.
    """

    def __init__(
        self, net: nn.Module, network: Network, *, candidates: int = 0, decoded: bool = True
    ) -> None:
        super().__init__()
        self.net, self.candidates, self.decoded = net, candidates, decoded
        self.max_residual, self.learned = network.max_residual, network.learned_upsampling
        self.register_buffer("bilinear", bilinear_logits().reshape(1, -1, 1, 1), persistent=False)
        self.bilinear: Tensor

    def forward(self, shared: Tensor, features: Features, frame: Frame) -> Tensor:
        """Return depth (B, 1, 2H, 2W), metres."""
        out = _planes(self.net(shared))
        gates, residual, logits = torch.split(out, [self.candidates, 1, CONVEX_CHANNELS], dim=1)
        steps = (gates * (features.candidates - frame.depth)).sum(1, keepdim=True)
        start = frame.depth if self.decoded else torch.full_like(frame.depth, MIDDLE)
        unit_of = RESIDUAL_UNIT if self.decoded else REACH
        change = self._bounded(steps + residual * unit_of, features.reach, frame.valid)
        if features.trust is not None:  # what nothing like it was learned from: the sensor's depth, smoothed
            smooth = self._bounded(features.candidates[:, :1] - frame.depth, features.reach, frame.valid)
            change = torch.lerp(smooth, change, features.trust)
        depth = start + change
        learned = logits if self.learned else torch.zeros_like(logits)
        return convex_upsample(depth.clamp_min(0.05), learned + self.bilinear)

    def _bounded(self, change: Tensor, reach: Tensor | None, valid: Tensor) -> Tensor:
        """Keep a change of what was measured within the reach of each pixel, and within ``max_residual`` where there is one."""
        if reach is None and not self.max_residual:
            return change
        limit = torch.full_like(change, _NO_LIMIT) if reach is None else reach
        limit = torch.where(valid > 0, limit.clamp_max(self.max_residual or torch.inf), limit)
        return limit * torch.tanh(change / limit)


class ErrorMap(nn.Module):
    """Expected error of the depth, by ``net`` of the shared image and 4 channels of the depth.

    The depth is read detached: the error must not shape it.
    """

    def __init__(self, net: nn.Module, *, decoded: bool = True) -> None:
        super().__init__()
        self.net, self.decoded = net, decoded
        self.register_buffer("calibration", torch.ones(()))  # set after training, see evaluate.calibrate
        self.calibration: Tensor

    def forward(self, shared: Tensor, features: Features, depth: Tensor, frame: Frame) -> Tensor:
        """Return (B, 1, 2H, 2W), metres, positive; at least what physics allows where nothing like it was learned from."""
        fine = F.pixel_unshuffle(depth.detach(), 2)
        seen = (fine - frame.depth) * 20 if self.decoded else (fine - MIDDLE) / REACH
        out = self.net(torch.cat([shared, seen.clamp(-2, 2)], dim=1)).float()
        error = F.softplus(F.pixel_shuffle(out, 2)) * (RESIDUAL_UNIT * self.calibration)
        if features.trust is None or features.reach is None:
            return error
        return error + doubled((1 - features.trust) * features.reach)


class PaperNormals(nn.Module):
    """Residual on the starting normals, by sub-pixel convolution of the 12 channels of ``net``."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, shared: Tensor, features: Features, depth: Tensor, frame: Frame) -> Tensor:
        """Return unit camera-facing normals (B, 3, 2H, 2W)."""
        del depth, frame
        return unit(doubled(features.normals) + F.pixel_shuffle(self.net(shared).float(), 2))


class CompactNormals(nn.Module):
    """Residual on the starting normals, and gated steps to those of planes fitted to the network's own depth.

    Planes are fitted in windows of 3 and of 5 pixels. Depth is denoised first, and normals follow from it where noise lets
    them: depth to normal, as in the paper's IV-C.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        inputs, outputs = channels + 3 * (len(FIT_RADII) + 1), 12 + 4 * len(FIT_RADII)
        self.net = nn.Sequential(*double_conv(inputs, _HEAD_WIDTH), zeroed_conv(_HEAD_WIDTH, outputs))
        self.net[:-1].apply(he_initialised)

    def forward(self, shared: Tensor, features: Features, depth: Tensor, frame: Frame) -> Tensor:
        """Return unit camera-facing normals (B, 3, 2H, 2W) of a depth (B, 1, 2H, 2W)."""
        coarse, weight = F.avg_pool2d(depth, 2), frame.valid + _HOLE
        fitted = [
            plane_normals(local_planes(coarse, weight, radius)[0], frame.intrinsics, features.rays)
            for radius in FIT_RADII
        ]
        out = _planes(self.net(torch.cat([shared, features.normals, *fitted], dim=1)))
        # sub-pixels side by side until the end: interleaving each term costs more than the convolutions
        parts = torch.unflatten(out, 1, (-1, 4))
        if features.trust is not None:
            parts = parts * features.trust[:, None]
        normals = doubled_parts(features.normals) + parts[:, :3]
        for k, n in enumerate(fitted, 3):
            normals = torch.addcmul(normals, parts[:, k : k + 1], doubled_parts(n - features.normals))
        return F.pixel_shuffle(unit(normals).flatten(1, 2), 2)


def doubled(image: Tensor) -> Tensor:
    """Double the resolution bilinearly."""
    return F.interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)


class Refinement(nn.Module):
    """Depth to normals to depth, a few rounds with learned gains (paper section IV-C, after GeoNet).

    The geometry has no parameters. Gains start at one: what it says is taken whole, until training knows better. Only neighbours
    whose normals agree and whose votes lie near are asked, and trusted by the inverse square of their expected error.
    """

    def __init__(self, iterations: int, radius: int) -> None:
        super().__init__()
        self.radius = radius
        self.depth_gain = nn.Parameter(torch.full((iterations,), 1 / _GAIN_UNIT))
        self.normal_gain = nn.Parameter(torch.full((iterations,), 1 / _GAIN_UNIT))

    def forward(
        self, depth: Tensor, normals: Tensor, error: Tensor, intrinsics: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Refine depth (B, 1, H, W) and normals (B, 3, H, W) by the expected error (B, 1, H, W), metres."""
        confidence = error.detach().clamp_min(_MIN_ERROR) ** -2
        confidence = confidence / confidence.amax(dim=(2, 3), keepdim=True)
        # by number: a loop over an empty parameter is an operation that torch.export cannot read back
        for k in range(len(self.depth_gain)):
            depth_gain, normal_gain = self.depth_gain[k], self.normal_gain[k]
            # a measurement of the present depth, not a path for gradients: those reach the depth by propagation
            fitted = depth_to_normals(depth.detach(), confidence, intrinsics, radius=4)
            normals = unit(normals + _GAIN_UNIT * normal_gain * (fitted - normals))
            moved = propagate_depth(depth, normals, intrinsics, confidence, self.radius, step=2)
            depth = depth + _GAIN_UNIT * depth_gain * (moved - depth)
        return depth, normals
