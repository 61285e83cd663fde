"""Bluetooth to an emulated HERO9: packets in 20 bytes, replies and pushes when the air lets them through."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

from spikerig.rigctl.gopro_radio import LinkLost
from spikerig.rigctl.sim.emulate.gopro_camera import MS, GoProCamera
from spikerig.rigctl.sim.emulate.latency import Latency

_UUID = "b5f9{}-aa8d-11e3-9046-0002a5d5c51b"
_ANSWERS = {"0072": "0073", "0074": "0075", "0076": "0077"}
_LENGTHS = {13: 4, 35: 4, 60: 4, 93: 4, 94: 4, 95: 4, 96: 4, 97: 4, 98: 4, 54: 8}
# What a real HERO9 also reports and GoPro does not document (id, value), some of odd lengths.
_UNKNOWN = {3: b"\0", 4: b"\0", 14: b"\0", 36: bytes(4), 37: bytes(4), 40: b"\0\0\0", 57: bytes(8), 61: b"\x02",
            62: bytes(4), 63: b"\0", 90: b"", 91: b"\x03", 109: b"\0"}  # fmt: skip


@dataclass
class Air:
    """The space around a camera: makes links to it.

    Args:
        camera: at the other end.
        there, back: latencies of the two directions; a connection interval of 15 ms by default.
    """

    camera: GoProCamera
    there: Latency = field(default_factory=lambda: Latency(4000.0, 3000.0, 15_000.0))
    back: Latency = field(default_factory=lambda: Latency(6000.0, 5000.0, 15_000.0))
    dialled: int = 0
    many: int = 0  # replies of several packets so far
    shutters: int = 0
    hardware_asked: int = 0

    def dial(self) -> AirLink:
        """Connect, which wakes the camera.

        Raises:
            LinkLost: this attempt fails.
        """
        host = self.camera.host
        host.sleep_until(host.now_ns() + 700 * MS)
        self.camera.advance()
        self.dialled += 1
        if self.dialled <= self.camera.faults.dials_fail or (self.camera.statuses()[70] == 3 and self.camera.asleep):
            raise LinkLost("the camera does not answer the connection request")
        self.camera.wake()
        return AirLink(self)


class AirLink:
    """A connection; `BleLink`."""

    def __init__(self, air: Air) -> None:
        self.air, self.camera = air, air.camera
        self.host = air.camera.host
        self.opened_ns = self.host.now_ns()
        self.registered: list[int] = []
        self._queue: list[tuple[int, int, str, bytes]] = []
        self._count = self._last_ns = 0
        self._message: dict[str, tuple[int, bytearray]] = {}
        self._open = True
        self.camera.changed.append(self._push)

    # ---- the host's side --------------------------------------------------------------------------------------------

    def write(self, characteristic: str, packet: bytes) -> None:
        """A packet to the camera; returns when the camera's radio has acknowledged it."""
        self._alive()
        if len(packet) > 20:
            raise LinkLost(f"a packet of {len(packet)} bytes")
        self.host.sleep_until(self.air.there.arrives_ns(self.host.now_ns(), self.camera.rng))
        self._alive()
        with self.camera.lock:
            self._take(characteristic[4:8], bytes(packet))

    def receive(self, timeout_ns: int) -> tuple[str, bytes] | None:
        """The next notification, as it comes through the air."""
        until = self.host.now_ns() + timeout_ns
        while True:
            self._alive()
            now = self.host.now_ns()
            if self._queue and self._queue[0][0] <= now:
                _, _, short, packet = heapq.heappop(self._queue)
                return _UUID.format(short), packet
            if now >= until:
                return None
            nexts = [until, *(q[0] for q in self._queue[:1]), *self._breaks()]
            if self.camera.next_ns is not None:
                nexts.append(self.camera.next_ns)
            self.host.sleep_until(max(min(nexts), now + 1))

    def close(self) -> None:
        """Hang up."""
        if self._open:
            self._open = False
            self.camera.changed.remove(self._push)

    def _breaks(self) -> list[int]:
        times = [self.camera.since(t) for t in self.camera.faults.link_lost_s]
        return [t for t in times if t > self.opened_ns]

    def _alive(self) -> None:
        self.camera.advance()
        broke = any(t <= self.host.now_ns() for t in self._breaks())
        if not self._open or broke or self.camera.asleep:
            self.close()
            raise LinkLost("the Bluetooth connection broke off")

    # ---- the camera's side ------------------------------------------------------------------------------------------

    def _take(self, short: str, packet: bytes) -> None:
        """A packet arrives. As the real one, it does not mind hosts that send 0x80 for each continuation."""
        first = packet[0]
        if first & 0x80:
            if short not in self._message:
                return
            length, got = self._message[short]
            got += packet[1:]
        else:
            if first & 0x60 == 0x20:
                length, body = int.from_bytes(packet[:2], "big") & 0x1FFF, packet[2:]
            elif first & 0x60 == 0:
                length, body = first & 0x1F, packet[1:]
            else:
                return  # 16-bit lengths come from the camera only
            self._message[short] = (length, bytearray(body))
        length, got = self._message[short]
        if len(got) >= length:
            del self._message[short]
            self._answer(short, bytes(got[:length]))

    def _answer(self, short: str, message: bytes) -> None:
        if not message or short not in _ANSWERS:
            return
        number, rest = message[0], message[1:]
        if short == "0072":
            reply = self._command(number, rest)
        elif short == "0074":
            reply = self._setting(number, rest)
        else:
            reply = self._query(number, rest)
        if reply is not None:
            self._send(_ANSWERS[short], bytes([number]) + reply)

    def _command(self, number: int, rest: bytes) -> bytes | None:
        camera, air = self.camera, self.air
        if number == 0x01:
            good = len(rest) == 2 and rest[0] == 1 and camera.shutter(bool(rest[1]))
            air.shutters += 1
            return None if air.shutters - 1 in camera.faults.answer_lost else bytes([0 if good else 1])
        if number == 0x05:
            camera.at(self.host.now_ns() + 300 * MS, camera.sleep)
            return b"\0"
        if number == 0x3C:
            air.hardware_asked += 1
            if air.hardware_asked <= camera.faults.not_ready:
                return b"\1"
            nature = camera.nature
            told = [b"\0\0\0\x37", *(t.encode() for t in (
                nature.model, "0x05", nature.firmware, nature.serial, nature.ssid, "d43260000001"))]  # fmt: skip
            return b"\0" + b"".join(bytes([len(t)]) + t for t in told)
        if number == 0x51:
            return b"\0\1\2\1\0"
        return b"\0" if number in (0x0D, 0x17, 0x18) else b"\2"

    def _setting(self, number: int, rest: bytes) -> bytes:
        if number == 0x5B:
            return b"\0"
        if len(rest) != 2 or rest[0] != 1:
            return b"\2"
        said = self.camera.set(number, rest[1])
        return b"\0" if said is None else b"\2" if said.error in (2, 4) else b"\1"

    def _query(self, number: int, ids: bytes) -> bytes:
        if number in (0x12, 0x52):
            found = {n: bytes([v]) for n, v in self.camera.settings.items()}
        elif number in (0x13, 0x53):
            found = {n: _value(n, v) for n, v in self.camera.statuses().items()} | _UNKNOWN
            if number == 0x53:
                self.registered = list(ids) or list(found)
        else:
            return b"\2"
        chosen = list(ids) or list(found)
        self.camera.rng.shuffle(chosen)  # the order is not specified
        return b"\0" + b"".join(bytes([n, len(found[n])]) + found[n] for n in chosen if n in found)

    def _push(self, ids: set[int]) -> None:
        mine = [n for n in self.registered if n in ids]
        if mine:
            now = {n: _value(n, v) for n, v in self.camera.statuses().items()}
            body = b"".join(bytes([n, len(now[n])]) + now[n] for n in mine if n in now)
            self._send("0077", b"\x93\x00" + body, late=round(self.camera.rng.uniform(0, 80) * MS))

    def _send(self, short: str, message: bytes, late: int = 0) -> None:
        """Cut into packets and put into the air; damaged where the faults say so."""
        parts = _cut(message)
        if len(parts) > 1 and message[0] not in (0x92, 0x93):
            if self.air.many in self.camera.faults.broken_replies:
                parts = _damage(parts, self.camera.faults.broken_how)
            self.air.many += 1
        at = self.camera.now_ns + late
        for part in parts:
            at = max(self.air.back.arrives_ns(at, self.camera.rng), self._last_ns if not late else 0)
            self._count += 1
            heapq.heappush(self._queue, (at, self._count, short, part))
        if not late:
            self._last_ns = at


def _value(number: int, value: int | str) -> bytes:
    if isinstance(value, str):
        return value.encode()
    return int(value).to_bytes(_LENGTHS.get(number, 1), "big")


def _cut(message: bytes) -> list[bytes]:
    if len(message) < 20:
        return [bytes([len(message)]) + message]
    out = [(0x2000 | len(message)).to_bytes(2, "big") + message[:18]]
    for n, at in enumerate(range(18, len(message), 19)):
        out.append(bytes([0x80 | n % 16]) + message[at : at + 19])
    return out


def _damage(parts: list[bytes], how: str) -> list[bytes]:
    middle = len(parts) // 2
    if how == "repeated":
        return [*parts[: middle + 1], *parts[middle:]]
    return parts[:-1] if how == "cut" else parts[:middle] + parts[middle + 1 :]
