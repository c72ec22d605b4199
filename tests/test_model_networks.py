"""The U-Net, the heads, the model and its configuration."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import subprocess
import sys
from binascii import crc32
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from tofcapture.errors import ConfigError
from tofcapture_model.config import (
    Config,
    Network,
    Stage,
    config_from_dict,
    dumps_config,
    load_config,
    loads_config,
    preset,
    presets,
)
from tofcapture_model.frame import Frame
from tofcapture_model.networks import build_model, select_stage
from tofcapture_model.networks.baselines import sensor_estimate, upsample_depth
from tofcapture_model.networks.joint import CompactModel, PaperModel
from tofcapture_model.networks.unet import UNet, bilinear_logits, convex_upsample, pad_to_multiple

TINY_PAPER = Network(width=2, levels=3, refine_iterations=1)
TINY_COMPACT = replace(preset("demo").network, width=4, levels=2, refine_iterations=1)


# crc32 of every preset as TOML. Published weights and tables were made with these: a change belongs in the CHANGELOG.
PRESETS = {
    "coarse-fine": 1810403291,
    "compact": 1015119486,
    "demo": 2211839134,
    "fine-tune": 3657974975,
    "guo2018": 240442473,
    "paper": 1781946701,
    "su2018": 2850299000,
}


def four_phases():
    """(4, 8) matrix of I and Q of two frequencies, each at 0, 90, 180, 270 degrees."""
    pair = torch.tensor([[0.5, 0, -0.5, 0], [0, -0.5, 0, 0.5]])
    return torch.block_diag(pair, pair)


def joint(network):
    """Our model of a kind."""
    return (CompactModel if network.kind == "compact" else PaperModel)(network)


def frame(h=36, w=44, batch=2, seed=0):
    """A frame of random numbers that could be one."""
    g = torch.Generator().manual_seed(seed)
    depth = 0.8 + 0.1 * torch.rand(batch, 1, h, w, generator=g)
    k = torch.tensor([[40.0, 40.0, (w - 1) / 2, (h - 1) / 2]]).expand(batch, 4)
    return Frame(
        raw=torch.rand(batch, 8, h, w, generator=g),
        phasor=torch.randn(batch, 4, h, w, generator=g) * 0.1,
        depth=depth,
        valid=torch.ones_like(depth),
        confidence=torch.rand(batch, 1, h, w, generator=g),
        gap=0.05 * torch.randn(batch, 1, h, w, generator=g),
        cues=0.01 * torch.randn(batch, 5, h, w, generator=g),
        modulation=torch.tensor([[20e6, 100e6]]).expand(batch, 2),
        intrinsics=k,
        demodulation=four_phases().expand(batch, 4, 8),
        light=torch.tensor([[0.055, 0.04]]).expand(batch, 2),
        noise=torch.zeros(batch, 5),
    )


def test_the_plain_u_net_has_the_known_number_of_parameters():
    """10 to 1 channels at base 64: 31,035,777; at base 32: 7,762,113."""
    assert sum(p.numel() for p in UNet(10, 1, 64).parameters()) == 31_035_777
    assert sum(p.numel() for p in UNet(10, 1, 32).parameters()) == 7_762_113


@pytest.mark.parametrize("size", [(180, 240), (17, 5), (16, 16)])
def test_the_u_net_takes_any_size(size):
    """Images are padded to multiples of 16 and cropped after."""
    net = UNet(3, 2, width=2)
    assert net(torch.zeros(1, 3, *size)).shape == (1, 2, *size)


def test_padding_reflects_and_reports_where_the_image_went():
    """180 rows become 192, six on each side, mirrored."""
    image = torch.rand(1, 1, 180, 240)
    padded, (top, left) = pad_to_multiple(image, 16)
    assert padded.shape[-2:] == (192, 240)
    assert (top, left) == (6, 0)
    assert torch.equal(padded[..., 6:186, :], image)
    assert torch.equal(padded[..., 5, :], image[..., 1, :])


def test_convex_upsampling_starts_as_bilinear_and_never_overshoots():
    """The bias makes bilinear weights; whatever the logits, values stay inside their neighbourhood."""
    image = torch.rand(1, 1, 12, 14)
    logits = bilinear_logits().reshape(1, 36, 1, 1).expand(1, 36, 12, 14)
    bilinear = torch.nn.functional.interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(convex_upsample(image, logits), bilinear, atol=1e-4, rtol=0)
    wild = convex_upsample(image, 10 * torch.randn(1, 36, 12, 14, generator=torch.Generator().manual_seed(0)))
    assert wild.min() >= image.min()
    assert wild.max() <= image.max() + 1e-6


@pytest.mark.parametrize("network", [TINY_PAPER, TINY_COMPACT])
def test_an_untrained_model_is_the_sensor(network):
    """Zero-initialised heads: depth is the bilinear decoded depth, normals are unit and face the camera, before refinement and after."""
    data = frame()
    found = joint(network)(data)
    bilinear = torch.nn.functional.interpolate(
        data.depth, scale_factor=2, mode="bilinear", align_corners=False
    )
    torch.testing.assert_close(found.initial_depth, bilinear, atol=1e-5, rtol=0)
    assert (found.depth - bilinear).abs().max() < 0.02  # as far as a vote may lie
    torch.testing.assert_close(found.normals.norm(dim=1), torch.ones(2, 72, 88))
    assert found.normals[:, 2].max() < 0
    assert (found.error > 0).all()


@pytest.mark.parametrize("network", [TINY_PAPER, TINY_COMPACT])
@pytest.mark.parametrize("stage", ["depth", "normal", "refine", "joint"])
def test_every_stage_trains_its_parts_and_no_others(network, stage):
    """A stage's parameters get gradients, the others are frozen."""
    model = joint(network)
    learning = {id(p) for p in select_stage(model, stage)}
    out = model(frame(), stage)
    (out.depth.square().mean() + out.normals.mean() + out.error.mean()).backward()
    for name, parameter in model.named_parameters():
        assert (id(parameter) in learning) == parameter.requires_grad, name
        assert (parameter.grad is not None) <= parameter.requires_grad, name
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters())


