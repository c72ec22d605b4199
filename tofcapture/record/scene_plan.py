"""The plan of a scene on a station."""

from __future__ import annotations

import hashlib

import numpy as np

from tofcapture.devices.clearance import stage_of
from tofcapture.devices.kinematics import arm_model
from tofcapture.devices.station import Station
from tofcapture.errors import ConfigError
from tofcapture.files.view import check_scene_name
from tofcapture.frames import CALIBRATION
from tofcapture.record.plan import Plan, board_sampling, object_sampling, plan_views


def plan_scene(station: Station, scene: str, views: int, turns: int = 1) -> Plan:
    """Plan the views of a scene on a station: its arm, its rig, its ``[plan]``, its seed.

    Raises
    ------
    ConfigError
        The name is no safe file name, no view is wanted, the board shall be turned, or not one view can be reached.
    """
    check_scene_name(scene)
    if views < 1:
        raise ConfigError(f"views: expected at least 1, got {views}")
    stage = stage_of(station.config)
    board = scene == CALIBRATION
    if not 1 <= turns <= (1 if board else 36):
        limit = "the board stays as it stands" if board else "expected 1 to 36"
        raise ConfigError(f"turns: {limit}, got {turns}")
    plan = plan_views(
        arm_model(station.arm.describe().model),
        station.rig,
        stage,
        stage.board if board else stage.target,
        board_sampling(stage) if board else object_sampling(),
        views,
        _generator(station.seed, scene),
        turns,
    )
    if not plan.views:
        raise ConfigError(
            f"no view of {scene!r} can be taken: {plan.summary()}",
            hint="move the target, see [plan] of the station",
        )
    return plan


def _generator(seed: int, scene: str) -> np.random.Generator:
    digest = hashlib.sha256(f"plan|{seed}|{scene}".encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype="<u4").tolist())
