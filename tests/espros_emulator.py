"""A TOFcam-660 on loopback: answers the published commands over TCP, sends images over UDP."""

import contextlib
import socket
import struct
import threading
import time

import numpy as np

from tofcapture.channels import SPEED_OF_LIGHT

_START, _END = 0xFFFFAA55, 0xFFFF55AA
_MHZ = {0: 12.0, 1: 24.0, 2: 6.0, 3: 3.0, 4: 1.5, 5: 0.75}
_PACKET = 1400


class Emulator:
    """Serves one camera; ``range_m`` (H, W) is what it sees, with ``amplitude`` counts.

    ``fault`` is what goes wrong: "mute" (no answer), "no data" (answers, sends nothing), "unplugged" (both end after ``after``
    images), "binned" (half the rows), "stolen" (another exposure). ``ports`` are those of commands and of data, 0 for any.
    """

    def __init__(self, range_m, amplitude=900.0, chip=(7, 4321), fault="", after=10**9, ports=(0, 0)):
        self.range, self.amplitude, self.chip, self.fault, self.after = range_m, amplitude, chip, fault, after
        self.mhz, self.exposure, self.log, self.images = 12.0, 0, [], 0
        self._tcp = socket.create_server(("127.0.0.1", ports[0]))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", ports[1]))
            self.data_port = free.getsockname()[1]
        self.port = self._tcp.getsockname()[1]
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._rng, self._links = np.random.default_rng(0), []

    def __enter__(self):
        threading.Thread(target=self._serve, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.unplug()
        with contextlib.suppress(OSError):
            self._tcp.shutdown(socket.SHUT_RDWR)  # wakes who accepts
        self._tcp.close()
        self._udp.close()

    def unplug(self):
        """Cut the cable."""
        for link in self._links:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def _serve(self):
        while True:
            try:
                link, _ = self._tcp.accept()
            except OSError:
                return
            self._links.append(link)
            threading.Thread(target=self._talk, args=(link,), daemon=True).start()

    def _talk(self, link):
        try:
            with link, link.makefile("rb") as stream:
                while head := stream.read(8):
                    assert struct.unpack("!I", head[:4])[0] == _START
                    payload = stream.read(struct.unpack("!I", head[4:])[0])
                    assert struct.unpack("!I", stream.read(4))[0] == _END
                    if self.fault == "mute":
                        continue
                    number, data = struct.unpack("!H", payload[:2])[0], payload[2:]
                    answer = self._answer(number, data)
                    link.sendall(struct.pack("!II", _START, len(answer)) + answer + struct.pack("!I", _END))
                    if number == 7:
                        self._image(link)
        except OSError:
            return

    def _answer(self, number, data):
        self.log.append(number)
        if number == 1:
            self.exposure = struct.unpack("!H", data[:2])[0]
        elif number == 23:
            self.mhz = _MHZ[data[0]]
        elif number == 52:
            self.mhz = struct.unpack("!L", data[:4])[0] / 1e6
        elif number == 36:
            return b"\x03" + struct.pack("!HH", *self.chip)  # wafer, chip
        elif number == 37:
            return b"\x02" + struct.pack("!HH", 3, 60)
        elif number == 43:
            return b"\x06\x00"
        elif number == 53:
            return b"\x09" + struct.pack("!BHH", 1, 40000, 100)
        return b"\x00"

    def _image(self, link):
        self.images += 1
        if self.fault == "unplugged" and self.images > self.after:
            self.unplug()
            return
        if self.fault == "no data":
            return
        phi = 4 * np.pi * self.mhz * 1e6 * self.range / SPEED_OF_LIGHT
        dcs = self.amplitude * np.cos(phi - np.arange(4)[:, None, None] * np.pi / 2)
        raw = np.rint(dcs + self._rng.normal(0, 2, dcs.shape) + 2048).astype("<u2")
        raw[:, 0, 0], raw[:, 0, 1] = 64002, 64003
        if self.fault == "binned":
            raw = raw[:, ::2]
        rows, columns = raw.shape[1:]
        exposure = self.exposure + (self.fault == "stolen")
        head = (1, 4, columns, rows, 0, 0, columns, rows, exposure, 0, 0, 3512, 0)
        body = struct.pack("!BHHHHHHHHHHhH", *head) + raw.tobytes()
        count = -(-len(body) // _PACKET)
        for k in range(count):
            part = body[k * _PACKET : (k + 1) * _PACKET]
            header = struct.pack("!HIHIII", self.images % 65536, len(body), len(part), k * _PACKET, count, k)
            self._udp.sendto(header + part, ("127.0.0.1", self.data_port))
            if k % 40 == 39:
                time.sleep(0.002)  # a camera's line is not faster either
        del link