def test_the_residual_is_bounded_where_asked():
    """compact cannot move a depth by more than max_residual, nor by more than noise and expected multipath allow."""
    model = joint(replace(TINY_COMPACT, max_residual=0.02, refine_iterations=0))
    with torch.no_grad():
        model.raw2depth.net.bias[model.raw2depth.candidates] = 1e6
    data = frame()
    data = data._replace(depth=torch.full_like(data.depth, 0.8), cues=torch.zeros_like(data.cues))
    torch.testing.assert_close(
        model(data).depth, torch.full((2, 1, 72, 88), 0.801)
    )  # nothing says it is wrong
    data.cues[:, 0] = 0.1
    torch.testing.assert_close(model(data).depth, torch.full((2, 1, 72, 88), 0.82))
    data.valid[:] = 0  # what was not measured may be anywhere
    assert (model(data).depth > 1.2).all()


def test_the_paper_s_networks_read_the_inputs_of_the_ablation():
    """Raw only, as in table IV, is 8 channels; all are 10."""
    assert joint(replace(TINY_PAPER, inputs=("raw",))).inputs.channels == 8
    assert joint(TINY_PAPER).inputs.channels == 10


@pytest.mark.parametrize(
    ("inputs", "sees"), [(("raw",), False), (("confidence",), False), (("raw", "depth"), True)]
)
def test_rows_without_depth_do_not_see_it(inputs, sees):
    """Another decoded depth changes the answer of a network that reads it, and nothing of one that does not."""
    torch.manual_seed(0)
    model = joint(replace(TINY_PAPER, inputs=inputs)).eval()
    for part in (model.raw2depth, model.error_map, model.raw2normal):
        torch.nn.init.normal_(part.net.last.weight, std=0.05)
    one = frame()
    with torch.no_grad():
        a, b = model(one), model(one._replace(depth=one.depth + 0.1))
    same = [
        x is y or torch.equal(x, y) for x, y in zip(a, b, strict=True)
    ]  # what a network does not say is None in both
    assert all(same) != sees


def test_sensor_upsampling_is_bilinear_on_surfaces_and_nearest_at_jumps():
    """No point in the air arises between foreground and background."""
    depth = 0.8 + 0.001 * torch.arange(8.0).reshape(1, 1, 1, 8).expand(1, 1, 6, 8)
    inner = upsample_depth(depth)[0, 0, 4, 2:14]
    torch.testing.assert_close(inner.diff(), torch.full((11,), 0.0005), atol=1e-6, rtol=0)
    step = torch.where(torch.arange(8) < 4, 0.5, 1.0).reshape(1, 1, 1, 8).expand(1, 1, 6, 8)
    assert set(upsample_depth(step).unique().tolist()) == {0.5, 1.0}


