"""Import a source: every view is read, judged and sealed; a scene appears whole or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture import __version__
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.check import UNFINISHED
from tofcapture.files.disk import check_writable
from tofcapture.files.seal import digest_once, fsync, write_text
from tofcapture.files.view import open_view, view_path, write_view
from tofcapture.frames import NO_TRUTH, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, View
from tofcapture.importing.overlap import Overlap, compare
from tofcapture.importing.plan import Planned, plan
from tofcapture.importing.rules import (
    burst_mean,
    check_taps,
    check_unit,
    expect_finite,
    sign_unknown,
    signed,
)
from tofcapture.importing.said import NAME, Said, read_said
from tofcapture.importing.truth import point_map
from tofcapture.poses import Float64
from tofcapture.rig import Rig, dumps_rig, load_rig

_SAME_PIXEL = 0.1  # px; cameras that were fitted to points differ by what is left of noise
Progress = Callable[[str, int, int], None]
"""Called with a scene, views done, views in all."""
STANDING: Float64 = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of a camera of which nobody says where it stands: level, looking along y of a base whose z is up."""


@dataclass
class Imported:
    """Report what an import did."""

    recording: Path
    scenes: dict[str, int] = field(default_factory=dict)  #: Views by scene.
    skipped: list[str] = field(default_factory=list)  #: Scenes that were there already.
    warnings: list[str] = field(default_factory=list)  #: What looks wrong and may be right.
    placed: bool = True  #: Whether it is known how the second camera stands; else ``align`` finds it.


def said_of(source: Path, config: Path | None = None) -> Said:
    """Read what is said of a source: ``config``, or the ``import.toml`` in it or beside it, or nothing."""
    beside = (source if source.is_dir() else source.parent) / NAME
    if config is None and not beside.is_file():
        return Said()
    return read_said(config or beside)


def import_data(
    sources: Sequence[str | Path],
    out: str | Path,
    said: Said | None = None,
    progress: Progress = lambda _scene, _done, _total: None,
) -> Imported:
    """Turn data that others took into a recording of sealed views, with its ``rig.toml``.

    Run again it goes on where it was; scenes that are there are left alone.

    Parameters
    ----------
    sources
        Files and folders; each is one scene, or has several in it.
    out
        The recording. Further imports of the same cameras may go into the same one.
    said
        What the files do not say; by default the ``import.toml`` in each source.
    progress
        Told after each view.

    Raises
    ------
    DataError
        Something in the source cannot be what it should be; the message names it, and what to do. The scene does not appear.
    ConfigError
        ``import.toml`` lacks something, a scene of that name is there and is another one, or the recording is of other cameras.
    """
    out = Path(out)
    check_writable(out, "name another folder: --out")
    planned: list[tuple[Planned, Said]] = []
    for source in map(Path, sources):
        told = said_of(source) if said is None else said
        planned += [(view, told) for view in plan(source, told)]
    scenes: dict[str, list[tuple[Planned, Said]]] = {}
    for view, told in planned:
        scenes.setdefault(view.scene, []).append((view, told))
    result = Imported(out)
    todo = {s: views for s, views in scenes.items() if not _is_there(out, s, views, result)}
    for scene in todo:
        (out / UNFINISHED / scene).mkdir(parents=True, exist_ok=True)
    done = 0
    for scene, views in todo.items():
        seen: dict[str, str] = {}
        for number, (view, told) in enumerate(views):
            _import_view(out, replace(view, index=number), told, result, seen)
            done += 1
            progress(scene, done, sum(map(len, todo.values())))
        _publish(out, scene)
        result.scenes[scene] = len(views)
    for left in (out / UNFINISHED).glob("*") if not todo or (out / UNFINISHED).is_dir() else ():
        result.warnings.append(
            f"{left}: an import of this scene was begun and not finished; import it again, or delete it"
        )
    if (out / UNFINISHED).is_dir() and not any((out / UNFINISHED).iterdir()):
        (out / UNFINISHED).rmdir()
    return result


def inputs_of(view: Planned, said: Said) -> dict[str, Any]:
    """Digest everything that a view is made of: files by name, and what was said."""
    files = {p.name: digest_once(p.path) if p.path.is_file() else "" for p in view.pieces}
    told = {name: getattr(said, name) for name in ("tof", "raw", "truth", "poses")}
    text = json.dumps([files, told, __version__], sort_keys=True, default=str)
    return {"files": files, "digest": hashlib.sha256(text.encode()).hexdigest()}


