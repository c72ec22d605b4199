"""The session over links of every kind of badness: each frame comes right or is reported, in simulated time."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tests.tof_module.core import ModuleCore
from tests.tof_module.module import Noise
from tests.tof_module.synthetic import simulated_info, synthetic
from tofcapture.devices.tof_serial.messages import Capture, Frame, Info, Time
from tofcapture.devices.tof_serial.packet import Kind, Packet, Parser, encode, values
from tofcapture.devices.tof_serial.session import (
    MS,
    FirmwareError,
    Heard,
    LinkTooBadError,
    ModuleRefusedError,
    ModuleResetError,
    ModuleSilentError,
    Session,
)
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
    damaged: int = 0
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
            arrived = self.damage(piece)
            self.damaged += arrived != piece
            found = self.parser.feed(arrived)
        for hook in self.hooks:
            hook(self)
        if not found:
            self.now = max(self.now, ask.until)
        return Heard(self.now, tuple(found))


def link(info=SMALL, seed=0, rate=0.0, core=ModuleCore, **options):
    noise = Noise.every(np.random.default_rng(seed), rate)
    return Link(core(info, synthetic(info, seed), **options), noise)


def take(on, session, burst, index):
    """Script that uploads one frame."""
    return session.frame(burst, index, on.core.info.frame_bytes)


def begin(on, session, frames=2):
    """Say hello and expose burst 1."""
    info = on.run(session.hello())
    on.run(session.expose(1, frames, info.period_us))
    return info


def test_clean_link_gives_the_frames():
    """Over a good link, frames, temperature and exposure times arrive as the module made them."""
    on, session, clocks = link(), Session(), []
    start = on.now // 1000
    assert begin(on, session, 3) == SMALL
    end = on.now // 1000
    for i in range(3):
        meta, data = on.run(take(on, session, 1, i))
        raw, celsius = synthetic(SMALL, 0)(0, i)
        assert (values(data, raw.shape, 12) == raw).all()
        assert meta.celsius == pytest.approx(celsius)
        clocks.append(meta.clock_us)
    assert start <= clocks[0] < end
    assert np.diff(clocks).tolist() == [SMALL.period_us] * 2
    assert on.damaged == 0


def check_noise(least_chunks, rate, seed=0):
    """Take frames over a damaging link until so many chunks were sent; returns (right, reported, chunks)."""
    info = simulated_info(48, 36, frames=8)
    on, session, source = link(info, seed, rate), Session(largest_chunk=256), synthetic(info, seed)
    right = reported = burst = 0
    on.run(session.hello())
    while on.chunks < least_chunks:
        burst += 1
        try:
            on.run(session.expose(burst, 8, info.period_us))
            on.run(session.sync())
        except DeviceError:
            reported += 8
            continue
        for i in range(8):
            try:
                _, data = on.run(take(on, session, burst, i))
            except DeviceError:
                reported += 1
                continue
            raw, _ = source(on.core.exposed - 1, i)
            assert (values(data, raw.shape, 12) == raw).all(), "a wrong frame was accepted"
            right += 1
        on.run(session.release())
    assert on.damaged > least_chunks // 20
    return right, reported, on.chunks


@pytest.mark.parametrize("seed", [0, 7])
def test_bad_link_gives_right_frames(seed):
    """Ten thousand chunks, five kinds of damage at 1e-3 per byte each: every frame comes right or is reported, none wrong."""
    right, reported, _ = check_noise(10_000, 1e-3, seed)
    assert right >= 24
    assert reported <= 2


def test_chunk_follows_the_link():
    """On a link that breaks long packets the chunk shrinks; when the link is good again it grows."""
    on, session = link(simulated_info(64, 48), rate=5e-4), Session()
    begin(on, session)
    on.run(take(on, session, 1, 0))
    assert session.chunk < 2048
    on.damage = bytes
    for _ in range(8):
        on.run(take(on, session, 1, 1))
    assert session.chunk == 16384


def test_hopeless_link_is_reported():
    """A link that damages every chunk ends in its named error, after bounded time."""
    on, session = link(), Session()
    begin(on, session)
    on.damage = lambda piece: piece if len(piece) < 60 else piece[:50]
    with pytest.raises(LinkTooBadError, match="frame 0 lacks"):
        on.run(take(on, session, 1, 0))
    assert on.now < 60 * 1000 * MS


def test_silence_is_reported():
    """A dead line and a line of rubbish are silence."""
    for damage in (lambda _: b"", lambda piece: b"\x55" * len(piece)):
        on = Link(ModuleCore(SMALL, synthetic(SMALL, 0)), damage)
        with pytest.raises(ModuleSilentError, match="HELLO"):
            on.run(Session().hello())
        assert on.now <= 5000 * MS


def test_foreign_protocol_is_named():
    """A module of another protocol version is told apart from a silent one."""
    with pytest.raises(FirmwareError, match="protocol 2, this host speaks 1"):
        link(protocol=2).run(Session().hello())


def test_reset_in_burst_is_named():
    """A module that starts anew in the middle of a burst is found out, whoever asks first."""
    on, session = link(reset_in=frozenset({0})), Session()
    with pytest.raises(ModuleResetError):
        begin(on, session)
    begin(on, session)  # burst 1 again: the new start has forgotten it, and takes it
    on.run(take(on, session, 1, 0))


def test_reset_before_upload_is_named():
    """A module that starts anew between exposure and upload has no such burst; SYNC finds it too."""
    for script in (lambda on, session: take(on, session, 1, 0), lambda _, session: session.sync()):
        on, session = link(), Session()
        begin(on, session)
        on.core.reset(on.now // 1000)
        with pytest.raises(ModuleResetError):
            on.run(script(on, session))


def test_reset_in_upload_is_named():
    """A module that starts anew while it uploads ends in its named error."""
    on, session = link(simulated_info(64, 48)), Session(largest_chunk=256)
    begin(on, session)
    on.hooks.append(lambda at: at.core.reset(at.now // 1000) if at.chunks == 30 else None)
    with pytest.raises(ModuleResetError):
        on.run(take(on, session, 1, 0))


def test_capture_twice_exposes_once():
    """The same burst number again does not expose again; another one while exposing is refused."""
    on, session = link(), Session()
    info = on.run(session.hello())
    script = session.request(Kind.CAPTURE, Capture(5, 2).pack(), lambda body: body)
    on.run(script)
    with pytest.raises(ModuleRefusedError, match="BUSY"):
        on.run(session.request(Kind.CAPTURE, Capture(6, 2).pack(), lambda body: body))
    on.run(session.expose(5, 2, info.period_us))
    on.run(session.expose(5, 2, info.period_us))
    assert on.core.exposed == 1


def test_refusals_are_errors():
    """Too many frames, frames not exposed and unknown requests come back as errors that say so."""
    on, session = link(), Session()
    begin(on, session)
    with pytest.raises(ModuleRefusedError, match="TOO_MANY_FRAMES"):
        on.run(session.expose(2, 100, 1))
    with pytest.raises(ModuleRefusedError, match="OUT_OF_RANGE"):
        on.run(take(on, session, 1, 9))
    on.core.receive(encode(Packet(0x42, 9, b"")), 0)
    (packet,) = Parser().feed(on.core.outgoing())
    assert (packet.kind, packet.token) == (Kind.REFUSED, 9)


def test_late_answers_do_not_fool_the_clock():
    """An answer to an earlier try is not taken for a quick answer to the present one."""
    session = Session()
    script = session.sync(pings=1)
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
    session = Session()
    script = session.hello()
    script.send(None)
    ask = script.send(Heard(0))
    (asked,) = Parser().feed(ask.send)
    with pytest.raises(ModuleRefusedError, match="does not allow"):
        script.send(Heard(1, (Packet(Kind.INFO, asked.token, b"short"),)))


def _wrong_sum(piece):
    """Change the frame's CRC that the module tells; the packet's own stays right."""
    for packet in Parser().feed(piece):
        if packet.kind == Kind.FRAME:
            frame = Frame.unpack(packet.body)
            return encode(replace(packet, body=replace(frame, crc=frame.crc ^ 1).pack()))
    return piece


def test_frame_that_is_wrong_in_memory_is_reported():
    """When all chunks are right but the frame's CRC is not, the frame is not accepted."""
    on, session = link(), Session()
    begin(on, session)
    on.damage = _wrong_sum
    with pytest.raises(LinkTooBadError, match="the frame's is not"):
        on.run(take(on, session, 1, 0))


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
    on, session = link(), Session()
    begin(on, session)
    with pytest.raises(ModuleRefusedError, match="expected 99 bytes, the module has 5184"):
        on.run(session.frame(1, 0, 99))


class _Repeating(ModuleCore):
    """Sends its first chunk for ever."""

    first = b""

    def outgoing(self):
        piece = self.first or super().outgoing()
        self.first = piece if len(piece) > 250 else b""
        return piece


def test_module_that_repeats_itself_is_no_progress():
    """A module that sends the same chunk for ever ends in its named error, after bounded time."""
    on, session = link(core=_Repeating), Session(largest_chunk=256)
    begin(on, session)
    with pytest.raises(LinkTooBadError, match="frame 0 lacks 4928 bytes"):
        on.run(take(on, session, 1, 0))
    assert on.now < 60 * 1000 * MS
