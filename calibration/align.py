"""``align``: from the views of a recording to ``rig.toml``."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from calibration.alignment.diagnosis import check_start, explained
from calibration.alignment.methods import apply_method, method_named
from calibration.alignment.rounds import Progress, RefusedPairsError, demand_pairs, find_start, solve
from calibration.alignment.targetless import align_scenes
from calibration.alignment.views import JointView, joint_view_of
from calibration.evidence import evidence_of, evidence_of_scenes, write_json
from calibration.registration.gate import backend_named, check_clouds
from calibration.registration.pairs import Pair, calibration_views, pair_of, sighting_of
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.disk import check_writable, what_is
from tofcapture.files.seal import write_text
from tofcapture.files.view import find_views, open_view
from tofcapture.frames import CALIBRATION
from tofcapture.libraries import called
from tofcapture.pool import Pool
from tofcapture.poses import invert
from tofcapture.rig import Rig, dumps_rig


def align(
    recording: str | Path,
    backend: str = "open3d",
    initial: Rig | Literal["none"] | None = None,
    progress: Progress = lambda _stage, _done, _total: None,
    method: str = "averaged",
    out: str | Path | None = None,
) -> tuple[Rig, dict[str, Any]]:
    """Align the cameras of a recording by averaged ICP; write ``evidence.json``, then ``rig.toml``.

    Every ToF cloud is registered into the stereo cloud of its view, gated, and the transforms are averaged. The range error common
    to all views is estimated from what remains and taken off, twice. Same input, same bytes.

    Parameters
    ----------
    recording
        Folder with ``views/calibration/view-*.h5``.
    backend
        ``open3d``, ``kiss-icp`` or ``small-gicp``.
    initial
        Rig to start from; by default the one the first view carries. ``none``: no guess, the views themselves tell where to start.
    progress
        Called with a stage, steps done and steps in all.
    method
        ``averaged`` as in the paper, ``weighted`` by each pair's information, or ``joint``: one robust problem over all
        accepted views that starts at the average and finds the range errors too. ``targetless`` takes the silhouettes of the
        scenes instead of the board's views, and no backend.
    out
        Folder of ``rig.toml`` and ``evidence.json``; by default the recording.

    Returns
    -------
    rig
        The initial rig with the new ``T_tof_stereo``.
    evidence
        What ``evidence.json`` holds.

    Raises
    ------
    DataError
        No views, unreadable ones, views of different cameras, in millimetres, mirrored or blind.
    ConfigError
        Unknown backend, or its library is missing; an initial guess in millimetres or swapped; ``out`` cannot be written.
    QualityError
        Fewer than three pairs pass the gate, with the likely cause, or scenes have too few silhouettes; nothing is written then.
    """
    backend_named(backend)
    method_named(method)
    recording = Path(recording)
    out = recording if out is None else Path(out)
    if recording.is_dir():  # else the answer is that there is no recording
        check_writable(out, "name a folder that can be written: --out")
    if method == "targetless":
        return _align_scenes(recording, initial, progress, out)
    pairs, views = _load(recording, progress, joint=method == "joint")
    start = initial if isinstance(initial, Rig) else pairs[0].rig
    if initial == "none":
        with Pool(1, pinned=True) as pool:
            start = replace(start, T_tof_stereo=invert(find_start(pairs, pool)))
    check_start(start.T_tof_stereo)
    try:
        solution = solve(pairs, backend, start.T_tof_stereo, progress)
    except RefusedPairsError as err:
        raise explained(err, recording, pairs, backend, start.T_tof_stereo) from None
    rig, found = apply_method(method, pairs, views, solution, start)
    evidence = evidence_of(pairs, solution, backend, start.T_tof_stereo, rig.T_tof_stereo, found)
    return _written(out, rig, evidence)


def _align_scenes(
    recording: Path, initial: Rig | Literal["none"] | None, progress: Progress, out: Path
) -> tuple[Rig, dict[str, Any]]:
    """Align by all scenes of a recording but the board's."""
    if initial == "none":
        raise ConfigError(
            "--method targetless starts from a rig", hint="leave --initial out, or name a rig.toml"
        )
    scenes = [paths for scene, paths in find_views(recording).items() if scene != CALIBRATION]
    if not scenes:
        raise DataError(
            f"{recording}: expected a recording with views of scenes, got {what_is(recording)}",
            hint="tofcapture record --scene NAME; for views of the board take another --method",
        )
    paths = [path for scene in scenes for path in scene]
    first = open_view(paths[0])
    start = first.rig if initial is None else initial
    check_start(start.T_tof_stereo)
    solution = align_scenes(scenes, start, progress)
    inputs = {path.relative_to(recording).as_posix(): _digest(path) for path in paths}
    truth = None if first.truth is None else first.truth.T_tof_stereo
    evidence = evidence_of_scenes(inputs, solution, start.T_tof_stereo, truth)
    return _written(out, replace(start, T_tof_stereo=solution.T_tof_stereo), evidence)


def _written(out: Path, rig: Rig, evidence: dict[str, Any]) -> tuple[Rig, dict[str, Any]]:
    write_json(out / "evidence.json", evidence)
    write_text(out / "rig.toml", dumps_rig(rig))
    return rig, evidence


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load(recording: Path, progress: Progress, *, joint: bool) -> tuple[list[Pair], list[JointView | None]]:
    """Read every view once: its pair, and where asked for what the joint method takes of it, None without clouds."""
    paths = calibration_views(recording)
    demand_pairs(len(paths), [None] * len(paths))
    pairs: list[Pair] = []
    views: list[JointView | None] = []
    for i, path in enumerate(paths):
        progress("reading", i, len(paths))
        view = open_view(path)
        seen = sighting_of(view)
        pairs.append(pair_of(view, seen, path.relative_to(recording).as_posix(), _digest(path)))
        blind = check_clouds(pairs[-1].source, pairs[-1].target) is not None
        views.append(joint_view_of(view, seen) if joint and not blind else None)
        if (pairs[-1].rig.tof, pairs[-1].rig.stereo) != (pairs[0].rig.tof, pairs[0].rig.stereo):
            raise DataError(
                f"{pairs[-1].name}: taken with other cameras than {pairs[0].name}",
                hint="use one recording per rig",
            )
    return pairs, views


called(__name__, "calibration.align:align")
