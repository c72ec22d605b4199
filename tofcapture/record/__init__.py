"""Recording: plan the views of a scene, take them, never twice, never half."""

from tofcapture.libraries import called

called(__name__, "tofcapture.record.recorder:record")
