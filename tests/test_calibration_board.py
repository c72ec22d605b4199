"""Boards: the file, its checks, its drawings at true scale; and finding a board by its model, or refusing to."""

from __future__ import annotations

import re
import struct
import xml.etree.ElementTree as ET
from io import StringIO
from pathlib import Path

import ezdxf
import numpy as np
import pytest

from calibration.board.coverage import missing
from calibration.board.detector import detect
from calibration.board.drawing import describe, dxf, stl, svg
from calibration.board.fit import Model, Sight, on_front, refine
from calibration.board.geometry import Board, board_from, distance_to_ring, load_board, symmetries
from tests import answers
from tests.commands import calibrate
from tofcapture.camera import Camera
from tofcapture.devices.sim.shapes import BOARD_SIZE
from tofcapture.devices.sim.shapes import board as simulated_board
from tofcapture.errors import ConfigError, QualityError
from tofcapture.meshes import circle, extrude, inside, rectangle
from tofcapture.poses import exp, invert, look_at, rotation_angle, rotation_log, transform_points
from tofcapture.record.quality import coverage, meter

CAMERA = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
BLANK = {
    "format": "tofcapture-board",
    "version": 1,
    "units": "m",
    "name": "test",
    "thickness": 0.01,
    "outline": [[-0.2, -0.15], [0.2, -0.15], [0.2, 0.15], [-0.2, 0.15]],
}


def disc(name="disc", centre=(0.05, 0.04), radius=0.03):
    return {"name": name, "centre": list(centre), "radius": radius}


def test_default_board_is_the_simulators():
    """The packaged board and the simulator's are one mesh, vertex by vertex."""
    board = load_board()
    (v, t), (sim_v, sim_t) = extrude(board.outline, board.thickness, board.rings[1:]), simulated_board()
    np.testing.assert_allclose(v, sim_v, atol=1e-12)
    np.testing.assert_array_equal(t, sim_t)
    assert load_board().thickness == BOARD_SIZE[2]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"units": "mm"}, 'units = "m"'),
        ({"format": "other"}, "tofcapture-board"),
        ({"colour": "red"}, "unknown key colour"),
        ({"thickness": -1}, "thickness"),
        ({"thickness": 10}, "a plate"),
        ({"outline": [[-200, -150], [200, -150], [200, 150], [-200, 150]], "thickness": 10}, "across"),
        ({"outline": [[-0.2, -0.15], [0.2, 0.15], [0.2, -0.15], [-0.2, 0.2]]}, "crosses itself"),
        ({"outline": [[0, 0], [1, float("nan")], [1, 1]]}, "finite"),
        ({"hole": [disc(centre=(0.19, 0))]}, "'disc'.*inside the outline"),
        ({"hole": [disc(), disc(centre=(-0.1, 0))]}, "two holes"),
        ({"hole": [disc(), disc("other", (0.06, 0.05))]}, "'disc' and 'other'"),
        ({"hole": [disc(radius=0)]}, "positive number"),
        ({"hole": [{"name": "x", "centre": [0, 0], "corners": [[0, 0]]}]}, "either corners"),
        ({"hole": [{"name": "x", "centre": [0, 0], "radius": 0.02, "segments": 3}]}, "segments"),
    ],
)
def test_bad_boards_are_refused_by_name(changes, words):
    """Every fault of a file is named."""
    with pytest.raises(ConfigError, match=words):
        board_from({**BLANK, **changes})


def test_a_missing_board_names_the_packaged_ones(tmp_path):
    """The hint lists what there is; broken TOML is called that."""
    with pytest.raises(ConfigError) as err:
        load_board("nosuch")
    assert "default" in err.value.hint
    (tmp_path / "b.toml").write_text("= 3")
    with pytest.raises(ConfigError, match="not TOML"):
        load_board(tmp_path / "b.toml")


