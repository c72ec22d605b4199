"""The session over links of every kind of badness: each frame comes right or is reported, in simulated time."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from tofcapture.devices.tof_serial.assembly import values
from tofcapture.devices.tof_serial.core import ModuleCore
from tofcapture.devices.tof_serial.errors import (
    FirmwareError,
    LinkTooBadError,
    ModuleRefusedError,
    ModuleResetError,
    ModuleSilentError,
)
from tofcapture.devices.tof_serial.messages import Capture, Info, Time
from tofcapture.devices.tof_serial.noise import Noise
from tofcapture.devices.tof_serial.packet import Kind, Packet, Parser, encode
from tofcapture.devices.tof_serial.script import MS, Heard
from tofcapture.devices.tof_serial.session import Host
from tofcapture.devices.tof_serial.synthetic import simulated_info, synthetic
from tofcapture.errors import DeviceError

SMALL = simulated_info(24, 18)


@dataclass
class Link:
    """Host, damage, module, and a clock that only waiting moves."""

    core: ModuleCore
    damage: object = bytes
    now: int = 0
    parser: Parser = field(default_factory=Parser)
    chunks: int = 0
    hooks: list = field(default_factory=list)

    def run(self, script):
        try:
            ask = next(script)
            while True:
                ask = script.send(self._obey(ask))
        except StopIteration as end:
            return end.value

    def _obey(self, ask):
        if ask.send:
            self.core.receive(self.damage(ask.send), self.now // 1000)
        found = []
        while not found and (piece := self.core.outgoing()):
            self.chunks += len(piece) > 100
            self.now += 20_000
            found = self.parser.feed(self.damage(piece))
        for hook in self.hooks:
            hook(self)
        if not found:
            self.now = max(self.now, ask.until)
        return Heard(self.now, tuple(found))


def link(info=SMALL, seed=0, rate=0.0, **options):
    noise = Noise.every(np.random.default_rng(seed), rate)
    return Link(ModuleCore(info, synthetic(info, seed), **options), noise)


def take(on, host, burst, index):
    """Script that uploads one frame."""
    return host.frame(burst, index, on.core.info.frame_bytes)


def begin(on, host, frames=2):
    """Say hello and expose burst 1."""
    info = on.run(host.hello())
    on.run(host.expose(1, frames, info.period_us))
    return info


def test_clean_link_gives_the_frames():
    """Over a good link, frames, temperature and exposure times arrive as the module made them."""
    on, host = link(), Host()
    info = begin(on, host, 3)
    assert info == SMALL
    for i in range(3):
        meta, data = on.run(take(on, host, 1, i))
        raw, celsius = synthetic(SMALL, 0)(0, i)
        assert (values(data, raw.shape, 12) == raw).all()
        assert meta.celsius == pytest.approx(celsius)
        assert meta.clock_us == on.core._burst.start_us + i * SMALL.period_us
    assert (on.parser.damaged, on.parser.lost) == (0, 0)


def check_noise(least_chunks, rate, seed=0):
    """Take frames over a damaging link until so many chunks were sent; returns (right, reported, chunks)."""
    info = simulated_info(48, 36, frames=8)
    on, host, source = link(info, seed, rate), Host(largest_chunk=256), synthetic(info, seed)
    right = reported = burst = 0
    on.run(host.hello())
    while on.chunks < least_chunks:
        burst += 1
        try:
            on.run(host.expose(burst, 8, info.period_us))
            on.run(host.sync())
        except DeviceError:
            reported += 8
            continue
        for i in range(8):
            try:
                _, data = on.run(take(on, host, burst, i))
            except DeviceError:
                reported += 1
                continue
            raw, _ = source(on.core._burst.count, i)
            assert (values(data, raw.shape, 12) == raw).all(), "a wrong frame was accepted"
            right += 1
        on.run(host.release())
    assert on.parser.damaged > least_chunks // 20
    return right, reported, on.chunks


@pytest.mark.parametrize("seed", [0, 7])
def test_bad_link_gives_right_frames(seed):
    """Ten thousand chunks, five kinds of damage at 1e-3 per byte each: every frame comes right or is reported, none wrong."""
    right, reported, _ = check_noise(10_000, 1e-3, seed)
    assert right >= 24
    assert reported <= 2


def test_chunk_follows_the_link():
    """On a link that breaks long packets the chunk shrinks; when the link is good again it grows."""
    on, host = link(simulated_info(64, 48), rate=5e-4), Host()
    begin(on, host)
    on.run(take(on, host, 1, 0))
    assert host.chunk < 2048
    on.damage = bytes
    for _ in range(8):
        on.run(take(on, host, 1, 1))
    assert host.chunk == 16384


def test_hopeless_link_is_reported():
    """A link that damages every chunk ends in its named error, after bounded time."""
    on, host = link(), Host()
    begin(on, host)
    on.damage = lambda piece: piece if len(piece) < 60 else piece[:50]
    with pytest.raises(LinkTooBadError, match="frame 0 lacks"):
        on.run(take(on, host, 1, 0))
    assert on.now < 60 * 1000 * MS


def test_silence_is_reported():
    """A dead line and a line of rubbish are silence."""
    for damage in (lambda _: b"", lambda piece: b"\x55" * len(piece)):
        on = Link(ModuleCore(SMALL, synthetic(SMALL, 0)), damage)
        with pytest.raises(ModuleSilentError, match="HELLO"):
            on.run(Host().hello())
        assert on.now <= 5000 * MS


def test_foreign_protocol_is_named():
    """A module of another protocol version is told apart from a silent one."""
    with pytest.raises(FirmwareError, match="protocol 2, this host speaks 1"):
        link(protocol=2).run(Host().hello())


def test_reset_in_burst_is_named():
    """A module that starts anew in the middle of a burst is found out, whoever asks first."""
    on, host = link(reset_in=frozenset({0})), Host()
    with pytest.raises(ModuleResetError):
        begin(on, host)
    begin(on, host)  # burst 1 again: the new start has forgotten it, and takes it
    on.run(take(on, host, 1, 0))


def test_reset_before_upload_is_named():
    """A module that starts anew between exposure and upload has no such burst; SYNC finds it too."""
    for script in (lambda on, host: take(on, host, 1, 0), lambda _, host: host.sync()):
        on, host = link(), Host()
        begin(on, host)
        on.core.reset(on.now // 1000)
        with pytest.raises(ModuleResetError):
            on.run(script(on, host))


def test_reset_in_upload_is_named():
    """A module that starts anew while it uploads ends in its named error."""
    on, host = link(simulated_info(64, 48)), Host(largest_chunk=256)
    begin(on, host)
    on.hooks.append(lambda at: at.core.reset(at.now // 1000) if at.chunks == 30 else None)
    with pytest.raises(ModuleResetError):
        on.run(take(on, host, 1, 0))


def test_capture_twice_exposes_once():
    """The same burst number again does not expose again; another one while exposing is refused."""
    on, host = link(), Host()
    info = on.run(host.hello())
    script = host.request(Kind.CAPTURE, Capture(5, 2).pack(), lambda body: body)
    on.run(script)
    with pytest.raises(ModuleRefusedError, match="BUSY"):
        on.run(host.request(Kind.CAPTURE, Capture(6, 2).pack(), lambda body: body))
    on.run(host.expose(5, 2, info.period_us))
    on.run(host.expose(5, 2, info.period_us))
    assert on.core._bursts == 1


def test_refusals_are_errors():
    """Too many frames, frames not exposed and unknown requests come back as errors that say so."""
    on, host = link(), Host()
    begin(on, host)
    with pytest.raises(ModuleRefusedError, match="TOO_MANY_FRAMES"):
        on.run(host.expose(2, 100, 1))
    with pytest.raises(ModuleRefusedError, match="OUT_OF_RANGE"):
        on.run(take(on, host, 1, 9))
    on.core.receive(encode(Packet(0x42, 9, b"")), 0)
    (packet,) = Parser().feed(on.core.outgoing())
    assert (packet.kind, packet.token) == (Kind.REFUSED, 9)


def test_late_answers_do_not_fool_the_clock():
    """An answer to an earlier try is not taken for a quick answer to the present one."""
    host = Host()
    script = host.sync(pings=1)
    script.send(None)
    ask = script.send(Heard(0))
    (first,) = Parser().feed(ask.send)
    ask = script.send(Heard(ask.until))  # the first try ran out
    (second,) = Parser().feed(ask.send)
    late = Packet(Kind.TIME, first.token, Time(1, 100).pack())
    ask = script.send(Heard(ask.until - 5, (late,)))
    good = Packet(Kind.TIME, second.token, Time(1, 900).pack())
    with pytest.raises(StopIteration) as end:
        script.send(Heard(ask.until - 1, (good,)))
    assert end.value.value.module_us == 900


def test_malformed_answer_is_the_firmware():
    """A body that is too short, under a right CRC, is the firmware's error and no crash."""
    host = Host()
    script = host.hello()
    script.send(None)
    ask = script.send(Heard(0))
    (asked,) = Parser().feed(ask.send)
    with pytest.raises(ModuleRefusedError, match="does not allow"):
        script.send(Heard(1, (Packet(Kind.INFO, asked.token, b"short"),)))


