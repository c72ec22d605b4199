"""A recording and a dataset as they are sealed, and ways to damage them that only deep checks find."""

from __future__ import annotations

import h5py
import numpy as np

from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scenes import TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.world import SimWorld
from tofcapture.files.seal import digest_path, sha256_of
from tofcapture.frames import ArmState, View
from tofcapture.poses import invert, look_at

SMALL = {
    "tof": {"width": 40, "height": 30, "fx": 31.8, "fy": 33.4, "cx": 19.5, "cy": 16.9},
    "stereo": {"width": 160, "height": 128, "fx": 144.0, "fy": 144.0, "cx": 79.5, "cy": 63.5},
    "render": {"multipath": False, "subpixels": 1},
}


def simulate(scene, index):
    world = SimWorld(read_constants(SMALL, "test"), 0, scene_objects)
    target = np.asarray(TABLE_CENTRE) + np.array([0, 0, 0.03])
    T_base_tof = look_at(target + np.array([0.1 * index, 0.15, 0.45]), target)
    T_base_flange = T_base_tof @ invert(world.true_rig.T_flange_tof)
    world.place(scene)
    world.set_pose(T_base_flange, bytes([index]))
    times = iter(range(1, 10**9, 10**6))
    burst, stereo = world.tof(2, times.__next__), world.stereo(times.__next__)
    state = ArmState(np.zeros(6), T_base_flange, 5)
    return View(scene, index, burst, stereo, state, state, world.nominal_rig(), {}, world.truth())


def reseal(path):
    """Make the stored digest agree with damaged bytes, so that deeper checks have to find the damage."""
    digest_path(path).write_text(f"{sha256_of(path)}  {path.name}\n")


def edit(path, change):
    path.chmod(0o644)
    with h5py.File(path, "a") as file:
        change(file)
    reseal(path)


def set_attr(name, value):
    return lambda f: f.attrs.__setitem__(name, value)


def set_array(name, index, value):
    return lambda f: f[name].__setitem__(index, value)


def delete(name):
    return lambda f: f.__delitem__(name)


def replaced(name, array):
    def change(file):
        units = file[name].attrs["units"]
        del file[name]
        file[name] = array
        file[name].attrs["units"] = units

    return change
