"""The serial protocol: framing that never accepts damage, and vectors that firmware can be held against."""

import contextlib
import json
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tof_module.module import Noise
from tests.tof_module.synthetic import whitened
from tests.tof_module.vectors import vectors
from tofcapture.devices.tof_serial import messages
from tofcapture.devices.tof_serial.clock import Anchor, ClockError, anchor, burst_times, drift, to_host
from tofcapture.devices.tof_serial.messages import MalformedError
from tofcapture.devices.tof_serial.packet import (
    Assembly,
    Kind,
    Packet,
    Parser,
    decode,
    encode,
    pack12,
    packed_size,
    unpack12,
    values,
)

VECTORS = Path(__file__).resolve().parents[1] / "docs" / "serial-vectors.json"
mostly_zero = st.lists(st.sampled_from([0, 0, 1, 255]), max_size=700).map(bytes)
long_runs = st.integers(200, 800).map(lambda n: b"\x07" * n) | st.binary(max_size=20)
some_bytes = st.binary(max_size=900) | mostly_zero | st.lists(long_runs, max_size=3).map(b"\0".join)


@settings(max_examples=100)
@given(some_bytes)
def test_any_packet_comes_back_and_damage_does_not(data):
    """A packet of any body holds no delimiter but those at its ends, and comes back; a changed byte makes it none."""
    packet = Packet(Kind.DATA, 7, data, 3)
    wire = encode(packet)
    assert (wire[0], wire[-1], wire[1:-1].count(0)) == (0, 0, 0)
    assert decode(wire[1:-1]) == packet
    for at in range(0, len(wire) - 2, 37):
        broken = bytearray(wire[1:-1])
        broken[at] ^= 1
        assert decode(broken) is None


def test_vectors_in_docs_are_these():
    """The vectors in docs/ are what the code makes, and CRC-32 is the usual one."""
    assert json.loads(VECTORS.read_text()) == vectors()
    assert vectors()["crc32"][0]["crc32"] == 0xCBF43926


def test_vectors_read_back():
    """Every packet of the vectors parses to its kind, token, number and body; every body is understood."""
    for row in vectors()["packets"]:
        (packet,) = Parser().feed(bytes.fromhex(row["wire"]))
        assert packet == Packet(Kind[row["kind"]], row["token"], bytes.fromhex(row["body"]), row["seq"])
    unpack = {"INFO": messages.Info, "TIME": messages.Time, "CAPTURE": messages.Capture, "STATE": messages.BurstState,
              "META": messages.FrameKey, "FRAME": messages.Frame, "READ": messages.Read, "REFUSED": messages.Refused}  # fmt: skip
    for row in vectors()["packets"]:
        if row["kind"] in unpack:
            body = bytes.fromhex(row["body"])
            assert unpack[row["kind"]].unpack(body).pack() == body
            with pytest.raises(MalformedError):
                unpack[row["kind"]].unpack(body[: 0 if row["kind"] == "REFUSED" else 3])


@given(st.lists(st.integers(0, 4095), max_size=300))
def test_packing_is_undone(numbers):
    """12-bit packing has the promised size and is undone, for even and odd counts."""
    raw = np.array(numbers, dtype=np.uint16)
    packed = pack12(raw)
    assert len(packed) == packed_size(raw.size, 12)
    assert (unpack12(np.frombuffer(packed, np.uint8), raw.size) == raw).all()


@given(st.binary(max_size=900), st.integers(0, 900))
def test_whitening_is_by_offset(data, cut):
    """Whitening is its own inverse, and a frame may be whitened in pieces by their offsets."""
    assert whitened(whitened(data)) == data
    cut = min(cut, len(data))
    assert whitened(data[:cut]) + whitened(data[cut:], cut) == whitened(data)


def test_whitening_spreads_zeros():
    """A constant image has one zero byte in 256 on the wire."""
    for value in (0, 7, 255):
        assert whitened(bytes([value]) * 2560).count(0) == 10


def packets(rng, count):
    """Make some packets of random kinds and bodies."""
    return [
        Packet(int(rng.integers(256)), int(rng.integers(2**32)), rng.bytes(int(rng.integers(300))), i)
        for i in range(count)
    ]


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 400), min_size=1, max_size=20))
def test_parser_does_not_care_about_pieces(seed, cuts):
    """The same stream cut anywhere gives the same packets."""
    sent = packets(np.random.default_rng(seed), 6)
    wire, parser, found, at = b"".join(map(encode, sent)), Parser(), [], 0
    for cut in cuts * 100:
        found += parser.feed(wire[at : at + cut])
        at += cut
    found += parser.feed(wire[at:])
    assert found == sent


def fuzz(rng, rounds):
    """Feed a parser random bytes, damaged packets and endless rubbish; return (given, accepted)."""
    parser, noise, sent, found = Parser(), Noise.every(rng, 0.01), set(), []
    for i in range(rounds):
        choice = i % 4
        if choice == 0:
            data = rng.bytes(int(rng.integers(40)))
        elif choice == 1:
            (packet,) = packets(rng, 1)
            sent.add((packet.kind, packet.token, packet.body))
            data = noise(encode(packet))
        elif choice == 2:
            data = b"\0" * int(rng.integers(5)) + bytes([int(rng.integers(256))]) * int(rng.integers(30))
        else:
            data = b"\xff" * int(rng.integers(600)) if i % 64 == 3 else b"\0"
        found += parser.feed(data)
    return sent, found


