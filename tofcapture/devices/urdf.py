"""Read an arm's kinematics from a URDF file: the chain of joints from its base to its flange."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from tofcapture.devices.kinematics import ArmModel, chain_model
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, rotation_exp, transform

_TURNING = {"revolute", "continuous"}


def urdf_model(
    path: Path,
    base: str | None = None,
    tip: str | None = None,
    radius: float = 0.08,
    low: Float64 | None = None,
    high: Float64 | None = None,
) -> ArmModel:
    """Read the chain of six turning joints between two links.

    Parameters
    ----------
    path
        The file; meshes are not looked at.
    base, tip
        Links: the frame of the arm's poses, and the flange. By default the root, and the end of the only chain with six joints.
    radius
        How thick to take the links, metres.
    low, high
        (6,) joint limits, radians, instead of the file's.

    Raises
    ------
    ConfigError
        Not readable, no URDF, no such link, a joint that slides, or other than six joints that turn.
    """
    try:
        root = ET.parse(path).getroot()  # noqa: S314  a file of the user's own station
    except (OSError, ET.ParseError) as err:
        raise ConfigError(f"{path}: cannot read the URDF: {err}", hint="expand xacro files first") from err
    parents = {
        _link(joint, "child", path): joint for joint in root.iter("joint") if joint.find("child") is not None
    }
    tips = [tip] if tip else [link.get("name", "") for link in root.iter("link")]
    chains = [_chain(parents, end, base, path) for end in tips]
    chains = [
        c
        for c in chains
        if sum(j.get("type") in _TURNING for j in c) == 6 and (tip or c[-1] in _last(chains))
    ]
    if len(chains) != 1 or {j.get("type") for j in chains[0]} - {*_TURNING, "fixed"}:
        raise ConfigError(
            f"{path}: expected one chain of six turning joints, got {len(chains)}"
            + (f" from {base or 'the root'} to {tip}" if tip else ""),
            hint="name its ends: base and tip of [arm.kinematics]",
        )
    return _model(root.get("name", path.stem), chains[0], radius, low, high, path)


def _link(joint: ET.Element, which: str, path: Path) -> str:
    link = joint.find(which)
    if link is None or not link.get("link"):
        raise ConfigError(f"{path}: joint {joint.get('name')} names no {which}")
    return str(link.get("link"))


def _chain(parents: Mapping[str, ET.Element], tip: str, base: str | None, path: Path) -> list[ET.Element]:
    """Joints from base to tip; none when the base is not above the tip."""
    out: list[ET.Element] = []
    while tip in parents and tip != base:
        if parents[tip] in out:
            raise ConfigError(f"{path}: the joints go in a circle at {tip}")
        out.insert(0, parents[tip])
        tip = _link(parents[tip], "parent", path)
    return out if base in {None, tip} else []


def _last(chains: list[list[ET.Element]]) -> list[ET.Element]:
    """The joints that end a chain and are part of no longer one."""
    inner = [joint for chain in chains for joint in chain[:-1]]
    return [chain[-1] for chain in chains if chain and chain[-1] not in inner]


def _model(
    name: str,
    chain: list[ET.Element],
    radius: float,
    low: Float64 | None,
    high: Float64 | None,
    path: Path,
) -> ArmModel:
    fixed, T, limits = [], np.eye(4), []
    for joint in chain:
        origin = joint.find("origin")
        T = T @ (np.eye(4) if origin is None else _origin(origin, path))
        if joint.get("type") == "fixed":
            continue
        axis = _vector(joint.find("axis"), "xyz", "1 0 0", path)
        turned = transform(_onto(axis), np.zeros(3))
        fixed.append(T @ turned)
        T = turned.T
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "continuous":
            limits.append([-2 * np.pi, 2 * np.pi])
        else:
            limits.append([_number(limit, key, path) for key in ("lower", "upper")])
    ends = np.array(limits).T
    return chain_model(
        name,
        np.stack([*fixed, T]),
        ends[0] if low is None else low,
        ends[1] if high is None else high,
        radius,
    )


def _origin(element: ET.Element, path: Path) -> Float64:
    """(4, 4) of xyz and of rpy: turns about the fixed axes x, y, z, in this order."""
    roll, pitch, yaw = _vector(element, "rpy", "0 0 0", path)
    turns = [rotation_exp(np.eye(3)[i] * angle) for i, angle in ((2, yaw), (1, pitch), (0, roll))]
    return transform(turns[0] @ turns[1] @ turns[2], _vector(element, "xyz", "0 0 0", path))


def _number(element: ET.Element, key: str, path: Path) -> float:
    try:
        return float(element.get(key, "0"))
    except ValueError as err:
        raise ConfigError(f"{path}: {key}: expected a number, got {element.get(key)!r}") from err


def _vector(element: ET.Element | None, key: str, default: str, path: Path) -> Float64:
    text = default if element is None else element.get(key, default)
    try:
        out = np.array([float(x) for x in text.split()])
    except ValueError:
        out = np.empty(0)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise ConfigError(f"{path}: {key}: expected three numbers, got {text!r}")
    return out


def _onto(axis: Float64) -> Float64:
    """(3, 3) rotation that turns z onto an axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