def test_symmetry_is_seen():
    """A centred disc has a half turn; the packaged boards have none."""
    assert symmetries(board_from({**BLANK, "hole": [disc(centre=(0, 0))]})) == ["turn by 180 deg"]
    assert symmetries(load_board()) == symmetries(load_board("second")) == []


def test_inside_and_distance():
    """A square's inside and the distance to its border, by hand."""
    square = rectangle(2.0, 2.0)
    points = np.array([[0.0, 0.0], [0.9, 0.5], [2.0, 0.0], [2.0, 2.0]])
    assert inside(square, points).tolist() == [True, True, False, False]
    np.testing.assert_allclose(distance_to_ring(square, points), [1.0, 0.1, 1.0, np.sqrt(2)])


def test_svg_is_true_to_scale():
    """One user unit is a millimetre, and circles and polygons have the board's size."""
    board = load_board()
    root = ET.fromstring(svg(board))  # noqa: S314  our own text
    assert root.attrib["width"] == "520.0000mm"
    assert root.attrib["viewBox"].split()[2] == "520.0000"
    circles = [float(e.attrib["r"]) for e in root.iter("{http://www.w3.org/2000/svg}circle")]
    assert circles == [45.0, 30.0, 55.0]
    outline = next(root.iter("{http://www.w3.org/2000/svg}polygon")).attrib["points"]
    corners = np.array([[float(x) for x in p.split(",")] for p in outline.split()])
    np.testing.assert_allclose(np.ptp(corners, axis=0), [500, 400])


def test_dxf_reads_back():
    """It is R12; circles and corners are the board's, in millimetres, on the layer to cut."""
    board = load_board()
    drawing = ezdxf.read(StringIO(dxf(board)))
    assert drawing.dxfversion == "AC1009"
    assert all(shape.dxf.layer == "CUT" for shape in drawing.modelspace())
    assert [c.dxf.radius for c in drawing.modelspace().query("CIRCLE")] == [45.0, 30.0, 55.0]
    lines = list(drawing.modelspace().query("POLYLINE"))
    assert [len(line) for line in lines] == [4, 4, 3, 4, 4]
    assert all(line.is_closed for line in lines)
    np.testing.assert_allclose([v.dxf.location.vec2 for v in lines[0].vertices], 1e3 * board.outline)


