"""Read an arm's kinematics from a URDF file: the chain of joints from its base to its flange."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from tofcapture.devices.kinematics import ArmModel, chain_model
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, rotation_exp, transform


def urdf_model(path: Path, base: str, tip: str, radius: float, **limits: Float64) -> ArmModel:
    """Read the turning joints, six or more, between the links ``base``, the frame of the arm's poses, and ``tip``, its flange.

    Meshes are not looked at: links are ``radius`` metres thick. ``low`` and ``high`` (J,) rad replace the file's joint limits.

    Raises :class:`ConfigError`: not readable, no URDF, no such link, or fewer than six joints between
    them, or some that do not turn; :class:`ValueError`: words where numbers should be.
    """
    try:
        root = ET.parse(path).getroot()  # noqa: S314  a file of the user's own station
    except (OSError, ET.ParseError) as err:
        raise ConfigError(f"{path}: cannot read the URDF: {err}", hint="expand xacro files first") from err
    above = {link.get("link"): joint for joint in root.iter("joint") for link in joint.findall("child")}
    chain: list[ET.Element] = []
    link: str | None = tip
    while link in above and link != base and len(chain) <= len(above):
        chain.insert(0, above[link])
        link = next((p.get("link") for p in above[link].findall("parent")), None)
    moving = [joint for joint in chain if joint.get("type") != "fixed"]
    if link != base or len(moving) < 6 or {j.get("type") for j in moving} - {"revolute", "continuous"}:
        names = ", ".join(str(one.get("name")) for one in root.iter("link"))
        found = ", ".join(f"{j.get('name')} ({j.get('type')})" for j in moving) or "none"
        raise ConfigError(
            f"{path}: expected six turning joints or more from {base!r} to {tip!r}, got {found}",
            hint=f"base and tip of [arm.kinematics] are two of its links: {names}",
        )
    fixed, T, ends = [], np.eye(4), []
    for joint in chain:
        T = T @ _origin(joint.find("origin"))
        if joint in moving:
            turned = _z_onto(_vector(joint.find("axis"), "xyz", "1 0 0"))
            fixed.append(T @ turned)
            T = turned.T
            limit = joint.find("limit") if joint.get("type") == "revolute" else None
            ends.append([-2 * np.pi, 2 * np.pi] if limit is None else _limits(limit))
    low, high = np.array(ends).T
    return chain_model(
        str(root.get("name")), [*fixed, T], radius=radius, **{"low": low, "high": high, **limits}
    )


def _limits(element: ET.Element) -> list[float]:
    return [float(element.get(key, "0")) for key in ("lower", "upper")]


def _origin(element: ET.Element | None) -> Float64:
    """(4, 4) of xyz and of rpy: turns about the fixed axes x, y, z, in this order."""
    turns = [
        rotation_exp(axis * angle) for axis, angle in zip(np.eye(3), _vector(element, "rpy"), strict=True)
    ]
    return transform(turns[2] @ turns[1] @ turns[0], _vector(element, "xyz"))


def _vector(element: Any, key: str, default: str = "0 0 0") -> Float64:
    out: Float64 = np.array(
        (default if element is None else element.get(key, default)).split(), dtype=np.float64
    )
    return out


def _z_onto(axis: Float64) -> Float64:
    """(4, 4) rotation that turns z onto an axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), np.zeros(3))
