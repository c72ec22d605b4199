"""Printed targets: their corners come back from images of any size and turn, and lens and pose follow from them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.board.fit import Sight
from calibration.board.geometry import load_board
from calibration.board.printed import corners_in, read_corners
from calibration.board.seen import must_be_unique, seen_by_stereo, seen_in_image
from tests.commands import calibrate
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.frames import StereoFrame, StereoInfo
from tofcapture.poses import exp, invert, rotation_angle, rotation_exp, transform

BOARDS = ("chessboard", "charuco", "aprilgrid")
LENS = Camera(320, 256, 280.0, 282.0, 161.0, 125.0, (-0.12, 0.05, 0.001, -0.0007, 0.0))
SMALL = Camera(240, 180, 190.0, 200.0, 117.0, 92.0)


def quiet(_stage, _done, _total):
    """Show no progress."""


NOTHING = Sight(np.zeros((0, 3)), np.zeros((0, 3)), 1.0, 1.0)


def pose(board, tilt, towards, roll, distance, across=(0.0, 0.0)):
    """``T_camera_board`` of a board tilted so many degrees, facing the camera."""
    axis = np.radians(tilt) * np.array([np.cos(np.radians(towards)), np.sin(np.radians(towards)), 0.0])
    R = rotation_exp(axis) @ rotation_exp([0, 0, np.radians(roll)]) @ np.diag([1.0, -1.0, -1.0])
    return transform(R, np.array([*across, distance]) - board.thickness * R[:, 2])


def image_of(board, camera, T, fine=4, noise=0.0, seed=0):
    """What a camera sees of a board, sample by sample."""
    step = (np.arange(fine) + 0.5) / fine - 0.5
    u, v = np.meshgrid(*((np.arange(n)[:, None] + step).reshape(-1) for n in (camera.width, camera.height)))
    rays = camera.rays_at(np.stack([u, v], axis=-1).reshape(-1, 2))
    back = invert(T)
    along = rays @ back[:3, :3].T
    xy = back[:2, 3] + ((board.thickness - back[2, 3]) / along[:, 2])[:, None] * along[:, :2]
    plate = (np.abs(xy) < np.abs(board.outline).max(axis=0)).all(axis=1)
    grey = np.where(plate, np.where(board.pattern.dark(xy), 30.0, 200.0), 90.0)
    mean = grey.reshape(camera.height, fine, camera.width, fine).mean(axis=(1, 3))
    return mean + np.random.default_rng(seed).normal(0, noise, mean.shape)


@pytest.mark.parametrize("name", BOARDS)
@pytest.mark.parametrize("roll", [0, 180])
def test_small_images_give_corners_to_hundredths_of_a_pixel(name, roll):
    """At 240 x 180, upright and upside down, every corner is named rightly and lies within 0.1 px of where it is."""
    board = load_board(name)
    T = pose(board, 20, 40, roll + 7, 0.62)
    pixels, at = corners_in(image_of(board, SMALL, T, noise=1.0), board.pattern)
    true, _ = SMALL.project(np.column_stack([at, np.full(len(at), board.thickness)]) @ T[:3, :3].T + T[:3, 3])
    # A tag of an AprilGrid has two pixels a bit here, and not all are read.
    assert len(at) > (0.2 if name == "aprilgrid" else 0.8) * len(board.pattern.corners)
    assert np.abs(pixels - true).max() < 0.1
    seen = seen_in_image(image_of(board, SMALL, T, noise=1.0), board, SMALL, NOTHING)
    assert rotation_angle(invert(T) @ seen.fit.T) < np.radians(0.3)
    assert np.linalg.norm(seen.fit.T[:3, 3] - T[:3, 3]) < 0.003


@pytest.mark.parametrize("roll", [4, pytest.param(184, marks=pytest.mark.slow)])
def test_large_images_of_tags_hold_no_stray_corner(roll):
    """Corners of tags do not jump to the squares between them, upright and upside down."""
    board, camera = load_board("aprilgrid"), Camera(960, 720, 760.0, 765.0, 478.0, 361.0, LENS.distortion)
    T = pose(board, 25, 40, roll, 0.6)
    image = cv2.GaussianBlur(image_of(board, camera, T, 2, noise=1.0), (0, 0), 0.6)
    pixels, at = corners_in(image, board.pattern)
    true, _ = camera.project(
        np.column_stack([at, np.full(len(at), board.thickness)]) @ T[:3, :3].T + T[:3, 3]
    )
    assert len(at) > 0.7 * len(board.pattern.corners)
    assert np.abs(pixels - true).max() < 0.2


@pytest.mark.parametrize("name", BOARDS)
def test_an_image_without_a_board_is_refused(name):
    """It is said how many corners there are."""
    with pytest.raises(QualityError, match="at least 6 corners, got 0"):
        corners_in(np.full((180, 240), 90.0), load_board(name).pattern)


def plate_before_a_wall(board, camera, T, noise=0.0002):
    """Stereo frame of a plate at ``T_camera_board`` before a larger one 6 cm behind, and a wall."""
    rays = camera.rays.astype(np.float64)
    points = rays * 1.5
    for behind, aside, larger in ((0.06, (0.05, -0.05), 1.4), (0.0, (0.0, 0.0), 1.0)):
        top = T[:3, 3] + (board.thickness - behind) * T[:3, 2]
        hit = rays * ((top @ T[:3, 2]) / (rays @ T[:3, 2]))[..., None]
        on = np.abs((hit - T[:3, 3]) @ T[:3, :2] - aside) < larger * board.outline.max(axis=0)
        points = np.where(on.all(axis=-1)[..., None], hit, points)
    depth = points[..., 2:] + np.random.default_rng(0).normal(0, noise, (camera.height, camera.width, 1))
    return StereoFrame((rays * depth).astype(np.float32), 0, StereoInfo("made", "1", camera))


def test_a_plate_is_held_by_all_of_its_outline():
    """A start that is off comes home; from one that is hopeless the fit comes home or is refused, and does not slide."""
    board, camera = load_board("chessboard"), Camera(640, 512, 560.0, 560.0, 319.5, 255.5)
    T = pose(board, 20, 30, 8, 0.75)
    frame = plate_before_a_wall(board, camera, T)
    for move in (
        [0.015, 0.01, 0, 0, 0, 0.01],
        [-0.015, 0.012, 0.004, 0.01, 0, -0.02],
        [0.07, 0.06, 0, 0, 0, 0],
        [0.14, 0.1, 0, 0, 0, 0],
    ):
        try:
            fit = seen_by_stereo(frame, board, T @ exp(move))
        except QualityError:
            assert abs(move[0]) > 0.05
            continue
        assert np.linalg.norm(fit.T[:3, 3] - T[:3, 3]) < 0.0012
        assert rotation_angle(invert(T) @ fit.T) < np.radians(0.1)


def test_patterns_are_opencvs():
    """What is dark on a ChArUco board of ours is dark on OpenCV's, in both of its layouts."""
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for rows, legacy in ((5, False), (6, False), (6, True)):
        theirs = cv2.aruco.CharucoBoard((7, rows), 0.06, 0.045, book)
        theirs.setLegacyPattern(legacy)
        drawn = theirs.generateImage((7 * 40, rows * 40)) < 128
        ours = replace(load_board(f"charuco:7x{rows}:0.06:0.045:DICT_4X4_50").pattern, legacy=legacy)
        u, v = np.meshgrid(np.arange(7 * 40) + 0.5, np.arange(rows * 40) + 0.5)
        xy = np.stack([u, rows * 40 - v], axis=-1).reshape(-1, 2) * 0.06 / 40 - ours.size / 2
        assert (ours.dark(xy).reshape(drawn.shape) != drawn).mean() < 0.01