def test_stl_encloses_the_boards_volume():
    """The triangles of the STL, read back, enclose the plate less its holes, in cubic millimetres."""
    board = load_board()
    data = stl(board)
    (count,) = struct.unpack_from("<I", data, 80)
    assert len(data) == 84 + 50 * count
    records = np.frombuffer(data[84:], dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    a, b, c = np.moveaxis(records["v"].astype(float), 1, 0)
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert enclosed == pytest.approx(1e9 * describe(board)["volume_m3"], rel=1e-5)


def test_board_command_writes_all_three(tmp_path):
    """The command writes what was asked for and describes the board."""
    names = [str(tmp_path / f"b.{kind}") for kind in ("svg", "dxf", "stl")]
    words = ["board", "--svg", names[0], "--dxf", names[1], "--stl", names[2]]
    outcome = calibrate(*words)
    assert all(Path(name).stat().st_size > 500 for name in names)
    assert "7 holes" in outcome.text
    assert outcome.data["symmetries"] == []


# Detection on what an ideal camera would see: rims by ray geometry, no renderer.


def sight_of(board: Board, T, *, noise=0.0002, bias=0.0, seed=0):
    """Rims and surface points of a board at ``T_camera_board``: silhouette edges, noise across the ray, ranges off by ``bias``."""
    rng = np.random.default_rng(seed)
    eye = invert(T)[:3, 3]
    rims = []
    for k, ring in enumerate(board.rings):
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            n = max(1, round(np.linalg.norm(b - a) / 0.003))
            at = a + (b - a) * rng.uniform(size=(n, 1))
            out = np.array([(b - a)[1], -(b - a)[0]]) * (1 if k == 0 else -1)
            wall = ((eye[:2] - at) @ out) > 0
            rims.append(np.column_stack([at, np.where(wall, 0.0, board.thickness)]))
    rims = np.concatenate(rims)
    rims[:, :2] += noise * rng.standard_normal((len(rims), 2))
    low, high = board.outline.min(axis=0), board.outline.max(axis=0)
    xy = rng.uniform(low, high, (6000, 2))
    xy = xy[Model(board).material(xy)]
    surface = transform_points(T, np.column_stack([xy, np.full(len(xy), board.thickness)]))
    surface *= 1 + (bias + 0.001 * rng.standard_normal((len(xy), 1))) / np.linalg.norm(
        surface, axis=1, keepdims=True
    )
    return Sight(transform_points(T, rims), surface, sigma=0.002, bias_sigma=0.02)


def pose(tilt=25.0, turn=40.0, lean=130.0, distance=0.75):
    """``T_camera_board``: the board tilted by ``tilt`` about an axis at ``lean``, turned in its plane."""
    t, a = np.radians(tilt), np.radians(lean)
    eye = distance * np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
    return invert(look_at(eye, [0.01, -0.01, 0.01], roll=np.radians(turn)))


@pytest.mark.parametrize(
    ("tilt", "turn", "lean"), [(25.0, 40.0, 130.0), (38.0, -100.0, 10.0), (3.0, 178.0, 0.0)]
)
def test_pose_is_found_whatever_the_range_error(tilt, turn, lean):
    """Any turn in the plane, ranges 8 mm too long: the pose comes from the rims, within 0.05 deg and 0.6 mm."""
    T = pose(tilt, turn, lean)
    found = detect(sight_of(load_board(), T, bias=0.008), load_board(), CAMERA)
    off = found.T_camera_board @ invert(T)
    assert np.degrees(rotation_angle(off)) < 0.05
    assert np.linalg.norm(found.T_camera_board[:3, 3] - T[:3, 3]) < 0.0006
    assert found.fit.bias == pytest.approx(0.008, abs=0.0008)
    assert len(found.holes) >= 6  # seen from the front, the middle disc shows nothing but its wall
    assert np.linalg.eigvalsh(found.fit.covariance).min() > 0


def test_the_stated_uncertainty_of_a_pose_covers_its_error():
    """Over 20 draws the errors of the six components are about as large as their stated standard deviations, each for itself."""
    model, T = Model(load_board()), pose()
    standardised = []
    for seed in range(20):
        fit = refine(model, sight_of(model.board, T, noise=0.0007, bias=0.004, seed=seed), T)
        turned = rotation_log(fit.T[:3, :3] @ T[:3, :3].T)
        off = np.concatenate([fit.T[:3, 3] - T[:3, 3], turned])
        standardised.append(off / np.sqrt(np.diag(fit.covariance)))
        assert np.sqrt(np.diag(fit.covariance)[:3]).max() < 0.001
    rms = np.sqrt(np.mean(np.square(standardised), axis=0))
    assert (rms < 1.5).all()
    assert (rms[2:] > 0.5).all()  # x and y hold a share that all rims of a camera have in common


def test_a_board_seen_from_behind_is_turned_over():
    """The mirrored pattern is the back: the pose says so."""
    T = pose() @ exp([0, 0, 0, np.pi, 0, 0])
    board = load_board()
    behind = sight_of(board_from(mirrored(board)), pose() @ np.eye(4))
    found = detect(behind, board, CAMERA)
    assert found.T_camera_board[:3, 2] @ T[:3, 2] > 0.99


def mirrored(board):
    """A board whose front is the other's back: y reversed."""
    flip = np.array([1.0, -1.0])
    return {
        **BLANK,
        "outline": (board.outline * flip).tolist(),
        "hole": [{"name": h.name, "corners": (h.corners * flip).tolist()} for h in board.holes],
    }


def test_two_boards_are_not_confused():
    """A board is found in its own view and refused by name in the other's."""
    first, second = load_board(), load_board("second")
    assert detect(sight_of(second, pose()), second, CAMERA).explained > 0.9
    with pytest.raises(QualityError, match="wrong board") as err:
        detect(sight_of(first, pose()), second, CAMERA)
    assert "two boards confused" in err.value.hint


def test_a_symmetric_board_is_ambiguous():
    """Two holes that a half turn swaps: both poses fit, so none is given."""
    holes = [disc("a", (0.1, 0.05)), disc("b", (-0.1, -0.05))]
    board = board_from({**BLANK, "hole": holes})
    with pytest.raises(QualityError, match="ambiguous: symmetric board"):
        detect(sight_of(board, pose()), board, CAMERA)


def test_a_plate_without_holes_has_none():
    """The same outline without cut-outs is refused as such."""
    plain = board_from(BLANK)
    board = board_from({**BLANK, "hole": [disc(), disc("b", (-0.1, -0.06), 0.04)]})
    with pytest.raises(QualityError, match="no holes visible"):
        detect(sight_of(plain, pose()), board, CAMERA)


def test_nothing_in_sight_is_no_plane():
    """Empty clouds, and a ball, are refused as no plane."""
    empty = Sight(np.zeros((0, 3)), np.zeros((0, 3)), 0.002, 0.02)
    with pytest.raises(QualityError, match="no plane"):
        detect(empty, load_board(), CAMERA)


def test_model_distance_has_its_gradient():
    """The signed distance grows by one per metre along its gradient, and is negative on the material."""
    model = Model(load_board())
    xy = np.random.default_rng(1).uniform([-0.27, -0.22], [0.27, 0.22], (400, 2))
    e = model.edges(xy)
    ahead = model.edges(xy + 1e-6 * e.gradient).distance
    np.testing.assert_allclose((ahead - e.distance) / 1e-6, 1, atol=1e-3)
    np.testing.assert_array_equal(e.distance < 0, model.material(xy))


def test_rays_meet_the_front():
    """Rays through points of the front come back as those points."""
    T, board = pose(), load_board()
    xy = np.array([[0.1, 0.02], [-0.2, 0.15]])
    X = transform_points(T, np.column_stack([xy, np.full(2, board.thickness)]))
    np.testing.assert_allclose(on_front(T, board, 3 * X), xy, atol=1e-12)


# Coverage


def test_coverage_names_what_is_missing():
    """One frontal view misses everything; nine views all round at two distances miss nothing but corners of the image."""
    outline = load_board().outline
    one = missing(coverage([pose(2.0)], CAMERA, outline))
    assert len(one) >= 4
    assert any("tilts" in m for m in one)
    poses = [pose(28.0, 45.0 * i, 0.0, 0.5 + 0.05 * i) for i in range(9)]
    many = coverage(poses, CAMERA, outline)
    assert sum(n > 0 for n in many["sectors"].values()) >= 6
    assert missing(many) == []
    np.testing.assert_allclose(many["tilt_deg"], 28.0, atol=3.0)
    assert "9 board views, 0.50 to 0.90 m" in meter(many)
    answers.hold(
        "coverage",
        {"one": coverage([pose(2.0)], CAMERA, outline), "look": one, "many": many, "meter": meter(many)},
    )


def test_coverage_of_nothing():
    """No view yet: any view is missing."""
    none = coverage([], CAMERA, load_board().outline)
    assert missing(none) == ["any board view"]
    assert meter(none) == "no board views yet"


def test_circle_segments_are_inside_the_circle():
    """The facets of a hole lie on its circle."""
    hole = load_board().holes[0]
    np.testing.assert_allclose(np.linalg.norm(hole.corners - hole.centre, axis=1), hole.radius)
    assert re.fullmatch(r"[a-z ]+", hole.name)
    np.testing.assert_allclose(hole.corners, circle(0.045, (-0.16, 0.11), 64))
