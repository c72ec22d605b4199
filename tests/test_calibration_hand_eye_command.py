"""``calibrate hand-eye``: recordings, streams and the files of other programs that it reads, what it writes, what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from calibration.hand_eye.files import read_pairs, read_poses, readings_of
from calibration.hand_eye.readings import agreed
from tests import answers
from tests.commands import calibrate
from tests.hand_eye import apart, station, streams
from tofcapture.devices.sim.scenes import BOARD_CENTRE, BOARD_TILT, scene_objects
from tofcapture.devices.sim.world import SimWorld, read_constants
from tofcapture.errors import DataError, FormatError, QualityError, UsageError
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.poses import exp, invert, look_at, rotation_exp, rotation_log, transform

HAND, TARGET, X = station(3, 15)
SMALL = {
    "stereo": {"width": 640, "height": 512, "fx": 577.5, "fy": 577.5, "cx": 319.5, "cy": 255.5},
    "tof": {"width": 120, "height": 90, "fx": 95.3, "fy": 100.4, "cx": 57.9, "cy": 50.2},
    "render": {"multipath": False, "subpixels": 1},
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Eight views of the simulated board whose rig is 5 mm and 0.8 deg off, and the true rig."""
    root, rng = tmp_path_factory.mktemp("recording"), np.random.default_rng(0)
    world = SimWorld(read_constants(SMALL, "test"), 3, lambda name, _: scene_objects(name, 3))
    world.place("calibration")
    true, upright = world.true_rig, rotation_exp([0.0, BOARD_TILT, 0.0])
    wrong = replace(true, T_flange_tof=true.T_flange_tof @ exp([0.004, -0.003, 0.002, 0.01, -0.008, 0.006]))
    for i in range(8):
        tilt, turn, away = np.radians(10 + 3 * i), 2.4 * i, 0.5 + 0.2 * (0.618 * i % 1)
        way = upright @ [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        aim, roll = BOARD_CENTRE + rng.normal(0, 0.01, 3), rng.uniform(-0.5, 0.5)
        T = look_at(BOARD_CENTRE + away * way, aim, up=[1.0, 0.0, 0.0], roll=roll) @ invert(true.T_flange_tof)
        world.set_pose(T, str(i).encode())
        arm = ArmState(np.zeros(6), T, 0)
        view = View("calibration", i, world.tof(2, clock=int), world.stereo(clock=int), arm, arm, wrong)
        write_view(view_path(root, "calibration", i), view)
    return root, true


def test_a_recording_gives_the_stereo_camera_on_the_flange(recorded):
    """Without a target detector the place of the stereo camera comes back to a millimetre, five times nearer than it was believed."""
    root, true = recorded
    data = calibrate("hand-eye", root).data
    turned, moved = apart(np.array(data["T_flange_camera"]), true.T_flange_stereo)
    assert moved < 1e-3
    assert np.degrees(turned) < 0.1
    assert (data["camera"], data["mount"], data["pairs"]) == ("stereo", "eye-in-hand", 8)
    answers.hold("hand-eye-recording", data, off=0.05)


def test_a_recording_gives_the_tof_camera_by_the_board(recorded):
    """With --board the ToF camera's place comes from the board it sees, within 3 mm at this size; views without it are named."""
    root, true = recorded
    data = calibrate("hand-eye", root, "--board", "default").data
    assert apart(np.array(data["T_flange_camera"]), true.T_flange_tof)[1] < 3e-3
    assert data["camera"] == "tof"
    assert data["pairs"] + len(data["refused"]) == 8


def test_a_recording_of_too_few_views_is_refused(recorded, tmp_path):
    """Views that no rigid motion brings together are counted and named; an empty folder says what to record."""
    root, _ = recorded
    for i in range(2):
        path = view_path(tmp_path, "calibration", i)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(view_path(root, "calibration", i))
    with pytest.raises(QualityError, match="at least 3 views"):
        calibrate("hand-eye", tmp_path)
    with pytest.raises(DataError, match="views of the board") as caught:
        calibrate("hand-eye", tmp_path / "views")
    assert "record --calibration" in caught.value.hint


def rows(poses, order="xyzw", scale=1.0):
    """(N, 7) translation and quaternion."""
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.c_[scale * poses[:, :3, 3], q if order == "xyzw" else np.roll(q, 1, axis=1)]


def text(table, header="", separator=","):
    """Lines of numbers."""
    return header + "".join(separator.join(f"{x:.9g}" for x in row) + "\n" for row in table)


def ros(pose):
    """A transform as ROS messages print it."""
    x, y, z, qx, qy, qz, qw = rows(pose[None])[0].tolist()
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def pairs(one, two):
    return list(zip(one, two, strict=True))


def moveit(a, b):
    return {"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()}


MATRICES = json.dumps(pairs(HAND.tolist(), TARGET.tolist()))
R_HAND, R_TARGET = HAND[:, :3, :3], TARGET[:, :3, :3]
T_HAND, T_TARGET = HAND[:, :3, 3:], TARGET[:, :3, 3:]
OPENCV = {
    "R_gripper2base": R_HAND,
    "t_gripper2base": T_HAND,
    "R_target2cam": R_TARGET,
    "t_target2cam": T_TARGET,
}


def file_storage(path, *, numbered=False):
    """OpenCV's own file of the four lists of calibrateHandEye, as sequences or one name a matrix."""
    out = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    for name, values in OPENCV.items():
        if not numbered:
            out.startWriteStruct(name, cv2.FileNode_SEQ)
        for i, value in enumerate(values):
            out.write(f"{name}_{i}" if numbered else "", np.ascontiguousarray(value))
        if not numbered:
            out.endWriteStruct()
    out.release()


PAIRS = {
    "storage.yml": file_storage,
    "storage.xml": file_storage,
    "storage.json": file_storage,
    "numbered.xml": lambda p: file_storage(p, numbered=True),
    "opencv.npz": lambda p: np.savez(p, **OPENCV),
    "opencv.mat": lambda p: savemat(p, OPENCV),
    "lists of (3, 1).json": lambda p: p.write_text(json.dumps({k: v.tolist() for k, v in OPENCV.items()})),
    "rvecs.npz": lambda p: np.savez(
        p,
        R_base2gripper=R_HAND.swapaxes(1, 2),
        t_base2gripper=-R_HAND.swapaxes(1, 2) @ T_HAND,
        rvecs=Rotation.from_matrix(R_TARGET).as_rotvec()[..., None],
        tvecs=T_TARGET,
    ),
    "decimal commas.csv": lambda p: p.write_text(
        text(np.c_[rows(HAND), rows(TARGET)], "", ";").replace(".", ",")
    ),
    "windows.csv": lambda p: p.write_bytes(text(np.c_[rows(HAND), rows(TARGET)]).encode("utf-16")),
    "twelve.csv": lambda p: p.write_text(
        text(np.c_[euler(HAND, "rotvec", degrees=False), euler(TARGET, "rotvec", degrees=False)])
    ),
    "matrices.json": lambda p: p.write_text(MATRICES),
    "moveit.yaml": lambda p: p.write_text(yaml.safe_dump([moveit(*ab) for ab in pairs(HAND, TARGET)])),
    "lists.json": lambda p: p.write_text(
        json.dumps({"hand": HAND.tolist(), "target": rows(TARGET).tolist()})
    ),
    "ros.json": lambda p: p.write_text(
        json.dumps({"samples": [{"robot": ros(a), "optical": ros(b)} for a, b in pairs(HAND, TARGET)]})
    ),
    "pairs.npz": lambda p: np.savez(p, T_gripper2base=HAND, T_target2cam=TARGET),
    "fourteen.csv": lambda p: p.write_text(
        text(np.c_[rows(HAND), rows(TARGET)], "ax,ay,az,a,b,c,d,bx,by,bz,e,f,g,h\n")
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_files_of_pairs_give_the_pairs(tmp_path, name):
    """Every form of pairs gives the poses that were written, and nothing but what no file says had to be decided."""
    PAIRS[name](tmp_path / name)
    hand, target, meant = agreed(*read_pairs(tmp_path / name))
    np.testing.assert_allclose(hand, HAND, atol=1e-6)
    np.testing.assert_allclose(target, TARGET, atol=1e-6)
    unsaid = {k: v for k, v in meant.said.items() if v not in {"rotation vectors", "inverted, as was told"}}
    assert unsaid == {}
    assert meant.rivals == ()


@pytest.mark.parametrize(("hand", "target"), [("wxyz", "xyzw"), ("xyzw", "wxyz"), ("wxyz", "wxyz")])
def test_the_order_of_quaternions_is_found(tmp_path, hand, target):
    """Scalar first or last is told by which of them moves rigidly with the other side."""
    path = tmp_path / "pairs.json"
    path.write_text(json.dumps(pairs(rows(HAND, hand).tolist(), rows(TARGET, target).tolist())))
    A, B, meant = agreed(*read_pairs(path))
    np.testing.assert_allclose(A, HAND, atol=1e-6)
    np.testing.assert_allclose(B, TARGET, atol=1e-6)
    given = {"hand": hand, "target": target}
    assert {k: v.split(" (")[0] for k, v in meant.said.items()} == {
        who: "quaternions wxyz" for who, order in given.items() if order == "wxyz"
    }


def euler(poses, order, *, degrees=True, scale=1.0):
    """(N, 6) translation and Euler angles or, as ``rotvec``, rotation vectors."""
    R = Rotation.from_matrix(poses[:, :3, :3])
    turn = R.as_rotvec(degrees=degrees) if order == "rotvec" else R.as_euler(order, degrees=degrees)
    return np.c_[scale * poses[:, :3, 3], turn]


READ_AS = {
    "Euler angles under rx,ry,rz": (
        "x,y,z,rx,ry,rz\n",
        lambda T: euler(T, "xyz"),
        "Euler angles xyz, fixed axes, degrees",
    ),
    "another order under roll,pitch,yaw": (
        "x,y,z,roll,pitch,yaw\n",
        lambda T: euler(T, "ZYX"),
        "ZYX, turning axes, degrees",
    ),
    "radians without a header": ("", lambda T: euler(T, "YXZ", degrees=False), "YXZ, turning axes"),
    "proper Euler angles": ("", lambda T: euler(T, "ZYZ"), "ZYZ, turning axes, degrees"),
    "KUKA": (
        "X,Y,Z,A,B,C\n",
        lambda T: euler(T, "ZYX", scale=1e3),
        "ZYX, turning axes, degrees, millimetres",
    ),
    "rotation vectors in degrees": (
        "x,y,z,rx,ry,rz\n",
        lambda T: euler(T, "rotvec"),
        "rotation vectors, degrees",
    ),
    "centimetres": ("", lambda T: rows(T, scale=100), "centimetres"),
    "JPL quaternions": ("", lambda T: rows(T) * [1, 1, 1, -1, -1, -1, 1], "inverted"),
    "columns": ("", lambda T: T.swapaxes(1, 2).reshape(-1, 16), "by columns"),
    "mm in the header": (
        "x [mm],y [mm],z [mm],rx [rad],ry [rad],rz [rad]\n",
        lambda T: euler(T, "rotvec", degrees=False, scale=1e3),
        "millimetres",
    ),
}


@pytest.mark.parametrize("form", READ_AS)
def test_conventions_are_found_and_said(tmp_path, form):
    """Whatever a program writes for the hand, both sides or a header that says otherwise: the poses are found, and what was taken is said."""
    header, write, says = READ_AS[form]
    (tmp_path / "hand.csv").write_text(text(write(HAND), header))
    (tmp_path / "target.csv").write_text(text(rows(TARGET, scale=100 if form == "centimetres" else 1)))
    hand, target, meant = agreed(read_poses(tmp_path / "hand.csv"), read_poses(tmp_path / "target.csv"))
    np.testing.assert_allclose(hand, HAND, atol=1e-5)
    np.testing.assert_allclose(target, TARGET, atol=1e-5)
    assert says in meant.said["hand"]
    assert meant.rivals == ()


def test_small_tilts_tell_euler_angles_from_rotation_vectors(tmp_path):
    """Hand angles below 15 degrees, where the readings differ by a degree at most, are told apart in either header's favour."""
    near = np.stack([transform(np.eye(3), [0.5, 0.1, 0.4]) @ invert(HAND[0]) @ T for T in HAND])
    small = np.stack([transform(rotation_exp(0.15 * rotation_log(T[:3, :3])), T[:3, 3]) for T in near])
    Z = transform(np.eye(3), [0.5, 0.0, 0.8])
    seen = np.stack(
        [
            invert(X) @ invert(T) @ Z @ exp(e)
            for T, e in zip(small, np.random.default_rng(0).normal(0, 4e-4, (15, 6)), strict=True)
        ]
    )
    target = readings_of(rows(seen).tolist(), "target")
    for order in ("xyz", "ZYX", "XYZ", "rotvec"):
        (tmp_path / "hand.csv").write_text(text(euler(small, order), "x,y,z,rx,ry,rz\n"))
        hand, _, _ = agreed(read_poses(tmp_path / "hand.csv"), target)
        np.testing.assert_allclose(hand, small, atol=1e-5)


def test_what_cannot_be_told_is_asked_for(tmp_path):
    """Inches look like centimetres, a mirrored frame has three axes: both are refused, and --read-as decides the first."""
    for name, T in (("hand.csv", HAND), ("target.csv", TARGET)):
        (tmp_path / name).write_text(text(rows(T, scale=1 / 0.0254)))
    files = tmp_path / "hand.csv", tmp_path / "target.csv"
    with pytest.raises(QualityError, match=r"centimetres .* as likely as in inches") as caught:
        calibrate("hand-eye", *files)
    assert "--read-as" in caught.value.hint
    data = calibrate("hand-eye", *files, "--read-as", "both=in").data
    assert apart(np.array(data["T_flange_camera"]), X)[1] < 0.002
    with pytest.raises(UsageError, match="--read-as"):
        calibrate("hand-eye", *files, "--read-as", "hand=furlongs")
    S = np.diag([1.0, -1.0, 1.0, 1.0])
    files[0].write_text(text(euler(S @ HAND @ S, "YXZ")))
    files[1].write_text(text(rows(TARGET)))
    with pytest.raises(QualityError, match="mirrored"):
        calibrate("hand-eye", *files)


def test_a_wrong_target_size_fails_unless_it_is_accepted(tmp_path):
    """A target 6 % off exits with 6 and the squares that would fit, its result written; free uses that size, 1 the given one."""
    large = TARGET.copy()
    large[:, :3, 3] *= 1.06
    path, out = tmp_path / "pairs.json", tmp_path / "result.json"
    path.write_text(json.dumps(pairs(HAND.tolist(), large.tolist())))
    failed = calibrate("hand-eye", path, "--out", out)
    assert failed.exit_code == 6
    assert json.loads(out.read_text())["verdict"] == "FAIL"
    assert "25 mm given become 23.5" in failed.text
    free, given = (calibrate("hand-eye", path, "--target-scale", word) for word in ("free", "1"))
    assert free.exit_code == given.exit_code == 0
    assert apart(np.array(free.data["T_flange_camera"]), X)[1] < 0.002
    assert apart(np.array(given.data["T_flange_camera"]), X)[1] > 0.01
    assert given.data["verdict"] == "WARN"
    with pytest.raises(UsageError, match="free or a factor"):
        calibrate("hand-eye", path, "--target-scale", "big")


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
    "rostopic echo -p": lambda t, T: (
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,"
        + ",".join(f"field.pose.position.{c}" for c in "xyz")
        + ","
        + ",".join(f"field.pose.orientation.{c}" for c in "xyzw")
        + "\n"
        + "".join(
            f"0,{i},{s:.9g},base," + ",".join(f"{x:.9g}" for x in row) + "\n"
            for i, (s, row) in enumerate(zip(t, rows(T), strict=True))
        )
    ),
    "UR": lambda t, T: "".join(
        f"[{s:.9g}, " + ", ".join(f"{x:.9g}" for x in row) + "],\n"
        for s, row in zip(t, euler(T, "rotvec", degrees=False), strict=True)
    ),
    "ros2 topic echo": lambda t, T: "".join(
        yaml.safe_dump(
            {
                "header": {"stamp": {"sec": int(s), "nanosec": round(s % 1 * 1e9)}, "frame_id": "base"},
                "pose": {"position": ros(one)["translation"], "orientation": ros(one)["rotation"]},
            }
        )
        + "---\n"
        for s, one in zip(t, T, strict=True)
    ),
    "ros2 topic echo --csv": lambda t, T: "".join(
        f"{int(s)},{round(s % 1 * 1e9)},base," + ",".join(f"{x:.9g}" for x in row) + "\n"
        for s, row in zip(t, rows(T), strict=True)
    ),
    "json": lambda t, T: json.dumps({"seconds": t.tolist(), "poses": rows(T).tolist()}),
}


TURNS = Rotation.from_matrix(R_HAND).as_euler("ZYX", degrees=True)
PENDANTS = {  # as the arms' own programs print them, without times
    "UR's variables": text(euler(HAND, "rotvec", degrees=False)).replace("\n", "]\nhome = p[").join(("home = p[", "")),
    "KUKA's E6POS": "".join(
        "DECL E6POS XP1={" + ",".join(f"{n} {x:.6f}" for n, x in zip("XYZABC", (*p, *turn), strict=True)) + ",S 6,T 27,E1 0.0}\n"
        for p, turn in zip(1e3 * HAND[:, :3, 3], TURNS, strict=True)
    ),
    "Franka's O_T_EE": json.dumps([{"O_T_EE": T.T.ravel().tolist()} for T in HAND]),
}  # fmt: skip


@pytest.mark.parametrize("form", PENDANTS)
def test_what_an_arm_prints_is_read(tmp_path, form):
    """Lengths as they are, no status taken for a time."""
    path = tmp_path / ("poses.json" if "Franka" in form else "poses.txt")
    path.write_text(PENDANTS[form].removesuffix("home = p["))
    found = read_poses(path)
    scale = 1e-3 if "KUKA" in form else 1
    np.testing.assert_allclose(scale * found.xyz, HAND[:, :3, 3], atol=1e-6)
    assert found.seconds is None


@pytest.mark.parametrize("form", STREAMS)
def test_tables_of_poses_are_read(tmp_path, form):
    """Headers in any order, TUM, millimetres, rotation vectors, roll pitch yaw in degrees and 3x4 matrices are the same poses."""
    path = tmp_path / ("poses.json" if form == "json" else "poses.txt")
    path.write_text(STREAMS[form](np.arange(len(HAND)) * 0.1, HAND))
    found = read_poses(path)
    np.testing.assert_allclose(found.usual, HAND, atol=1e-6)
    np.testing.assert_allclose(found.seconds, np.arange(len(HAND)) * 0.1)


def test_command_reads_pairs_and_writes_json(tmp_path):
    """Pairs in JSON and two files with the same times give one answer; the table and the file hold the same numbers."""
    (tmp_path / "pairs.json").write_text(MATRICES)
    for name, T in (("hand.csv", HAND), ("target.csv", TARGET)):
        (tmp_path / name).write_text(text(np.c_[np.arange(len(T)), rows(T)], "t,x,y,z,qx,qy,qz,qw\n"))
    out = tmp_path / "result.json"
    one = calibrate("hand-eye", tmp_path / "pairs.json", "--out", out)
    two = calibrate("hand-eye", tmp_path / "hand.csv", tmp_path / "target.csv")
    written = json.loads(out.read_text())
    answers.hold("hand-eye", {"file": written, "text": one.text}, names=[(tmp_path, "FOLDER")])
    np.testing.assert_allclose(written["T_flange_camera"], two.data["T_flange_camera"], atol=1e-6)
    assert apart(np.array(written["T_flange_camera"]), X)[1] < 0.002
    assert f"{1e3 * written['T_flange_camera'][0][3]:.2f}" in one.text
    error = written["standard_error"]
    line = next(line for line in one.text.splitlines() if "standard error" in line)
    assert line.split()[-2:] == [f"{error['translation_mm']:.3f}", f"{error['rotation_deg']:.4f}"]
    assert written["leave_one_out"] is not None
    inverted = tmp_path / "inverted.json"
    inverted.write_text(json.dumps([[a.tolist(), invert(b).tolist()] for a, b in pairs(HAND, TARGET)]))
    same = calibrate("hand-eye", inverted, "--inverted-target")
    np.testing.assert_allclose(same.data["T_flange_camera"], written["T_flange_camera"], atol=1e-6)


def test_command_solves_two_files_without_times(tmp_path):
    """Two files pose by pose, one with wxyz in millimetres, give X; the table says how they were read."""
    (tmp_path / "hand.csv").write_text(text(rows(HAND, "wxyz", 1e3)))
    (tmp_path / "target.csv").write_text(text(rows(TARGET)))
    outcome = calibrate("hand-eye", tmp_path / "hand.csv", tmp_path / "target.csv")
    assert np.abs(np.array(outcome.data["T_flange_camera"]) - X).max() < 0.005
    assert outcome.data["read_as"]["hand"].startswith("quaternions wxyz, millimetres")
    assert "millimetres" in outcome.text


def test_command_finds_the_offset_of_streams(tmp_path):
    """Two CSV streams with clocks apart are brought together and solved in one call."""
    hand, target, truth = streams(0.25)
    for name, stream in (("hand.csv", hand), ("target.csv", target)):
        np.savetxt(tmp_path / name, np.c_[stream.seconds, rows(stream.poses)], fmt="%.9f")
    data = calibrate("hand-eye", tmp_path / "hand.csv", tmp_path / "target.csv").data
    assert abs(data["time_offset_s"] - 0.25) < 0.002
    answers.hold("hand-eye-streams", data)
    assert apart(np.array(data["T_flange_camera"]), truth)[1] < 0.002


@pytest.mark.parametrize(
    ("name", "content", "kind", "says"),
    [
        ("pairs.json", "", FormatError, "JSON"),
        ("pairs.json", "[]", DataError, "empty list"),
        ("pairs.json", "{}", FormatError, "names such as"),
        ("pairs.json", "3", FormatError, "a list of pairs"),
        ("pairs.json", "[[1, 2]]", FormatError, "got 1"),
        ("pairs.json", "[[[[1]], [[2]]]]", FormatError, "got 1"),
        ("pairs.json", '[{"hand": [1]}]', FormatError, "pair 0"),
        ("pairs.json", '{"hand": [1, 2], "target": [1]}', DataError, "as many"),
        ("pairs.yaml", "a: [", FormatError, "YAML"),
        ("pairs.npz", "no arrays", FormatError, "arrays"),
        ("pairs.npz", "PK\x03\x04 cut", FormatError, "arrays"),
        ("pairs.csv", "\udcff\udcff", FormatError, "text"),
        ("pairs.csv", "1,2,3,0,0,0,1\n", FormatError, "two poses"),
        ("pairs.bag", "#ROSBAG V2.0", FormatError, "got .bag"),
        ("pairs.xml", "<opencv_storage>", FormatError, "XML"),
        ("folder.csv", None, FormatError, "text"),
    ],
)
def test_bad_pair_files_are_named(tmp_path, name, content, kind, says):
    """Files that hold no pairs say what was expected, with their path."""
    path = tmp_path / name
    path.mkdir() if content is None else path.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(kind, match=name.replace(".", r"\.")) as caught:
        read_pairs(path)
    assert says in str(caught.value)
    with pytest.raises(DataError, match="no such file"):
        read_pairs(tmp_path / f"none-{name}")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "one a line"),
        ("t,x\n", "one a line"),
        ("0,1,2,3,0,0,0,1\n0,1,2\n", ":2: expected 8 numbers"),
        ("0,1,2,3,1,1,0,1\n", "unit quaternions"),
        ("0,nan,2,3,0,0,0,1\n", "finite"),
        ("x,y,z,a\n1,2,3,4\n", "no rotation"),
        ("x,y,z,roll,pitch,yaw\n1,2,3,0,inf,0\n", "finite"),
    ],
)
def test_bad_tables_are_named(tmp_path, content, says):
    """Streams with missing columns, NaN or quaternions that are none say so with their path, and the line where there is one."""
    path = tmp_path / "hand.csv"
    path.write_text(content)
    with pytest.raises(DataError, match=r"hand\.csv") as caught:
        read_poses(path)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("values", "kind", "says"),
    [
        ([], DataError, "none"),
        ([[0.0] * 5] * 4, FormatError, "6 numbers"),
        ([[0.0] * 7, [0.0] * 16], FormatError, "one form"),
        ([[0, 0, 2, 1, 1, 0, 0]], DataError, "unit quaternions"),
        ([{"translation": [0, 0, 0]}], FormatError, "rotation"),
        ([{"translation": {"x": 1}, "rotation": [0, 0, 0, 1]}], FormatError, "x, y, z"),
        ([["a"]], FormatError, "numbers"),
    ],
)
def test_what_no_pose_is_has_a_name(values, kind, says):
    """Empty lists, Euler angles without a header, mixed forms, wrong quaternions, half a pose and words are named."""
    with pytest.raises(kind) as caught:
        readings_of(values, "file")
    assert says in f"{caught.value} {caught.value.hint}"


def test_command_refuses_what_makes_no_pairs(tmp_path):
    """More than two files are a usage error; two lists of different length need times."""
    with pytest.raises(UsageError):
        calibrate("hand-eye", "a.csv", "b.csv", "c.csv")
    (tmp_path / "a.csv").write_text(text(rows(HAND)))
    (tmp_path / "b.csv").write_text(text(rows(TARGET[1:])))
    with pytest.raises(DataError, match="times before them, got 15 and 14"):
        calibrate("hand-eye", tmp_path / "a.csv", tmp_path / "b.csv")
