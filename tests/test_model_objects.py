"""Pixels of objects, sheets and table are told apart by their height, and errors are told by object and camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from benchmarks import shifts
from tofcapture.channels import frequencies, unambiguous
from tofcapture.devices.sim.config import read_constants
from tofcapture.poses import rotation_exp
from tofcapture.suites.capture import layered
from tofcapture_model.evaluation.objects import (
    HEIGHT,
    Objects,
    Tally,
    classes,
    find_support,
    spread,
    tally,
    told,
)
from tofcapture_model.frame import Target
from tofcapture_model.geometry.maps import expect_usable, rays, scale_intrinsics

H, W = 45, 60
INTRINSICS = torch.tensor([[48.0, 50.0, 29.0, 22.0]])


def scene(tilt, paper=0.001, box=0.03, noise=0.0, crop=0.0005):
    """A table seen from 0.8 m, a sheet on its left and a box on its right; ground truth as a dataset masks it."""
    normal = torch.from_numpy(rotation_exp([tilt, 0.3 * tilt, 0.0]) @ np.array([0, 0, -1.0]))
    towards = rays(scale_intrinsics(INTRINSICS, 2), 2 * H, 2 * W)[0].double()
    table = float(normal @ torch.tensor([0, 0, 0.8], dtype=torch.float64))
    height = torch.zeros(2 * H, 2 * W, dtype=torch.float64)
    height[30:60, 20:50], height[30:60, 65:90] = paper, box
    along = (towards * normal[:, None, None]).sum(0)
    depth = (table + height) / along
    measured = depth + noise * torch.from_numpy(np.random.default_rng(0).standard_normal(depth.shape))
    good = height > crop
    normals = normal[:, None, None].expand(3, 2 * H, 2 * W).float()
    target = Target(measured.float()[None, None], normals[None], good[None, None], ~good[None, None])
    return target, height[None, None]


@pytest.mark.parametrize("tilt", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("noise", [0.0, 0.0003])
def test_a_sheet_of_paper_is_no_object_and_a_box_is(tilt, noise):
    """Whatever the view, pixels are told apart by their true height; shares add up to the crop."""
    target, height = scene(tilt, noise=noise)
    found = classes(target, INTRINSICS, find_support(target, INTRINSICS))
    wrong = found["object"] ^ (height >= HEIGHT)
    assert wrong.float().mean() < 1e-3
    assert int((found["object"] | found["sheet"]).sum()) == int(target.good.sum())
    assert not (found["object"] & found["sheet"]).any()
    assert found["support"].sum() > 0.9 * (height == 0).sum()


def test_a_wall_behind_the_table_is_not_what_objects_stand_on():
    """A third of what is around the crop may be something else."""
    target, height = scene(0.3)
    depth = target.depth.clone()
    depth[..., :20] += 0.4
    found = classes(
        target._replace(depth=depth), INTRINSICS, find_support(target._replace(depth=depth), INTRINSICS)
    )
    assert torch.equal(found["object"], height >= HEIGHT)


def test_without_a_surface_around_all_of_the_crop_is_the_object():
    """Rooms and single objects of other people's data have no table."""
    target, _ = scene(0.3)
    everything = target._replace(good=target.good | target.context, context=torch.zeros_like(target.good))
    assert find_support(everything, INTRINSICS) is None
    assert torch.equal(classes(everything, INTRINSICS, None)["object"], everything.good)


def test_rough_ground_truth_raises_the_height_of_an_object():
    """Where the ground truth scatters by 2 mm, 4 mm above the table are noise, and 8 mm are none."""
    target, _ = scene(0.0, box=0.007, noise=0.002)
    support = find_support(target, INTRINSICS)
    assert 0.0008 < support.sigma < 0.0025
    with_noise = classes(target, INTRINSICS, support._replace(sigma=0.002))
    assert (
        with_noise["object"].sum()
        < 0.4 * classes(target, INTRINSICS, support._replace(sigma=0.0))["object"].sum()
    )


def measured(target, off, sigma):
    """Answer that lies ``off`` metres behind the truth."""
    return target.depth + off, target.normals, torch.full_like(target.depth, sigma)


