"""``calibrate hand-eye``: the files it reads, what it writes, and what it refuses."""

from __future__ import annotations

import argparse
import json

import numpy as np
import pytest

from calibration.cli import calibrate as calibrate_cli
from calibration.hand_eye.files import read_csv, read_pairs
from tests.hand_eye import apart, station, streams
from tofcapture.errors import DataError, FormatError, UsageError
from tofcapture.poses import invert


def args(*words):
    parser = argparse.ArgumentParser()
    calibrate_cli.COMMAND.configure(parser)
    return parser.parse_args([str(w) for w in words])


def test_command_reads_pairs_and_writes_json(tmp_path):
    """calibrate hand-eye takes JSON pairs and CSV pairs alike, prints a table and writes the same numbers."""
    from scipy.spatial.transform import Rotation

    A, B, X = station(7)
    (tmp_path / "pairs.json").write_text(
        json.dumps([[a.tolist(), b.tolist()] for a, b in zip(A, B, strict=True)])
    )
    for name, T in (("hand.csv", A), ("target.csv", B)):
        rows = np.c_[np.arange(len(T)), T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()]
        np.savetxt(
            tmp_path / name, rows, delimiter=",", header="t,x,y,z,qx,qy,qz,qw", fmt="%.12f", comments=""
        )
    out = tmp_path / "result.json"
    one = calibrate_cli.COMMAND.run(args("hand-eye", tmp_path / "pairs.json", "--out", out))
    two = calibrate_cli.COMMAND.run(args("hand-eye", tmp_path / "hand.csv", tmp_path / "target.csv"))
    written = json.loads(out.read_text())
    np.testing.assert_allclose(written["T_flange_camera"], two.data["T_flange_camera"], atol=1e-8)
    assert apart(np.array(written["T_flange_camera"]), X)[1] < 0.002
    assert "standard error" in one.text
    assert written["leave_one_out"] is not None
    inverted = tmp_path / "inverted.json"
    inverted.write_text(json.dumps([[a.tolist(), invert(b).tolist()] for a, b in zip(A, B, strict=True)]))
    same = calibrate_cli.COMMAND.run(args("hand-eye", inverted, "--inverted-target"))
    np.testing.assert_allclose(same.data["T_flange_camera"], written["T_flange_camera"], atol=1e-6)


def test_command_finds_the_offset_of_streams(tmp_path):
    """Two CSV streams with clocks apart are brought together and solved in one call."""
    from scipy.spatial.transform import Rotation

    hand, target, X = streams(0.25)
    for name, stream in (("hand.csv", hand), ("target.csv", target)):
        T = stream.poses
        np.savetxt(
            tmp_path / name,
            np.c_[stream.seconds, T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()],
            fmt="%.9f",
        )
    data = calibrate_cli.COMMAND.run(args("hand-eye", tmp_path / "hand.csv", tmp_path / "target.csv")).data
    assert abs(data["time_offset_s"] - 0.25) < 0.002
    assert apart(np.array(data["T_flange_camera"]), X)[1] < 0.002


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("", FormatError),
        ("[]", DataError),
        ("{}", FormatError),
        ("[[1, 2]]", FormatError),
        ("[[[[1]], [[2]]]]", FormatError),
    ],
)
def test_bad_pair_files_are_named(tmp_path, text, kind):
    """Files that hold no pairs say so with their path."""
    path = tmp_path / "pairs.json"
    path.write_text(text)
    with pytest.raises(kind, match=r"pairs\.json"):
        read_pairs(path)
    with pytest.raises(DataError, match="no such file"):
        read_pairs(tmp_path / "none.json")


@pytest.mark.parametrize(
    "text", ["", "t,x\n", "0,1,2,3,0,0,0,1\n0,1,2\n", "0,1,2,3,1,1,0,1\n", "0,nan,2,3,0,0,0,1\n"]
)
def test_bad_csv_files_are_named(tmp_path, text):
    """Streams with missing columns, NaN or quaternions that are none say so with their path."""
    path = tmp_path / "hand.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=r"hand\.csv"):
        read_csv(path)


def test_command_refuses_three_files():
    """More than two files are a usage error."""
    with pytest.raises(UsageError):
        calibrate_cli.COMMAND.run(args("hand-eye", "a.csv", "b.csv", "c.csv"))
