"""The bundled network: it is there, it is what its card says, and it holds its ratios on scenes it has never seen."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
from importlib.resources import files

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.bundled_answer import KEPT, answer
from tofcapture.cli import main
from tofcapture.files.manifest import load_manifest
from tofcapture_model.config import loads_config, preset
from tofcapture_model.evaluation.suite import run_suite
from tofcapture_model.inference.export import example
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint

CARD = files("tofcapture_model") / "weights" / "MODEL_CARD.md"
LARGEST = 16 * 2**20  # bytes


def test_the_bundled_network_is_the_preset_compact_and_finite():
    """Loaded without a path: the network of `compact`, half-precision file, float32 model, a finite answer at twice the size."""
    model, config, provenance = load_checkpoint(None)
    assert config.network == preset("compact").network
    assert find_model(None).stat().st_size < LARGEST
    assert loads_config(find_model(None).with_suffix(".toml").read_text(encoding="utf-8")) == config
    assert all(p.dtype == torch.float32 for p in model.parameters())
    with torch.no_grad():
        found = model(example(1))
    assert found.depth.shape == (1, 1, 360, 480)
    assert all(bool(torch.isfinite(x).all()) for x in found)
    assert provenance["steps"] > 1000


def test_every_level_of_it_has_a_say():
    """Without what comes up from a level it answers otherwise: from the deepest two nothing came in the networks before, whose units had died."""
    model, data = load_checkpoint(None)[0].eval(), example(1)
    with torch.no_grad():
        whole = model(data)
        for up in model.backbone.up:
            silenced = up.register_forward_hook(lambda _module, _inputs, out: torch.zeros_like(out))
            part = model(data)
            silenced.remove()
            assert (part.depth - whole.depth).abs().mean() > 2e-5
            assert (part.normals - whole.normals).abs().mean() > 1e-3


def test_the_card_names_the_data_that_the_weights_remember():
    """Digest of the manifest, steps and the factor of the uncertainty stand in the card as in the file."""
    provenance = load_checkpoint(None)[2]
    text = CARD.read_text(encoding="utf-8")
    assert provenance["manifest_sha256"][:16] in text
    assert all(digest[:16] in text for digest in provenance["also"].values())
    assert f"{provenance['steps']:,} steps" in text
    assert f"{provenance['uncertainty']['factor']:.2f}" in text


def test_it_answers_as_when_it_was_measured():
    """A sign, a shift by half a pixel or another order anywhere in what it reads, and it answers differently: then it is not what the tables tell of."""
    now = answer()
    with np.load(KEPT) as kept:
        change = {name: float(np.median(np.abs(now[name] - kept[name]))) for name in kept.files}
    assert change["depth"] < 2e-5
    assert change["normals"] < 5e-4
    assert change["error"] < 2e-5


@pytest.mark.slow
def test_it_beats_the_sensor_by_far_on_the_scenes_that_are_hardest(tmp_path):
    """Eight views by a camera it has not seen, half of them of hollow bowls and mugs; benchmarks/RESULTS.md has what to expect of others."""
    out = tmp_path / "data"
    line = ["simulate-dataset", "--seed", "9090", "--scenes", "4", "--views", "2", "--frames", "1"]
    kinds = ["--kinds", "object", "combination", "concave", "corner"]
    assert main([*line, *kinds, "--split", "test", "--jobs", "1", "--out", str(out), "--json"]) == 0
    assert len(load_manifest(out).split("test")) == 4
    run_suite(out, "main", {"bundled": [find_model(None)]}, tmp_path / "results.json")
    methods = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["methods"]
    model, sensor = ({**methods[name]["depth"]["pixel"]} for name in ("bundled", "sensor"))
    assert model["mae"] < 0.6 * sensor["mae"]
    assert model["sq"] < 0.5 * sensor["sq"]
    assert model["rmse"] < 0.7 * sensor["rmse"]
    angles = [methods[name]["normal"]["pixel"]["mean_deg"] for name in ("bundled", "sensor")]
    assert angles[0] < 0.75 * angles[1]
    assert 0.3 < methods["bundled"]["extra"]["coverage_1sigma"] < 0.9