def _is_there(out: Path, scene: str, views: Sequence[tuple[Planned, Said]], result: Imported) -> bool:
    """Tell whether a scene was imported from these very inputs; :class:`ConfigError` when it was from others."""
    if not view_path(out, scene, 0).parent.is_dir():
        return False
    for number, (view, told) in enumerate(views):
        path = view_path(out, scene, number)
        if not path.is_file() or open_view(path).provenance.get("import") != inputs_of(view, told):
            raise ConfigError(
                f"{out}: holds a scene {scene} already, and {path.name} is not of these data",
                hint=f"import into another folder: --out, give it another name: --scene, or delete {path.parent} first",
            )
    result.skipped.append(scene)
    result.scenes[scene] = len(views)
    return True


def _import_view(out: Path, planned: Planned, said: Said, result: Imported, seen: dict[str, str]) -> None:
    """Make one view in the folder of unfinished scenes, unless it is there already; ``seen`` are names by frames' digests."""
    path = out / UNFINISHED / planned.scene / view_path(out, planned.scene, planned.index).name
    inputs = inputs_of(planned, said)
    if path.is_file():
        try:
            if open_view(path).provenance.get("import") == inputs:
                return
        except DataError:
            pass  # made by a run that was killed, and damaged since: it is made again
    rig = load_rig(out / "rig.toml") if (out / "rig.toml").is_file() else None
    view, overlap, placed = _made(planned, said, rig)
    view = _of_one_camera(out, view, rig)
    for text in (
        *overlap.warnings,
        *([] if planned.truth else [f"{planned.scene}: no ground truth: predict only"]),
        *_copied(view, planned.pieces[0].name, seen),
        *(
            []
            if placed
            else [f"{out}: how the second camera stands is not known: tofcapture align {out} --initial none"]
        ),
    ):
        if text not in result.warnings:
            result.warnings.append(text)
    result.placed &= placed
    if placed:
        _keep_rig(out, view.rig, overlap.model)
    write_view(path, replace(view, provenance={"import": inputs, "tofcapture": __version__}))


def _copied(view: View, name: str, seen: dict[str, str]) -> list[str]:
    """Name frames that are, bit for bit, frames of before: noise alone makes two of one scene differ."""
    for i, frame in enumerate(view.tof.raw):
        mine = f"view {view.index}, frame {i}"
        other = seen.setdefault(hashlib.sha256(frame.tobytes()).hexdigest(), mine)
        if other != mine:
            text = f"{name}: {mine} is {other}, bit for bit"
            return [f"{text}: did the driver stand still, or is it a copy? leave it out"]
    return []


def _of_one_camera(out: Path, view: View, rig: Rig | None) -> View:
    """Give a view the second camera of those before it, where it was fitted to points: what differs is noise."""
    if rig is None:
        made = next((p for root in (out, out / UNFINISHED) for p in sorted(root.glob("**/view-*.h5"))), None)
        rig = open_view(made).rig if made else None
    if rig is None or rig.stereo == view.rig.stereo or not _alike(rig.stereo, view.rig.stereo):
        return view
    stereo = replace(view.stereo, info=replace(view.stereo.info, camera=rig.stereo))
    return replace(view, stereo=stereo, rig=replace(view.rig, stereo=rig.stereo))


def make_view(planned: Planned, said: Said) -> tuple[View, Overlap]:
    """Make one view and say how its ground truth lies over the ToF image; raises as :func:`import_data` does."""
    return _made(planned, said, None)[:2]


