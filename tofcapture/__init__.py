"""Capture paired time-of-flight raw data and stereo ground truth, and build datasets from them.

::

    view = tofcapture.open_view("recording/views/mug/view-000.h5")
    tofcapture.build_dataset("recording", "dataset")
    sample = tofcapture.Dataset("dataset")[0]

What people call is named here. Importing this package loads nothing else, so that a reader of the data needs numpy and h5py only.
"""

from typing import TYPE_CHECKING

from tofcapture.libraries import face as _face

if TYPE_CHECKING:
    from tofcapture.cli.kit import progress
    from tofcapture.dataset.build import build_dataset
    from tofcapture.dataset.reader import Dataset
    from tofcapture.devices.sim.world import simulate
    from tofcapture.files.shard import open_shard
    from tofcapture.files.view import open_view
    from tofcapture.importing.views import import_data
    from tofcapture.record.recorder import record
    from tofcapture.rig import load_rig

    open_dataset = Dataset

__version__ = "0.1.0"
__all__ = [
    "Dataset",
    "build_dataset",
    "import_data",
    "load_rig",
    "open_dataset",
    "open_shard",
    "open_view",
    "progress",
    "record",
    "simulate",
]
_HOMES = {
    "Dataset": "dataset.reader",
    "build_dataset": "dataset.build",
    "import_data": "importing.views",
    "load_rig": "rig",
    "open_dataset": "dataset.reader:Dataset",
    "open_shard": "files.shard",
    "open_view": "files.view",
    "progress": "cli.kit",
    "record": "record.recorder",
    "simulate": "devices.sim.world",
}
__getattr__, __dir__ = _face(__name__, _HOMES)