def check_fuzz(rounds):
    sent, found = fuzz(np.random.default_rng(rounds), rounds)
    assert len(found) > rounds // 200
    # CRC-32 lets one damaged packet in 4e9 through.
    assert all((p.kind, p.token, p.body) in sent for p in found)


def test_parser_survives_anything():
    """Random input neither raises, nor grows the buffer, nor gives a packet that was never sent."""
    check_fuzz(8000)


@pytest.mark.slow
def test_parser_survives_a_million():
    """The same for a million inputs."""
    check_fuzz(1_000_000)


@settings(max_examples=200)
@given(
    st.sampled_from(["Info", "Time", "Capture", "BurstState", "FrameKey", "Frame", "Read", "Refused"]),
    st.binary(max_size=250),
)
def test_bodies_raise_only_malformed(name, body):
    """A body of any bytes is understood or refused as malformed."""
    with contextlib.suppress(MalformedError):
        getattr(messages, name).unpack(body)


def test_endless_piece_is_dropped():
    """Without any delimiter the parser holds no more than a packet, and goes on at the next one."""
    parser, piece = Parser(), b"\x55" * 1000
    tracemalloc.start()
    for _ in range(10_000):
        assert parser.feed(piece) == []
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 100_000
    packet = Packet(Kind.SYNC, 5, b"")
    assert parser.feed(b"\x01\0" + encode(packet)) == [packet]
    assert decode(b"\x55" * 20) is None


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(0, 120), st.integers(0, 60)), max_size=30))
def test_assembly_counts_new_bytes(pieces):
    """Whatever order and overlap: new bytes add up, what is missing is what no piece covered."""
    data = np.arange(120, dtype=np.uint8)
    white, assembly = whitened(data.tobytes()), Assembly(120)
    covered, new = np.zeros(120, bool), 0
    for start, length in pieces:
        new += assembly.put(start, white[start : start + length])
        covered[start : start + length] = True
    assert new == covered.sum()
    assert all(not covered[a:b].any() for a, b in assembly.missing)
    assert sum(b - a for a, b in assembly.missing) == 120 - new
    assembly.put(0, white)
    assert (assembly.take(zlib.crc32(data)) == data).all()
    wrong = Assembly(120)
    wrong.put(0, white)
    assert wrong.take(zlib.crc32(data) ^ 1) is None


def test_values_of_both_widths():
    """Frames of 12 and of 16 bits give their values in shape."""
    raw = np.arange(24, dtype=np.uint16).reshape(2, 3, 4) * 100
    for bits, data in ((12, pack12(raw)), (16, raw.astype("<u2").tobytes())):
        assert (values(np.frombuffer(data, np.uint8), raw.shape, bits) == raw).all()


@settings(max_examples=50)
@given(st.floats(-200e-6, 200e-6), st.integers(0, 10**9), st.integers(0, 2**32 - 1))
def test_clock_within_its_bound(rate, offset_us, seed):
    """Times come out within the round trips' bound, whatever the asymmetry of the link."""
    rng = np.random.default_rng(seed)

    def module(host_ns):
        return int(host_ns / 1000 * (1 + rate)) + offset_us

    def exchange(start):
        out, back = rng.integers(10_000, 3_000_000, 2)
        return start, module(start + out), int(start + out + back)

    anchors = [anchor([exchange(at + i * 10**7) for i in range(8)]) for at in (0, 600 * 10**9, 601 * 10**9)]
    true = 600_500_000_000
    near = min(anchors[1:], key=lambda a: a.error_ns)
    bound = near.error_ns + 2000 + 1e9 * (anchors[0].error_ns + anchors[2].error_ns) / 600e9
    assert abs(to_host(near, drift(anchors[0], anchors[2]), module(true)) - true) <= bound
    assert drift(anchors[1], Anchor(anchors[1].host_ns + 10**9, anchors[1].module_us + 10**6, 0)) == 0.0


SECOND = 10**9
ANCHORS = [Anchor(at * SECOND, at * 10**6, 10_000) for at in (0, 10, 11)]  # host and module run alike


def test_times_of_a_burst():
    """Frames have the host's times of their exposures, from a clock that runs as a crystal does."""
    assert burst_times(ANCHORS, [10_100_000, 10_133_333], 33_333).tolist() == [10_100_000_000, 10_133_333_000]
    drifting = [replace(a, module_us=round(a.module_us * 1.0002)) for a in ANCHORS]
    (found,) = burst_times(drifting, [round(10_100_000 * 1.0002)], 33_333)
    assert abs(found - 10_100_000_000) < 2000


@pytest.mark.parametrize(
    ("stretch", "clocks", "words"),
    [
        (1.001, [10_100_000], "runs off by -999 ppm"),
        (1.0, [10_200_000, 10_100_000], "in order within the burst"),
        (1.0, [9_900_000, 10_100_000], "in order within the burst"),
        (1.0, [10_100_000, 11_100_000], "in order within the burst"),
    ],
)
def test_clocks_that_no_crystal_has_are_named(stretch, clocks, words):
    """A clock that drifts too far, and frames before, after or out of order in their burst, are refused."""
    anchors = [replace(a, module_us=round(a.module_us * stretch)) for a in ANCHORS]
    with pytest.raises(ClockError, match=words) as caught:
        burst_times(anchors, clocks, 33_333)
    assert caught.value.hint
