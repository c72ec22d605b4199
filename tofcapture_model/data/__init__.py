"""Samples of a dataset: one frame of one view, decoded as a network reads it, with its ground truth at twice the resolution."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from tofcapture import open_dataset
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.cache import PackedScene, open_cache
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ShardReader
from tofcapture.frames import TofFlag, TofInfo
from tofcapture.ops.phase import Decoder, TapNoise, photon_transfer
from tofcapture_model.data.augment import BurstNoise
from tofcapture_model.data.raw_input import taken
from tofcapture_model.frame import MAX_RANGE, MIN_RANGE, NO_MAPS, Frame, Target
from tofcapture_model.geometry.decoder import demodulation, modulation
from tofcapture_model.geometry.maps import (
    cut_intrinsics,
    expect_usable,
    intrinsics_of,
    mirror_intrinsics,
    with_lens,
)
from tofcapture_model.geometry.multipath import cues, light, usual_phasor

Float32 = NDArray[np.float32]
Reader = ShardReader | PackedScene
MODEST = 1.5e9  # bytes, where the system does not tell what it has
TABLES = 125  # bytes per pixel of a decoder and its camera's rays, one for each scene


@dataclass(frozen=True)
class SampleId:
    """Which frame: scene name, view, frame."""

    scene: str
    view: int
    frame: int


def fill_nearest(image: Float32, valid: NDArray[np.bool_]) -> Float32:
    """Give every pixel outside ``valid`` the value of the nearest pixel inside; 1 m where nothing is valid at all."""
    from scipy.ndimage import distance_transform_edt

    if not valid.any():
        return np.ones_like(image)
    if valid.all():
        return image
    rows, cols = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    out: Float32 = image[rows, cols]
    return out


def frame_decoder(info: TofInfo, camera: Camera) -> Decoder:
    """Build the tables of :func:`make_frame` for calibrated intrinsics; refuses a lens that cannot be used."""
    expect_usable(camera)
    return Decoder(replace(info, camera=camera))


def make_frame(
    raw: NDArray[Any],
    info: TofInfo,
    camera: Camera,
    celsius: float = float("nan"),
    decoder: Decoder | None = None,
) -> Frame:
    """Decode one raw frame into what a network reads, as tensors without a batch axis.

    ``raw`` (K, H, W) is as the sensor gave it, or the mean of some frames; ``celsius`` is NaN where unknown. ``decoder`` is a
    :func:`frame_decoder` of the same camera; ``None`` builds its tables anew, which takes as long as some frames.
    """
    maps, signals = (decoder or frame_decoder(info, camera)).signals(raw, celsius)
    depth, ends = maps.depth, signals.phasor[[0, -1]]
    valid = np.isfinite(depth) & (depth > MIN_RANGE) & (depth < MAX_RANGE)
    valid &= (maps.flags & TofFlag.INCONSISTENT) == 0
    frame = Frame(
        raw=_tensor(raw) / info.saturation,
        phasor=_tensor(ends.reshape(4, *depth.shape)) / info.saturation,
        depth=_tensor(fill_nearest(depth, valid)[None]),
        valid=_tensor(valid[None]),
        confidence=_tensor(maps.confidence[None]) / info.saturation,
        gap=_tensor(np.nan_to_num(signals.gap[None])),
        cues=torch.empty(0),
        modulation=modulation(info),
        intrinsics=intrinsics_of(camera),
        demodulation=demodulation(info),
        light=torch.zeros(2),
        noise=torch.zeros(5),
    )
    return Frame(*(x[0] for x in with_cues(batched(frame), ends_of(info))))


def ends_of(info: TofInfo) -> tuple[float, float]:
    """Name the lowest and the highest frequency, Hz."""
    return float(min(info.modulation_hz)), float(
        max(info.modulation_hz)
    )  # no scalar of numpy, which makes tensors double


def with_cues(frame: Frame, hz: tuple[float, float]) -> Frame:
    """Add to a batch of whole decoded frames, on its device, what a crop does not show: light and cues.

    ``hz`` are the lowest and the highest frequency.
    """
    frame = frame._replace(light=light(frame.phasor, frame.depth, frame.valid, frame.intrinsics))
    usual = usual_phasor(frame)
    return frame._replace(cues=cues(usual, frame.depth, frame.valid, frame.gap, frame.intrinsics, hz))


def batched(frame: Frame) -> Frame:
    """Give a single frame its batch axis."""
    return Frame(*(x[None] for x in frame))


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def make_target(depth: Float32, normals: Float32, mask: NDArray[np.uint8]) -> Target:
    """Turn ground truth (2H, 2W), (2H, 2W, 3), (2H, 2W) into tensors; what is missing becomes finite and is masked."""
    hit = np.isfinite(depth) & np.isfinite(normals).all(-1)
    good, context = (mask == 0) & hit, (mask == MaskBit.OUTSIDE) & hit
    return Target(
        depth=_tensor(np.where(hit, depth, 1.0)[None]),
        normals=_tensor(np.where(hit[..., None], normals, [0.0, 0.0, -1.0]).transpose(2, 0, 1)),
        good=torch.from_numpy(good[None]),
        context=torch.from_numpy(context[None]),
    )


def crop(frame: Frame, target: Target, top: int, left: int, size: tuple[int, int]) -> tuple[Frame, Target]:
    """Cut a window out of a frame and its target; the principal point moves with it."""
    rows, cols = slice(top, top + size[0]), slice(left, left + size[1])
    rows2, cols2 = slice(2 * top, 2 * (top + size[0])), slice(2 * left, 2 * (left + size[1]))
    maps = {k: v[..., rows, cols] for k, v in frame._asdict().items() if k not in NO_MAPS}
    cut = frame._replace(**maps, intrinsics=cut_intrinsics(frame.intrinsics, top, left))
    return cut, Target(*(x[..., rows2, cols2] for x in target))


def crop_about_object(
    frame: Frame, target: Target, size: Sequence[int], rng: np.random.Generator
) -> tuple[Frame, Target]:
    """Crop about a pixel of good ground truth, because most of an image is background."""
    h, w = frame.depth.shape[-2:]
    height, width = min(size[0], h), min(size[1], w)
    good = target.good[0, ::8, ::8].nonzero()
    at = np.array([rng.integers(h), rng.integers(w)])
    if len(good):
        at = good[int(rng.integers(len(good)))].numpy() * 4 + rng.integers(-16, 17, 2)
    top, left = (
        int(np.clip(a - s // 2, 0, n - s)) for a, s, n in zip(at, (height, width), (h, w), strict=True)
    )
    return crop(frame, target, top, left, (height, width))


def mirror(frame: Frame, target: Target, axis: int = -1) -> tuple[Frame, Target]:
    """Flip left and right (axis -1) or up and down (axis -2): images, camera, and that component of the normals."""
    maps = {k: v.flip(axis) for k, v in frame._asdict().items() if k not in NO_MAPS}
    intrinsics = mirror_intrinsics(frame.intrinsics, axis, frame.depth.shape[axis])
    sign = torch.ones(3, 1, 1)
    sign[-1 - axis] = -1  # x for columns, y for rows
    flipped = Target(*(x.flip(axis) for x in target))
    return frame._replace(**maps, intrinsics=intrinsics), flipped._replace(normals=flipped.normals * sign)


def open_scenes(folder: Path, split: str, cache: Path | None = None) -> dict[str, Reader]:
    """Open a split's scenes, by name: shards, or a cache that must still agree with them. Readers pickle as paths.

    :class:`DataError`: the manifest or the cache is missing, damaged, stale or of another split.
    """
    shards = open_dataset(folder, split).shards
    if cache is None:
        return dict(shards)
    packed = open_cache(cache, folder)
    if packed.keys() != shards.keys():
        raise DataError(
            f"{cache}: is not of the split {split}", hint=f"tofcapture pack {folder} --split {split}"
        )
    return dict(packed)


class FrameDataset(Dataset[tuple[Frame, Target]]):
    """All frames of a split of a dataset, or of several.

    An item is asked for by ``(epoch, i)``: crop and flip are drawn from ``(seed, epoch, i)``. So an interrupted run goes on with
    the very same samples, whatever the number of workers.

    Raises :class:`DataError`: the split is empty, or a cache is not of it; :class:`ConfigError`: a cache with several datasets.

    Parameters
    ----------
    folder, split
        The dataset or datasets, and ``train``, ``val`` or ``test``.
    size
        (height, width) of crops at sensor resolution; () gives whole frames.
    flip
        Mirror half of the items, left to right.
    seed
        Of crops and flips.
    frames
        Use only the first so many frames of every view; 0: all.
    mean
        One item per view, the mean of its frames, for noise that is drawn again as its ``noise`` says.
    cache_bytes
        Decoded frames and their ground truth are kept in memory up to this size.
    cache
        Folder that ``tofcapture pack`` filled with this split of the one dataset; ``None`` reads the shards.
    """

    def __init__(
        self,
        folder: str | Path | Sequence[str | Path],
        split: str,
        size: Sequence[int] = (),
        *,
        flip: bool = False,
        seed: int = 0,
        frames: int = 0,
        mean: bool = False,
        cache_bytes: float = 0,
        cache: Path | None = None,
    ) -> None:
        folders = [Path(folder)] if isinstance(folder, str | Path) else [Path(each) for each in folder]
        if cache and len(folders) > 1:
            raise ConfigError(
                f"expected one dataset with the cache {cache}, got {len(folders)}",
                hint="leave the cache away: frames are kept in memory as far as it goes",
            )
        self.readers = {
            f"{name} ({k + 1})" if k else name: reader  # datasets may use a name twice
            for k, one in enumerate(folders)
            for name, reader in open_scenes(one, split, cache).items()
        }
        if not self.readers:
            raise DataError(
                f"{', '.join(map(str, folders))}: the split {split} is empty",
                hint="record more scenes, or choose another --split",
            )
        self.size, self.flip, self.seed, self.mean = tuple(size), flip, seed, mean
        least = min(reader.frames for reader in self.readers.values())
        self.averaged = min(least, frames or least) if mean else 1  # frames of an item
        self.samples = [
            SampleId(name, view, frame)
            for name, reader in self.readers.items()
            for view in range(reader.views)
            for frame in range(1 if mean else min(frames or reader.frames, reader.frames))
        ]
        cameras = [reader.camera for reader in self.readers.values()]
        self._lens = any(camera.distortion for camera in cameras)
        self._room = cache_bytes - sum(TABLES * camera.width * camera.height for camera in cameras)
        self._frames: dict[SampleId, Frame] = {}
        self._targets: dict[tuple[str, int], Target] = {}
        self._decoders: dict[str, Decoder] = {}
        self._noises: dict[str, Tensor] = {}
        self.kinds = [_kind(self.readers[sample.scene], self.size) for sample in self.samples]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, key: tuple[int, int]) -> tuple[Frame, Target]:
        epoch, i = key
        sample = self.samples[i]
        frame, target = self.frame(sample), self.target(sample)
        rng = np.random.default_rng([self.seed, epoch, i])
        if self.size:
            frame, target = crop_about_object(frame, target, self.size, rng)
        if self.flip and rng.random() < 0.5:
            frame, target = mirror(frame, target)
        return frame, target

    def frame(self, sample: SampleId) -> Frame:
        """Decode a frame, whole."""
        if sample in self._frames:
            return self._frames[sample]
        reader = self.readers[sample.scene]
        shots = range(self.averaged) if self.mean else [sample.frame]
        celsius = np.array([reader.celsius(sample.view, f) for f in shots])
        burst = np.stack([reader.raw(sample.view, f) for f in shots])
        raw, temperature = taken(burst, None if self.mean else 0, reader.info, celsius)
        if sample.scene not in self._decoders:
            self._decoders[sample.scene] = frame_decoder(reader.info, reader.camera)
        frame = make_frame(raw, reader.info, reader.camera, temperature, self._decoders[sample.scene])
        if self.mean:
            frame = frame._replace(noise=self._noise(reader))
        if self._lens:  # a batch may hold frames of other cameras, without one
            frame = frame._replace(intrinsics=with_lens(frame.intrinsics))
        if self._take_room(frame):
            self._frames[sample] = frame
        return frame

    def target(self, sample: SampleId) -> Target:
        """Read the ground truth of a frame's view, whole."""
        key = (sample.scene, sample.view)
        if key in self._targets:
            return self._targets[key]
        gt = self.readers[sample.scene].ground_truth(sample.view, 2)
        target = make_target(gt.depth, gt.normals, gt.mask)
        if self._take_room(target):
            self._targets[key] = target
        return target

    def _noise(self, reader: Reader) -> Tensor:
        """Measure the noise of a camera, by its serial number, on its first burst in some scene."""
        info = reader.info
        if info.serial not in self._noises:
            burst = np.stack([reader.raw(0, f) for f in range(self.averaged)])
            try:
                noise = photon_transfer([burst], info.saturation) if self.averaged > 1 else TapNoise()
            except DataError:  # hardly a tap below saturation
                noise = TapNoise()
            least = 0.0 if info.offset else -info.saturation
            row = BurstNoise(self.averaged, noise.electrons_per_unit, noise.read, info.saturation, least)
            self._noises[info.serial] = torch.tensor(row, dtype=torch.float32)
        return self._noises[info.serial]

    def close(self) -> None:
        """Close the shards."""
        for reader in self.readers.values():
            reader.close()

    def _take_room(self, tensors: Iterable[Tensor]) -> bool:
        size = sum(x.nbytes for x in tensors)
        if size > self._room:
            return False
        self._room -= size
        return True


