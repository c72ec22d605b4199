"""Raw bytes of cameras, written from their descriptions by encoders of this file alone, become the frames they were."""

from __future__ import annotations

import numpy as np
import pytest

from tofcapture.devices.sim.config import read_constants
from tofcapture.errors import ConfigError, FormatError
from tofcapture.files.view import find_views, open_view
from tofcapture.importing.readers.vendors import LAYOUTS, decode
from tofcapture.importing.said import Said
from tofcapture.importing.views import import_data

C = 299_792_458.0


def frames(mhz, deg, shape, amplitude=300.0, middle=0.0, seed=0):
    """Whole-numbered taps (K, H, W) of a slanted wall."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]] / shape[1] - 0.5
    r = (1.0 + 0.3 * u + 0.2 * v) * np.sqrt(1 + u**2 + v**2)
    taps = [
        middle + amplitude * np.cos(4 * np.pi * f * 1e6 / C * r + np.radians(p)) for f in mhz for p in deg
    ]
    noise = np.random.default_rng(seed).normal(0, 1, (len(taps), *shape))
    return np.rint(np.stack(taps) + noise).astype(np.int64)


def y12p(pixels):
    """Two pixels in three bytes: high bytes, then both low halves."""
    a, b = pixels.reshape(-1, 2).T
    return np.stack([a >> 4, b >> 4, (b & 15) << 4 | a & 15], axis=1).astype(np.uint8).tobytes()


def arducam_b0410():
    """Four packed frames in turn, eleven bits and a sign."""
    raw = frames([75], [0, 90, 180, 270], (180, 240))
    return raw, y12p(raw & 0x7FF)


def arducam_b0548_double(pitch=481):
    """Eight images of 16 bits in 4810 rows, metadata between them."""
    raw = frames([90, 15], [0, 90, 180, 270], (480, 640), middle=1800)
    return raw, b0548_rows(raw, pitch).tobytes()


def b0548_rows(raw, pitch=481):
    """Rows of two halves, each four images after a line of metadata."""
    rows = np.full((2, 2405, 640), 7, dtype="<u2")
    for half, images in zip(rows, raw.reshape(2, 4, 480, 640), strict=True):
        for k, image in enumerate(images):
            half[1 + k * pitch : 1 + k * pitch + 480] = image
    return rows


def azure_kinect():
    """Nine blocks of a header and rows of five pixels in eight bytes; the upper values are negative."""
    raw = frames([196.75, 191.57, 53.57], [0, 120, 240], (576, 640), amplitude=50)
    coded = np.where(raw < 0, 64 - raw, raw).astype(np.uint8).reshape(9, 576, 128, 5)
    rows = np.zeros((9, 576, 128, 8), np.uint8)
    rows[..., :5] = coded
    return raw, b"".join(b"\xaa" * 256 + block.tobytes() for block in rows)


def kinect_v2():
    """Ten images of eleven bits: pixels in four strides, rows from the middle, values from a table."""
    y, table = 0, [0] * 2048
    for x in range(1024):
        table[x], table[1024 + x] = y, -y
        y += 1 << (x // 128 - (x >= 128))
    table[1024] = 32767
    value = np.array(table)
    code = np.random.default_rng(0).integers(1, 1024, (9, 424, 512))
    code[:, :, [0, 511]] = 0
    out = b""
    for image in code:
        rows = np.zeros((424, 352 * 16), np.uint8)
        v = np.arange(424)
        row = np.where(v < 212, v + 212, 423 - v)
        for u in range(1, 511):
            at = ((u >> 2) + ((u & 3) << 7)) * 11
            rows[row, at : at + 11] = image[:, u, None] >> np.arange(11) & 1
        out += np.packbits(rows, axis=1, bitorder="little").tobytes()
    return value[code], out + b"\0" * 298496


def luxonis():
    """Two frames of raw10, a tap in each corner of 2 x 2 cells, 80 and 100 MHz in turn."""
    raw = frames([80, 100], [0, 90, 180, 270], (480, 640), middle=500)
    return raw, luxonis_words(raw)


def luxonis_words(raw):
    """Mosaics of eight images."""
    out = b""
    for taps in raw.reshape(2, 4, 480, 640):
        mosaic = np.zeros((962, 1280), np.int64)
        for k, (r, c) in enumerate([(0, 0), (1, 0), (1, 1), (0, 1)]):
            mosaic[2 + r :: 2, c::2] = taps[k]
        four = mosaic.reshape(-1, 4)
        low = sum((four[:, i] & 3) << 2 * i for i in range(4))
        out += np.column_stack([four >> 2, low]).astype(np.uint8).tobytes()
    return out


def femto_picture(raw, mhz, padded=True, each=True):
    """Nine images after a header of 160 bytes each, or after one, every byte of it followed by a zero on hosts that pad."""
    out = b""
    for k, image in enumerate(raw):
        head = np.zeros(80, "<u2")
        head[0], head[6], head[7] = 0x5931, *image.shape[::-1]
        head[49], head[50], head[53] = k | 8 << 6 | 3 << 12, k % 3 | 3 << 4 | k // 3 << 8, mhz[k // 3] * 100
        head[64] = 41500
        words = np.frombuffer(head.tobytes(), np.uint8)
        if each or k == 0:
            out += np.column_stack([words, 0 * words]).tobytes() if padded else head.tobytes()
        out += image.astype("<i2").tobytes()
    return out


def femto_bolt():
    """A picture of the narrow view."""
    mhz = [197.0, 192.0, 54.0]
    raw = frames(mhz, [0, 120, 240], (576, 640), amplitude=2000)
    return raw, femto_picture(raw, mhz).ljust(6666240, b"\0")


def ti_opt8241():
    """I and Q of twelve bits in words of sixteen."""
    raw = frames([40, 70], [0, 270], (240, 320))
    return raw, (raw & 0xFFF).astype("<u2").tobytes()


def espros():
    """Four images of words; a saturated pixel is a flag."""
    raw = frames([12], [0, 270, 180, 90], (60, 160), middle=2000)
    raw[:, 3, 3] = 64003
    return raw, raw.astype("<u2").tobytes()


ENCODERS = {
    "arducam-b0410": arducam_b0410,
    "arducam-b0548-double": arducam_b0548_double,
    "azure-kinect": azure_kinect,
    "femto-bolt": femto_bolt,
    "kinect-v2": kinect_v2,
    "luxonis-oak-tof": luxonis,
    "ti-opt8241": ti_opt8241,
    "espros": espros,
}


@pytest.mark.parametrize("preset", ["epc611", "epc635", "epc660"])
def test_a_simulated_camera_has_the_phases_of_its_layout(preset):
    """What the simulator says of an ESPROS chip is what the reader takes its client's images for."""
    said = read_constants({"tof": {"preset": preset}}, preset).sensor.phase_rad
    assert np.degrees(said) == pytest.approx(LAYOUTS["espros"].deg)


