"""The recorder's own process: reads its job and orders from stdin, tells what it does on stdout, one JSON object a line.

Orders: ``{"do": "pause" | "resume" | "stop" | "confirm"}``. When stdin ends the daemon is gone: the arm is stopped and the
process ends. Whatever libraries print goes to stderr. Pictures of sealed views are drawn here for the daemon's page.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import NO_VALUE, palette, png_bytes, scale_for
from tofcapture.devices import Operator
from tofcapture.errors import DeviceError, TofError
from tofcapture.files.seal import replacing
from tofcapture.frames import View
from tofcapture.ops.phase import Decoder
from tofcapture.record.daemon.settings import PICTURES
from tofcapture.record.journal import JobRefused
from tofcapture.record.observer import Observer, Stopped
from tofcapture.record.resources import FolderGone, check_motion_allowed, inode_of
from tofcapture.record.stopping import stoppable

if TYPE_CHECKING:
    from tofcapture.devices.station import Station
    from tofcapture.record.plan import Plan, PlannedView

ALIVE = 0.5  # s between signs of life
_LAST_WORDS = 2.0  # s that the recorder has to notice that it shall end
_PATIENCE = 1800.0  # s that an operator may take to place a scene
_WIDE = 320  # px; larger pictures are thinned out


def thinned(image: NDArray[Any]) -> NDArray[Any]:
    """Take every n-th pixel of a map (H, W), at most 320 across."""
    step = -(-image.shape[1] // _WIDE)
    return image[::step, ::step]


def save(view: View, folder: Path) -> dict[str, Any]:
    """Write the pictures of a view; a reader sees the old or the new one, never half of one.

    Returns the scale of each: five ``ticks`` from low to high in its ``unit``, and nine ``colours``. Both depths share one.
    """
    decoded = Decoder(view.tof.info).burst(view.tof.raw, float(np.mean(view.tof.celsius)))
    images = [thinned(m) for m in (decoded.confidence, decoded.depth, view.stereo.points[..., 2])]
    amplitude, depth = scale_for("amplitude", images[:1]), scale_for("depth", images[1:])
    scales = dict(zip(PICTURES, (amplitude, depth, depth), strict=True))
    for (name, scale), image in zip(scales.items(), images, strict=True):
        with replacing(folder / f"{name}.png") as partial:
            partial.write_bytes(png_bytes(scale.paint(image), level=1))
    shown = np.linspace(0, NO_VALUE - 1, 9).astype(int)
    return {
        name: {"ticks": s.ticks, "unit": s.unit, "colours": palette(s.colours)[shown].tolist()}
        for name, s in scales.items()
    }


def quality(view: View) -> dict[str, Any]:
    """Tell the recorder's numbers about a view (``record.quality``), its notes in sentences, frames, degrees Celsius."""
    found: dict[str, Any] = {**view.provenance["quality"]}
    celsius = float(np.mean(view.tof.celsius))
    found["notes"] = [note["words"] for note in found["notes"]]
    return found | {
        "frames": len(view.tof.time_ns),
        "celsius": round(celsius, 1) if np.isfinite(celsius) else None,
    }