def _kind(reader: Reader, size: tuple[int, ...]) -> tuple[int, ...]:
    """Tell frames apart that make no batch: by their channels and frequencies, and the size that crops leave of them."""
    hz, shape = reader.info.modulation_hz, reader.camera.shape
    cut = [min(n, s) for n, s in zip(shape, size or shape, strict=True)]
    return (len(hz), len(set(hz)), *cut)


def spare_memory() -> float:
    """Bytes that decoded frames may take: half of what system and container spare, shared by torchrun's processes."""
    processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    try:
        told = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        spare = 1024.0 * int(told["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return MODEST / processes
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):  # no limit reads "max"
        limit = int((group / "memory.max").read_text())
        spare = min(spare, limit - int((group / "memory.current").read_text()))
    return max(spare, 0.0) / 2 / processes


def collate(items: Sequence[tuple[Frame, Target]]) -> tuple[Frame, Target]:
    """Stack items along a new first axis; images in channels-last memory order."""
    frames, targets = zip(*items, strict=True)
    frame = Frame(*(torch.stack(x) for x in zip(*frames, strict=True)))
    maps = {
        k: v.contiguous(memory_format=torch.channels_last)
        for k, v in frame._asdict().items()
        if k not in NO_MAPS
    }
    return frame._replace(**maps), Target(*(torch.stack(x) for x in zip(*targets, strict=True)))


def epoch_batches(
    kinds: Sequence[Hashable], batch: int, seed: int, epoch: int, rank: int = 0, world: int = 1
) -> list[list[tuple[int, int]]]:
    """Keys ``(epoch, i)`` of every batch of an epoch, for one of ``world`` processes; a batch holds samples of one of ``kinds``.

    The order is a permutation drawn from ``(seed, epoch)``. All processes get equally many full batches, so that they step
    together; fewer samples of a kind than one step needs are repeated.
    """
    rng, step = np.random.default_rng([seed, epoch]), batch * world
    order = rng.permutation(len(kinds))
    steps: list[NDArray[np.int64]] = []
    for kind in dict.fromkeys(kinds):
        alike = np.array([i for i in order if kinds[i] == kind])
        alike = np.resize(alike, max(step, len(alike) - len(alike) % step))
        steps.extend(np.split(alike, len(alike) // step))
    if len(set(kinds)) > 1:
        steps = [steps[k] for k in rng.permutation(len(steps))]
    return [[(epoch, int(i)) for i in each[rank * batch : (rank + 1) * batch]] for each in steps]