def test_frame_that_is_wrong_in_memory_is_reported():
    """When all chunks are right but the frame's CRC is not, the frame is not accepted."""
    on, host = link(), Host()
    begin(on, host)
    on.core._frame(1, 0, on.now // 1000)
    data, meta = on.core._packed[0]
    on.core._packed[0] = (bytes([data[0] ^ 1]) + data[1:], meta)
    with pytest.raises(LinkTooBadError, match="the frame's is not"):
        on.run(take(on, host, 1, 0))


def test_module_survives_anything():
    """The module's core answers or ignores any bytes and any body; it never raises."""
    rng = np.random.default_rng(3)
    core = ModuleCore(SMALL, synthetic(SMALL, 0))
    for i in range(3000):
        kind = int(rng.choice([*range(1, 9), 200]))
        data = rng.bytes(30) if i % 3 == 0 else encode(Packet(kind, i, rng.bytes(int(rng.integers(40)))))
        core.receive(data, i * 1000)
        while core.outgoing():
            pass
    assert Info.unpack(core.info.pack()) == SMALL


def test_frame_of_another_size_is_refused():
    """A module that announces a frame of another size is refused before memory is taken for it."""
    on, host = link(), Host()
    begin(on, host)
    with pytest.raises(ModuleRefusedError, match="expected 99 bytes, the module has 5184"):
        on.run(host.frame(1, 0, 99))


def test_module_that_repeats_itself_is_no_progress():
    """A module that sends the same chunk for ever ends in its named error, after bounded time."""
    on, host = link(), Host()
    begin(on, host)
    real, kept = on.core._stream, []

    def stream(data, read, token):
        kept.append(next(real(data, read, token)))
        while True:
            yield kept[0]

    on.core._stream = stream
    host.chunk = 256
    with pytest.raises(LinkTooBadError, match="frame 0 lacks 4928 bytes"):
        on.run(take(on, host, 1, 0))
    assert on.now < 60 * 1000 * MS