def test_tallies_add_over_views_and_scale_with_lengths():
    """A tally of two halves is that of the whole; twice the error is twice the MAE; sigma holds what it holds."""
    target, _ = scene(0.2)
    left = target.good & (torch.arange(2 * W) < W)
    answer = measured(target, 0.003, 0.004)
    whole, halves = (
        tally(*answer, target, target.good),
        (tally(*answer, target, m) for m in (left, target.good & ~left)),
    )
    both = sum(halves, Tally())
    assert both.row() == pytest.approx(whole.row(), rel=1e-6)
    assert whole.row()["mae"] == pytest.approx(0.003, rel=1e-3)
    assert (whole.row()["within_sigma"], whole.row()["angle"]) == (1.0, pytest.approx(0, abs=1e-3))
    assert tally(*measured(target, 0.006, 0.004), target, target.good).row()["within_sigma"] == 0
    assert "within_sigma" not in tally(*answer[:2], None, target, target.good).row()


def test_pixels_without_an_answer_are_wanted_and_in_no_mean():
    """NaN lowers the number of pixels, not the error."""
    target, _ = scene(0.2)
    depth, normals, sigma = measured(target, 0.003, 0.004)
    depth[..., ::2] = math.nan
    found = tally(depth, normals, sigma, target, target.good)
    assert 0 < found.pixels < found.wanted == int(target.good.sum())
    assert found.row()["mae"] == pytest.approx(0.003, rel=1e-3)


def test_the_worst_object_and_the_worst_camera_are_named():
    """One bad object among many good ones does not vanish in a pooled mean."""
    target, _ = scene(0.2)
    objects = Objects({f"s{k}": f"camera {k % 2}" for k in range(5)})
    for k in range(5):
        where = {"object": target.good}
        objects.add(f"s{k}", "sensor", (*measured(target, 0.010, 1.0)[:2], None), target, where)
        objects.add(f"s{k}", "model", measured(target, 0.002 if k else 0.015, 0.003), target, where)
    table = objects.table()
    said = table["spread"]["model"]["mae"]
    assert (said["worst_of"], said["worst"], said["median"]) == (
        "s0",
        pytest.approx(1.5, rel=1e-3),
        pytest.approx(0.2, rel=1e-2),
    )
    assert set(table["cameras"]) == {"camera 0", "camera 1"}
    assert table["cameras"]["camera 1"]["model"]["within_sigma"] == 1
    assert any("s0" in line for line in told(table))
    assert spread({}) == {}


def test_every_shift_is_a_camera_that_can_be_simulated_and_decoded():
    """Constants are read, channels decode, lenses unfold; the light that is kept has all frequencies that rows ask for."""
    for name, row in {**shifts.ROWS, **shifts.PIXELS}.items():
        sim = layered(shifts.station_sim(), shifts.STANDS[row.stand].sim, row.sim)
        constants = read_constants(sim, name)
        assert set(constants.sensor.modulation_hz) <= set(
            shifts.HZ if row.stand == "base" else shifts.PAPER_HZ
        )
        expect_usable(constants.tof)
        assert unambiguous(frequencies(constants.sensor.modulation_hz)) > 2, name


def test_the_table_of_shifts_begins_with_the_worst_and_names_camera_and_object():
    """A row that is worse than the sensor is the first; rows of drawn cameras are told one by one."""

    def row(scene, camera, error):
        told = {"wanted": 10, "pixels": 10, "square": 1.0, "angle": 1.0, "told": 10, "inside": 7}
        return {
            "scene": scene, "view": 0, "camera": camera, "farthest": 1.0, "sensor": {**told, "error": 0.1},
            "network": {**told, "error": error}, "trusted": {**told, "error": error},
        }  # fmt: skip

    found = {
        "as trained": [row("a", 1, 0.03)],
        "wall": [row("a", 1, 0.2)],
        "60 MHz alone": [row("a", 1, 0.1)],
    }
    lines = shifts.table(found | {"cameras": [row("a", "left", 0.03), row("b", "right", 0.05)]}).splitlines()
    assert [line.split("  ")[0] for line in lines[2:5]] == ["wall", "60 MHz alone", "as trained"]
    assert "2.00" in lines[2]
    assert sum(line.startswith(("left", "right")) for line in lines) == 2
    assert any("worst 0.50" in line for line in lines)