def _made(planned: Planned, said: Said, rig: Rig | None) -> tuple[View, Overlap, bool]:
    """Make one view, say how its ground truth lies, and whether that is known; by ``rig`` where the source does not say."""
    where = planned.pieces[0].name
    raw = integers(planned.raw(), where)
    info = said.tof_info(planned.facts, (raw.shape[-2], raw.shape[-1]))
    warning = judged(
        raw, info, where, known=bool(planned.facts.modulation_hz or "modulation_mhz" in said.tof)
    )
    found = point_map(planned, said, info.camera, None if rig is None else rig.T_tof_stereo)
    rig = Rig(info.camera, found.camera, found.T_tof_stereo, np.eye(4), info.illuminator, (), info.reach)
    each = max(len(planned.time_ns) // len(raw), 1)  # images of a frame
    stamps = planned.time_ns[::each] if len(planned.time_ns) == each * len(raw) else tuple(range(len(raw)))
    pose = STANDING if planned.T_world_tof is None else planned.T_world_tof
    arm = ArmState(np.full(6, np.nan) if planned.joints is None else planned.joints, pose, stamps[0])
    celsius = said.raw.get("celsius", planned.facts.celsius)
    view = View(
        planned.scene,
        planned.index,
        TofBurst(
            raw, np.asarray(stamps, np.int64), np.full(len(raw), np.nan if celsius is None else celsius), info
        ),
        StereoFrame(found.points, stamps[0], StereoInfo(found.model, "", found.camera)),
        arm,
        replace(arm, time_ns=stamps[-1]),
        rig,
    )
    overlap = compare(view, where, found.model, placed=found.placed)
    told = planned.truth is not None or planned.facts.model
    more = [warning, "" if told else sign_unknown(info)]
    overlap = replace(overlap, warnings=(*filter(None, more), *overlap.warnings))
    return view, overlap, found.placed


def integers(raw: NDArray[Any], where: str) -> NDArray[Any]:
    """Bring taps (F, K, H, W) into uint16 or int16 as the sensor gave them; :class:`DataError` when nobody could.

    Floats that hold whole numbers are those; other floats stay, as float64.
    """
    if raw.dtype.kind not in "iuf" or raw.dtype.itemsize == 1:
        raise DataError(
            f"{where}: expected counts of more than 8 bits, got {raw.dtype}",
            hint="8 bits are a picture of the taps; export 16 bits",
        )
    if raw.dtype.kind == "f":
        expect_finite(raw, where)
        if (raw != np.rint(raw)).any():
            return raw.astype(np.float64)
        raw = raw.astype(np.int64) if np.abs(raw).max(initial=0) < 2**62 else raw
    raw = signed(raw)
    low, high = int(raw.min(initial=0)), int(raw.max(initial=0))
    kind = np.uint16 if low >= 0 else np.int16
    if low < np.iinfo(kind).min or high > np.iinfo(kind).max:
        raise DataError(
            f"{where}: expected counts of 16 bits, got {low} to {high}",
            hint="is another array meant? [raw] files; or another byte order: [raw] dtype",
        )
    return raw.astype(kind)


def judged(raw: NDArray[Any], info: TofInfo, where: str, *, known: bool) -> str:
    """Refuse taps (F, K, H, W) that cannot be what ``info`` says; return what looks wrong and may be right.

    Channels that somebody named are ``known``: their ranges may disagree by what nobody has calibrated yet.
    """
    expect_finite(raw, where)
    odd = check_unit(raw, info, where)
    apart = check_taps(burst_mean(raw, info), info, where, calibrated=not known)
    if apart:
        return f"{where}: {apart}: is the camera calibrated? tofcapture calibrate range"
    return "" if known else odd


def _keep_rig(out: Path, rig: Rig, model: str) -> None:
    """Write the recording's rig, once; :class:`ConfigError` when it holds another one."""
    path = out / "rig.toml"
    if not path.is_file():
        write_text(path, dumps_rig(rig))
        return
    known = load_rig(path)
    same = _alike(known.tof, rig.tof) and (
        model == NO_TRUTH
        or (_alike(known.stereo, rig.stereo) and np.allclose(known.T_tof_stereo, rig.T_tof_stereo, atol=1e-6))
    )
    if not same:
        raise ConfigError(
            f"{path}: the recording has other cameras than these data",
            hint="import them into another folder: --out; build-dataset takes several recordings",
        )


def _alike(a: Camera, b: Camera) -> bool:
    """Whether cameras are the same but for what is left of fitting one to points."""
    lens = {c.distortion for c in (a, b)}
    one, two = ([c.width, c.height, c.fx, c.fy, c.cx, c.cy] for c in (a, b))
    return len(lens) == 1 and bool(np.allclose(one, two, rtol=0, atol=_SAME_PIXEL))


def _publish(out: Path, scene: str) -> None:
    """Give a whole scene its place among the views."""
    made, place = out / UNFINISHED / scene, view_path(out, scene, 0).parent
    place.parent.mkdir(parents=True, exist_ok=True)
    made.replace(place)
    fsync(place.parent)