@pytest.mark.slow
def test_lens_of_a_folder_of_images(tmp_path):
    """Images through a known lens give it back within three sigma, and say their verdict."""
    board = load_board("charuco")
    rng = np.random.default_rng(0)
    for i in range(12):
        across = rng.uniform(-0.16, 0.16, 2)
        T = pose(board, rng.uniform(15, 40), 40 * i, rng.uniform(-20, 20), rng.uniform(0.55, 0.7), across)
        image = np.clip(image_of(board, LENS, T, 4, 1.0, i), 0, 255)
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.rint(image).astype(np.uint8))
    data = calibrate("lens", tmp_path, "--board", "charuco").data
    true = dict(
        zip(
            ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
            (280, 282, 161, 125, -0.12, 0.05, 0.001, -0.0007),
            strict=True,
        )
    )
    for name, value in true.items():
        found = data["lens"][name]
        assert abs(found["value"] - value) < 3 * found["sigma"] + 1e-3 * abs(value), name
    assert data["camera"]["width"] == 320
    assert (tmp_path / "lens.json").exists()


def test_images_of_another_board_say_what_is_there(tmp_path):
    """A board counted by its inner corners is refused as what it is; cut-outs cannot be told from images."""
    board = load_board("chessboard:7x6:0.05")
    cv2.imwrite(str(tmp_path / "a.png"), np.rint(image_of(board, SMALL, pose(board, 10, 30, 0, 0.6))))
    with pytest.raises(DataError, match="in the image has 7 x 6"):
        read_corners([tmp_path / "a.png"], load_board("chessboard:6x5:0.05"), quiet)
    with pytest.raises(DataError, match="cut-outs"):
        read_corners([tmp_path / "a.png"], load_board("default"), quiet)


def test_kalibrs_targets_are_read(tmp_path):
    """AprilGrid and checkerboard of Kalibr: spacing is a share, corners are counted between squares."""
    (tmp_path / "a.yaml").write_text(
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.08\ntagSpacing: 0.3\n"
    )
    pattern = load_board(tmp_path / "a.yaml").pattern
    assert (pattern.columns, pattern.rows, pattern.marker, pattern.border) == (6, 5, 0.08, 2)
    assert pattern.square == pytest.approx(0.104)
    (tmp_path / "c.yaml").write_text(
        "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"
    )
    assert load_board(tmp_path / "c.yaml").pattern.corners.shape == (42, 2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("chessboard:10:0.03", "COLUMNSxROWS"),
        ("charuco:7x5:70:50", "not millimetres"),
        ("charuco:7x5:0.07:0.08", "less than the square"),
        ("aprilgrid:0x5:0.07:0.05", "1 to 100"),
    ],
)
def test_impossible_patterns_are_named(words, said):
    """Sizes in millimetres, markers beyond their squares, no columns."""
    with pytest.raises(ConfigError) as caught:
        load_board(words)
    assert said in f"{caught.value} {caught.value.hint}"


def test_a_chessboard_of_two_even_numbers_has_no_pose():
    """Half a turn looks the same: good for a lens, refused for the hand."""
    with pytest.raises(QualityError, match="symmetric"):
        must_be_unique(load_board("chessboard:10x8:0.03"))
    must_be_unique(load_board("chessboard:10x7:0.03"))
    with pytest.raises(QualityError, match="corners"):
        corners_in(np.zeros((180, 240)), load_board("chessboard").pattern)