class DaemonLink(Observer):
    """The line to the daemon: tells it what the recorder does, and does what it orders."""

    def __init__(self, orders: TextIO, out: TextIO, previews: Path) -> None:
        self._orders, self._out, self._previews = orders, out, previews
        self._lock = threading.Lock()
        self._changed = threading.Condition()
        self.paused = self.stopped = self.confirmed = False
        self.station: Station | None = None

    def tell(self, kind: str, **data: object) -> None:
        """Say that something happened; the daemon's absence is noticed elsewhere."""
        with self._lock:
            try:
                self._out.write(json.dumps({"kind": kind, **data}, allow_nan=False) + "\n")
                self._out.flush()
            except (OSError, ValueError):
                self.stopped = True

    def listen(self) -> None:
        """Follow orders until the line ends; then stop the arm and the process. Runs in a thread of its own."""
        for line in self._orders:
            try:
                self._follow(json.loads(line)["do"])
            except Exception as err:  # whatever a driver does: the next order must be heard
                self.tell("log", text=f"the arm could not be told to stop: {err}. Press the red button")
        self.stop()
        threading.Event().wait(_LAST_WORDS)
        os._exit(3)

    def _follow(self, order: str) -> None:
        with self._changed:
            self.stopped |= order == "stop"
            self.paused = order == "pause" or (self.paused and order != "resume")
            self.confirmed |= order == "confirm"
            self._changed.notify_all()
        if order == "stop" and (station := self.station) is not None:
            station.arm.stop()

    def stop(self) -> None:
        """Stop the arm and the run, now."""
        self._follow("stop")

    def check(self) -> None:
        """Raise :class:`Stopped` when the recorder shall end."""
        if self.stopped:
            raise Stopped("stopped by the operator", hint="ask for the same scene again to go on")

    def ask(self, scene: str) -> None:
        """Wait until a person says that the scene is placed. Raises :class:`DeviceError`: nobody answers."""
        self.confirmed = False
        self.tell("ask", scene=scene)
        with self._changed:
            heard = self._changed.wait_for(lambda: self.stopped or self.confirmed, _PATIENCE)
        self.check()
        if not heard:
            raise DeviceError(
                f"nobody confirmed within {_PATIENCE / 60:.0f} minutes that {scene!r} is placed",
                hint="place it, then resume",
            )
        self.tell("answered", scene=scene)

    def show_life(self) -> None:
        """Say every half second that this process lives. Runs in a thread of its own."""
        while True:
            self.tell("alive")
            threading.Event().wait(ALIVE)

    def planned(self, plan: Plan, kept: set[int], repaired: list[str]) -> None:
        """Tell the plan."""
        views = [
            {
                "index": v.index,
                **_place(v),
                "state": "sealed" if v.index in kept else "planned",
            }
            for v in plan.views
        ]
        self.tell("planned", views=views, wanted=plan.wanted, repaired=repaired)

    def before_view(self, index: int) -> None:
        """Wait while paused."""
        del index
        self.check()
        if not self.paused:
            return
        self.tell("paused")
        with self._changed:
            self._changed.wait_for(lambda: self.stopped or not self.paused)
        self.check()
        self.tell("resumed")

    def step(self, index: int, step: str) -> None:
        """Tell the step, unless it must not be taken any more."""
        self.check()
        self.tell("step", index=index, step=step)

    def sealed(self, view: View, sha256: str) -> None:
        """Tell what a view is like; pictures that cannot be made are no reason to lose a recording."""
        found: dict[str, Any] = {}
        scales: dict[str, Any] = {}
        try:
            scales = save(view, self._previews)
            found = quality(view)
        except (OSError, TofError, ValueError) as err:
            self.tell("log", text=f"no preview of view {view.index}: {err}")
        self.tell("sealed", index=view.index, sha256=sha256, quality=found, scales=scales)

    def failed(self, index: int, reason: str) -> None:
        """Tell why a view was given up."""
        self.tell("failed", index=index, reason=reason)


def _place(view: PlannedView) -> dict[str, Any]:
    """Say where a view is taken from; nothing where a person chooses the place."""
    if np.isnan(view.distance):
        return {}
    return {"direction": view.direction.round(4).tolist(), "distance": round(view.distance, 4)}


class PageOperator(Operator):
    """The person at the page, who puts scenes on the table when asked."""

    def __init__(self, link: DaemonLink) -> None:
        self._link = link

    def place(self, scene: str) -> None:
        """Ask and wait."""
        self._link.ask(scene)

    def tell(self, text: str) -> None:
        """Show it in the page's log."""
        self._link.tell("log", text=text)


def _work(job: Mapping[str, Any], link: DaemonLink) -> dict[str, Any]:
    """Open the station, record, and say what came of it."""
    # Imported late: orders are followed, and signs of life given, while the station's libraries load.
    from tofcapture.devices.station import open_station
    from tofcapture.record.recorder import record

    path = Path(job["station"]) if job["station"] else None
    with open_station(path, job["seed"], allow_motion=job["allow_motion"]) as station:
        link.station = station
        hint = "look at record --dry-run, clear the workspace, then start the daemon with --allow-motion"
        check_motion_allowed(station, job["allow_motion"], hint)
        for caution in station.arm.cautions():
            link.tell("log", text=f"caution: {caution}")
        link.tell("opened", station=station.describe(), simulated=station.simulated)
        staffed = replace(station, operator=PageOperator(link)) if station.operator.person else station
        for folder, inode in job["folders"].items():
            if inode_of(Path(folder)) != inode:
                raise FolderGone(
                    f"{folder} is not the folder that it was: moved, deleted or unmounted",
                    hint="put it back or mount it, then go on",
                )
        wish = {key: job[key] for key in ("scene", "recording", "views", "frames", "retake")}
        result = record(staffed, observer=link, **wish)
    return {"failed": list(result.failed), "reasons": list(result.reasons)}


def _error(err: BaseException) -> dict[str, Any]:
    """Tell of an error: the words, and whether it is the job's own; everything else the next job would meet as well."""
    return {
        "message": err.message if isinstance(err, TofError) else f"{type(err).__name__}: {err}",
        "hint": getattr(err, "hint", ""),
        "cause": type(err).__name__,
        "own": isinstance(err, JobRefused),
    }


def main() -> None:
    """Run one job."""
    # systemd signals the whole group: the daemon decides what it means. Driver hosts inherit this.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    job = json.loads(sys.stdin.readline())
    link = DaemonLink(sys.stdin, out, Path(job["previews"]))
    for task in (link.listen, link.show_life):
        threading.Thread(target=task, daemon=True).start()
    try:
        with stoppable(f"{job['scene']} into {job['recording']}", link.stop):
            link.tell("done", **_work(job, link))
    except Stopped:
        link.tell("stopped")
    except Exception as err:
        if not isinstance(err, TofError):
            traceback.print_exc()
        link.tell("error", **_error(err))
    # A thread sits in a read of stdin, and a vendor library may crash while it unwinds: everything is on disk.
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