KNOWN_BY_SIZE = ("arducam-b0410", "femto-bolt")


@pytest.mark.parametrize("name", ENCODERS)
def test_bytes_come_apart_into_the_images_that_went_in(name):
    """Every pixel of every image comes back, in the order of the channels."""
    raw, data = ENCODERS[name]()
    np.testing.assert_array_equal(decode(data, name, raw.shape[1:], name), raw)


@pytest.mark.parametrize(
    "name",
    ["arducam-b0410", "arducam-b0548-double", "femto-bolt", "luxonis-oak-tof", "ti-opt8241", "espros"],
)
def test_a_file_of_bytes_becomes_a_view(name, tmp_path):
    """The layout is known by its size or by its name; the view has its images and channels."""
    raw, data = ENCODERS[name]()
    (tmp_path / "frame.raw").write_bytes(data)
    H, W = raw.shape[1:]
    tof = {"fx": W, "fy": W, "cx": W / 2, "cy": H / 2}
    size = {"espros": {"shape": [H, W]}}.get(name, {})
    channels = {"espros": {"modulation_mhz": [12], "phase_deg": [0, 90, 180, 270]}}.get(name, {})
    said = Said(tof=tof | channels, raw={} if name in KNOWN_BY_SIZE else {"layout": name, **size})
    import_data([tmp_path / "frame.raw"], tmp_path / "rec", said)
    (path,) = find_views(tmp_path / "rec")["frame"]
    view = open_view(path)
    np.testing.assert_array_equal(view.tof.raw[0], raw)
    assert len(view.tof.info.modulation_hz) == len(raw)
    if name == "femto-bolt":
        assert view.tof.info.modulation_hz[::3] == (197e6, 192e6, 54e6)


def test_other_sizes_and_names_are_refused(tmp_path):
    """A cut file, one without a size, one of a size that two cameras have, and a camera that nobody knows are named."""
    (tmp_path / "two.raw").write_bytes(b"\0" * 3078400)
    with pytest.raises(ConfigError, match=r"arducam-b0548, luxonis-oak-tof"):
        import_data([tmp_path / "two.raw"], tmp_path / "rec", Said())
    with pytest.raises(FormatError, match="multiple of 64800 bytes"):
        decode(b"\0" * 64799, "arducam-b0410", (), "x.raw")
    with pytest.raises(FormatError, match="size"):
        decode(b"\0" * 64, "espros", (), "x.raw")
    with pytest.raises(ConfigError, match="arducam-b0410"):
        decode(b"", "acme", (), "x.raw")
