"""Poses in the forms of other programs: whatever the file, the same hand-eye transform, and what was decided is said."""

from __future__ import annotations

import argparse
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.cli import calibrate as calibrate_cli
from calibration.hand_eye.files import read_pairs_said, read_poses
from calibration.hand_eye.forms import readings_of
from tests.test_calibration_hand_eye import station
from tofcapture.errors import DataError, FormatError

HAND, TARGET, X = station(3, 15)


def rows(poses, order="xyzw", scale=1.0):
    """(N, 7) translation and quaternion."""
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.c_[scale * poses[:, :3, 3], q if order == "xyzw" else np.roll(q, 1, axis=1)]


def text(table, header="", separator=","):
    """Lines of numbers."""
    return header + "".join(separator.join(f"{x:.9g}" for x in row) + "\n" for row in table)


def moveit(path):
    """MoveIt's samples, YAML."""
    import yaml

    yaml.safe_dump(
        [
            {"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()}
            for a, b in zip(HAND, TARGET, strict=True)
        ],
        path.open("w"),
    )


def ros(pose):
    """A transform as ROS messages print it."""
    x, y, z, qx, qy, qz, qw = rows(pose[None])[0].tolist()
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}}


PAIRS = {
    "moveit.yaml": moveit,
    "lists.json": lambda p: p.write_text(
        json.dumps({"hand": HAND.tolist(), "target": rows(TARGET).tolist()})
    ),
    "ros.json": lambda p: p.write_text(
        json.dumps(
            {"samples": [{"robot": ros(a), "optical": ros(b)} for a, b in zip(HAND, TARGET, strict=True)]}
        )
    ),
    "pairs.npz": lambda p: np.savez(p, T_gripper2base=HAND, T_target2cam=TARGET),
    "fourteen.csv": lambda p: p.write_text(
        text(np.c_[rows(HAND), rows(TARGET)], "ax,ay,az,a,b,c,d,bx,by,bz,e,f,g,h\n")
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_files_of_pairs_give_the_pairs(tmp_path, name):
    """Every form of pairs gives the poses that were written, and nothing had to be decided."""
    PAIRS[name](tmp_path / name)
    hand, target, said = read_pairs_said(tmp_path / name)
    np.testing.assert_allclose(hand, HAND, atol=1e-6)
    np.testing.assert_allclose(target, TARGET, atol=1e-6)
    assert said == {}


@pytest.mark.parametrize(("hand", "target"), [("wxyz", "xyzw"), ("xyzw", "wxyz"), ("wxyz", "wxyz")])
def test_the_order_of_quaternions_is_found(tmp_path, hand, target):
    """Scalar first or last is told by which of them moves rigidly with the other side."""
    path = tmp_path / "pairs.json"
    path.write_text(
        json.dumps(
            [[a, b] for a, b in zip(rows(HAND, hand).tolist(), rows(TARGET, target).tolist(), strict=False)]
        )
    )
    A, B, said = read_pairs_said(path)
    np.testing.assert_allclose(A, HAND, atol=1e-6)
    np.testing.assert_allclose(B, TARGET, atol=1e-6)
    assert {who for who, words in said.items() if "wxyz" in words} == {
        who for who, order in (("hand", hand), ("target", target)) if order == "wxyz"
    }


STREAMS = {
    "tum": lambda t, T: text(np.c_[t, rows(T)], "# timestamp tx ty tz qx qy qz qw\n", " "),
    "header wxyz": lambda t, T: text(np.c_[t, rows(T, "wxyz")], "time,x,y,z,qw,qx,qy,qz\n"),
    "millimetres": lambda t, T: text(np.c_[t, rows(T, scale=1e3)], ""),
    "rotation vector": lambda t, T: text(
        np.c_[T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), t], "x;y;z;rx;ry;rz;t\n", ";"
    ),
    "degrees": lambda t, T: text(
        np.c_[t, T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)],
        "t, x [m], y [m], z [m], roll (deg), pitch (deg), yaw (deg)\n",
    ),
    "matrix": lambda t, T: text(np.c_[t, T[:, :3].reshape(-1, 12)]),
}


@pytest.mark.parametrize("form", STREAMS)
def test_tables_of_poses_are_read(tmp_path, form):
    """Headers in any order, TUM, millimetres, rotation vectors, roll pitch yaw in degrees and 3x4 matrices are the same poses."""
    path = tmp_path / "poses.txt"
    path.write_text(STREAMS[form](np.arange(len(HAND)) * 0.1, HAND))
    found = read_poses(path)
    np.testing.assert_allclose(next(iter(found.poses.values())), HAND, atol=1e-6)
    np.testing.assert_allclose(found.seconds, np.arange(len(HAND)) * 0.1)
    assert found.millimetres == (form == "millimetres")


def test_command_solves_two_files_without_times(tmp_path, capsys):
    """Two files pose by pose, one with wxyz in millimetres, give X; the table says how they were read."""
    one, two = tmp_path / "hand.csv", tmp_path / "target.csv"
    one.write_text(text(rows(HAND, "wxyz", 1e3)))
    two.write_text(text(rows(TARGET)))
    parser = argparse.ArgumentParser()
    calibrate_cli.COMMAND.configure(parser)
    outcome = calibrate_cli.COMMAND.run(parser.parse_args(["hand-eye", str(one), str(two)]))
    assert np.abs(np.array(outcome.data["T_flange_camera"]) - X).max() < 0.005
    assert outcome.data["read_as"] == {"hand": "quaternions wxyz, millimetres"}
    assert "millimetres" in outcome.text


@pytest.mark.parametrize(
    ("values", "kind", "says"),
    [
        ([], DataError, "none"),
        ([[0.0] * 6] * 4, FormatError, "rotation vectors"),
        ([[0.0] * 7, [0.0] * 16], FormatError, "one form"),
        ([[0, 0, 0, 1, 1, 0, 0]], DataError, "unit quaternions"),
        ([{"translation": [0, 0, 0]}], FormatError, "rotation"),
        ([["a"]], FormatError, "numbers"),
    ],
)
def test_what_no_pose_is_has_a_name(values, kind, says):
    """Empty lists, Euler angles without a header, mixed forms, wrong quaternions, half a pose and words are named."""
    with pytest.raises(kind) as caught:
        readings_of(values, "file")
    assert says in f"{caught.value} {caught.value.hint}"


def test_other_mistakes_are_named(tmp_path):
    """Lists of different length and one pose a line where pairs are due say so."""
    path = tmp_path / "pairs.json"
    path.write_text(json.dumps({"hand": HAND.tolist(), "target": TARGET[1:].tolist()}))
    with pytest.raises(DataError, match="as many"):
        read_pairs_said(path)
    path = tmp_path / "hand.csv"
    path.write_text(text(rows(HAND)))
    with pytest.raises(FormatError, match="two poses"):
        read_pairs_said(path)