def test_the_sensor_baseline_says_where_it_measured():
    """Filled holes are answered, but not counted as measured."""
    data = frame(batch=1)
    data.valid[..., 3, 4] = 0
    depth, normals, measured = sensor_estimate(data)
    assert depth.shape == (1, 1, 72, 88)
    assert normals.shape == (1, 3, 72, 88)
    assert (~measured).sum() == 4


@pytest.mark.parametrize("name", presets())
def test_presets_load_and_survive_their_toml(name):
    """What is written is read back as it was."""
    assert loads_config(dumps_config(preset(name))) == preset(name)


def test_the_paper_preset_is_the_paper():
    """Three U-Nets of base 64, delta 20 mm, jitter 10 mm, Adam 1e-4, 230 and 460 epochs."""
    config = preset("paper")
    assert (config.network.kind, config.network.width, config.network.levels) == ("paper", 64, 5)
    assert (config.losses.delta, config.losses.jitter) == (0.020, 0.010)
    assert [(s.name, s.epochs, s.learning_rate) for s in config.stages[:2]] == [
        ("depth", 230, 1e-4),
        ("normal", 460, 1e-4),
    ]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[network]\nwidht = 3", "widht"),
        ("[nettwork]", "nettwork"),
        ("[network]\nwidth = 1.5", "width"),
        ('preset = "huge"', "huge"),
        ('[network]\nkind = "compact"', "stages"),
        ("[[stage]]\nname = 1", "stage"),
        ("[losses]\ndelta = -1.0", "delta"),
        ("[training]\ncrop = [16, 16]", "crop"),
        ("= 3", "TOML"),
        ("[network]\nrefine_iterations = 0", "refine"),
        ("[training]\ncrop = [48.5, 64.0]", "crop"),
        ("[training]\ncrop = [[48], [64]]", "crop"),
        ("[network]\nwindows = ['a']", "windows"),
        ("preset = 'compact'\n[network]\nwindows = []", "windows"),
        ("preset = 'compact'\n[network]\ninputs = ['raw']", "inputs"),
        ("preset = 'su2018'\n[losses]\ndelta = 0.1", "losses"),
        ("stage = 3", "stage"),
        ("[training]\nseed = -1", "seed"),
        ("[training]\nvalidate_every = -1", "validate_every"),
        ("[losses]\nchamfer = nan", "chamfer"),
        ("[losses]\ndelta = inf", "delta"),
        ("[losses]\nchamfer_distance = 'line'", "chamfer_distance"),
        ("[losses]\ndepth = 0\nchamfer = 0\nerror = 0\nnormal = 0", "losses"),
    ],
)
def test_wrong_configurations_are_refused_by_name(text, named):
    """Unknown keys, wrong types and contradictions are errors that name their place."""
    with pytest.raises(ConfigError, match=named):
        loads_config(text)


def test_a_configuration_holds_only_differences(tmp_path):
    """One changed key leaves the rest of the preset alone."""
    (tmp_path / "mine.toml").write_text('preset = "demo"\n[losses]\ndelta = 1\n')
    config = load_config(tmp_path / "mine.toml")
    assert config == replace(preset("demo"), losses=replace(preset("demo").losses, delta=1.0))
    with pytest.raises(ConfigError, match="cannot read"):
        load_config(tmp_path / "other.toml")
    assert config_from_dict({}) == Config()
    assert Stage("joint", 1).learning_rate == 1e-4


def test_commands_are_light_to_import():
    """The command line loads neither torch nor open3d before a command runs."""
    code = "import sys, tofcapture_model.cli; print([m for m in ('torch', 'open3d', 'scipy', 'h5py') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_models_are_built_alike_from_the_same_seed():
    """Weights depend on the seed and on nothing else."""
    states = []
    for _ in range(2):
        torch.manual_seed(3)
        states.append(build_model(preset("demo")).state_dict())
    assert all(torch.equal(states[0][k], states[1][k]) for k in states[0])


def test_presets_mean_what_they_meant():
    """Every value of every preset, defaults included, is the one that the published runs used."""
    assert {name: crc32(dumps_config(preset(name)).encode()) for name in presets()} == PRESETS
    assert preset("paper").losses == Config().losses
    assert {stage.learning_rate for stage in preset("paper").stages} == {Stage("joint", 1).learning_rate}
