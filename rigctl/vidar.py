"""The Vidar spike camera behind its FT60x bridge, over pyusb: a stream of wire bytes without header, number or time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError, HostError, RigError, UsageError
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl import usbport
from spikerig.rigctl.devices import Block, DeviceFacts
from spikerig.rigctl.ft60x import COMMANDS, DATA_IN, Fault, fault_of, start_commands, stop_commands
from spikerig.rigctl.host import Host
from spikerig.rigctl.pace import Pace, Rate

LEAST_BLOCK = 524_288
_TRIES = 5  # transfers that may fail in a row before the device counts as gone
_SILENCE_NS = NS  # without a byte: the stream is begun again
_DRAIN_NS = NS  # at most, for what lay in the camera's memory
_PUNCTUAL_NS = 200_000  # that a host may be late
_BACKOFF_NS = (50_000_000, 100_000_000, 200_000_000, 500_000_000, NS)


class VidarSource:
    """A `SpikeSource` on the USB bus.

    Args:
        profile: the camera's wire; also names its USB ids.
        host: time.
        backend: of pyusb; None: libusb on this machine.
        serial: of the camera, or its address as `rig find` tells it; empty: the only one there is.
        block_bytes: of a read; 0: at least 512 KiB in whole packets, and about 8 ms. Between two reads only the
            camera's own memory holds what comes, so few large reads lose less than many small ones.
        patience_ns: how long to wait for a camera that went away, or says nothing, before giving up.

    Raises:
        DeviceError, HostError: see `usbport.open_port`.
        UsageError: the profile's stream does not fit its link.

    Edges:
        Two buffers take turns. On a stalled endpoint `clear_halt` is called, and never otherwise (it kills the next
        run on some systems). The bridge's settings are never written.
    """

    def __init__(
        self,
        profile: WireProfile,
        host: Host,
        backend: Any = None,
        *,
        serial: str = "",
        block_bytes: int = 0,
        patience_ns: int = 30 * NS,
    ) -> None:
        from usb.util import create_buffer

        packet = profile.packet_bytes
        size = block_bytes or max(LEAST_BLOCK, round(0.008 * profile.bytes_s))
        self._size = max(1, -(-size // packet)) * packet
        self.profile, self._host, self._patience = profile, host, patience_ns
        self._backend = usbport.libusb() if backend is None else backend
        self._device: Any = usbport.pick(self._backend, profile, serial)
        self.facts: DeviceFacts = usbport.open_port(self._device, profile)
        self._wanted = self.facts.serial or self.facts.address
        self._arrays = [create_buffer(self._size) for _ in range(2)]
        self._small = create_buffer(packet)
        self._views = [np.frombuffer(a, np.uint8) for a in self._arrays]
        self.pace = Pace(profile.bytes_s)
        self._delayed: Callable[[], int] = getattr(host, "delayed_ns", lambda: 0)
        self.epoch = -1
        self._turn, self._index, self._streaming = 0, 0, False
        self._loss: tuple[int, str, int] = (0, "", 0)  # lost, why, suspect: for the next block to tell
        self._trouble, self._failed, self._silent = "", 0, False
        self._heard_ns = self._retry = self._clear_ns = 0

    def start(self) -> None:
        """Begin the stream: flush, stream, throw old bytes away until they come at the camera's own pace."""
        self._need_device()
        if self._streaming:
            raise UsageError("the stream runs already", value=self.facts.address)
        try:
            self._begin()
        except OSError as error:
            if fault_of(error) is not Fault.STALL:
                raise self._refused(error) from error
            self._device.clear_halt(DATA_IN)  # left over from a run that died
            self._begin()
        self._streaming, self._loss, self._heard_ns = True, (0, "", 0), self._host.now_ns()
        self._new_epoch("")

    def read(self, timeout_ns: int) -> Block | None:
        """The next bytes; see `SpikeSource.read`."""
        if not self._streaming:
            raise UsageError("the stream was not started", value=self.facts.address)
        until = self._host.now_ns() + timeout_ns
        while True:
            if self._device is None and not self._return(until):
                return None
            before, delayed = self._host.now_ns(), self._delayed()
            count = self._transfer(self._arrays[self._turn], until - before)
            after = self._host.now_ns()
            if count:
                return self._block(count, before, after, min(self._delayed() - delayed, after - before))
            if after >= until:
                return None

    def stop(self) -> None:
        """End the stream; may be called twice."""
        if self._streaming and self._device is not None:
            try:
                self._send(stop_commands())
            except OSError:
                pass  # it ends with the handle, and a device that is gone has no stream
        self._streaming = False

    def close(self) -> None:
        """Give the device back; may be called twice, and after errors."""
        self.stop()
        self._dispose()

    @property
    def doubtful_bytes(self) -> int:
        """Bytes at the end of what was read that came late and have not been made up for; ask after `stop`."""
        untold = self._loss[1] and not self._index  # a loss that the next block would have told
        return self._loss[2] if untold else self.pace.doubtful()

    def measured_rate(self) -> Rate | None:
        """Bytes a second as they come, on the host's clock; None in the first half second."""
        return self.pace.measured()

    # -- the stream -------------------------------------------------------------------------------------------------
    def _block(self, count: int, before: int, after: int, delay: int) -> Block:
        """Bytes that came, with what was lost before them; of their time `delay` was the host's own."""
        self._failed, self._retry, self._heard_ns = 0, 0, after
        data = self._views[self._turn][:count]
        self._turn ^= 1
        block = Block(data, self.epoch, self._index, before, after, *self._loss)
        self._index, self._loss = self._index + count, (0, "", 0)
        lapse = self.pace.add(before, after, count, delay)
        if lapse is not None:  # known from now on: this block still belongs to the old epoch, at its suspect end
            self._loss = (lapse.bytes, "rate", lapse.suspect)
            self.epoch, self._index = self.epoch + 1, 0
            self.pace.split(lapse)
        return block

    def _new_epoch(self, why: str) -> None:
        """The stream runs again, and nothing waits: count from here; the next block tells what is missing."""
        since = self._clear_ns
        lost, first, suspect = self._loss
        lost += max(0, round(self.pace.lag(since, self.pace.total))) if why else 0
        if self._index or not why:  # else the epoch before had not a single byte
            self.epoch, self._index = self.epoch + 1, 0
            suspect = self.pace.doubtful()
        self._loss = (lost, first or why, suspect)
        self.pace.begin(since)

    def _transfer(self, buffer: Any, left_ns: int) -> int:
        """One bulk read: how many bytes came. After an error the stream is caught up with, in a new epoch."""
        wait_ms = max(1, -(-max(left_ns, 0) // 1_000_000))  # 0 would mean for ever
        try:
            if self._silent:
                self._revive()
            else:
                return self._device.read(DATA_IN, buffer, wait_ms)
        except OSError as error:
            self._mend(error)
        return 0

    def _mend(self, error: OSError) -> None:
        """What an error of the data pipe asks for; whatever the transfer had carried is gone with it."""
        fault = fault_of(error)
        if fault is Fault.TIMEOUT:
            self._silent = self._host.now_ns() - self._heard_ns >= _SILENCE_NS
            return
        self._failed, self._trouble = self._failed + 1, fault.value
        if fault in (Fault.GONE, Fault.BUSY, Fault.DENIED) or self._failed >= _TRIES:
            self._lose()
            return
        try:
            if fault is Fault.STALL:
                self._device.clear_halt(DATA_IN)
            self._drain()
            self._new_epoch(self._trouble)
        except OSError as again:
            self._mend(again)

    def _revive(self) -> None:
        """Nothing came for long: begin the stream again; give up in the end."""
        still = self._host.now_ns() - self._heard_ns
        if still > self._patience:
            raise DeviceError(
                "the spike camera says nothing", value=f"{self._wanted}, {still / NS:.1f} s",
                cause="its sensor is not running, or its bridge hangs",
                next="power it off and on; spikerig rig probe",
            )  # fmt: skip
        self._send((*stop_commands(), *start_commands()))
        if self._drain():
            self._silent = False
            self._new_epoch("silence")

    def _begin(self) -> None:
        """Flush, stream, and catch up."""
        self._send(start_commands())
        self._drain()

    def _drain(self) -> bool:
        """Throw bytes away until they come at the camera's own pace: nothing waits any more. False: they do not come.

        What overflowed while nobody read lies somewhere in what waited: kept, it would be a gap inside an epoch.
        """
        end = self._host.now_ns() + _DRAIN_NS
        calm, came = 0, False
        self._clear_ns = self._host.now_ns()
        while calm < 2 and self._host.now_ns() < end:
            before = self._host.now_ns()
            try:
                count = self._device.read(DATA_IN, self._small, 100)
            except OSError as error:
                if fault_of(error) is not Fault.TIMEOUT:
                    raise
                continue
            came = True
            late = self._host.now_ns() - before - round(count / self.profile.bytes_s * NS)
            slack = max(_PUNCTUAL_NS, 0.1 * count / self.profile.bytes_s * NS)
            calm = calm + 1 if abs(late) < slack else 0  # neither a backlog nor a host that let one grow
            self._clear_ns = self._host.now_ns() - max(late, 0)
        return came

    def _send(self, commands: tuple[bytes, ...]) -> None:
        for each in commands:
            self._device.write(COMMANDS, each, 1000)

    # -- going away and coming back ---------------------------------------------------------------------------------
    def _lose(self) -> None:
        """The device is gone, or as good as gone: let go of it and look out for its return."""
        self._dispose()
        self._failed = 0

    def _return(self, until_ns: int) -> bool:
        """Look for a camera that went away until then; True when it is back and streams.

        Raises:
            DeviceError: it did not come back within the patience, or came and did not work.
        """
        while True:
            try:
                device = usbport.pick(self._backend, self.profile, self._wanted)
                facts = usbport.open_port(device, self.profile)
            except (DeviceError, HostError) as error:  # also no permission: udev comes after the plug
                self._give_up(error.what)
            else:
                self._device, self.facts = device, dataclasses.replace(facts, serial=facts.serial or self.facts.serial)
                try:
                    self._begin()
                    self._new_epoch(self._trouble)
                    return True
                except OSError as error:
                    self._dispose()
                    self._give_up(str(error))
            wait = _BACKOFF_NS[min(self._retry, len(_BACKOFF_NS) - 1)]
            self._retry += 1
            now = self._host.now_ns()
            self._host.sleep_until(min(now + wait, until_ns))
            if now + wait >= until_ns:
                return False

    def _give_up(self, cause: str) -> None:
        away = self._host.now_ns() - self._heard_ns
        if away > self._patience:
            raise DeviceError(
                "the spike camera went away and did not come back",
                value=f"{self._wanted}, {away / NS:.1f} s", cause=cause, next="check its cable; spikerig rig find",
            )  # fmt: skip

    def _refused(self, error: OSError) -> RigError:
        return usbport.refusal(error, "the stream does not begin", self.profile.vendor, self.profile.product)

    def _need_device(self) -> None:
        if self._device is None:
            raise DeviceError("the spike camera is closed or gone", value=self.facts.address, next="spikerig rig find")

    def _dispose(self) -> None:
        if self._device is not None:
            usbport.give_back(self._device)
        self._device = None


def find(
    host: Host, backend: Any = None, profiles: tuple[WireProfile, ...] = ()
) -> tuple[list[DeviceFacts], list[str]]:
    """Ask every USB device that may be a spike camera what it is.

    Args:
        host: not used, as no time passes.
        backend: of pyusb; None: libusb on this machine.
        profiles: whose USB ids are looked for; by default the FT600's and FT601's.

    Returns:
        The cameras found, and a line for each device that does not open, with the reason.

    Raises:
        HostError: there is no libusb.
    """
    bus = usbport.libusb() if backend is None else backend
    ids = {(p.vendor, p.product): p for p in (*usbport.FALLBACKS, *profiles)}
    found: list[DeviceFacts] = []
    failed: list[str] = []
    for profile in ids.values():
        for device in usbport.cameras(bus, profile.vendor, profile.product):
            try:
                found.append(usbport.open_port(device, profile))
            except RigError as error:
                failed.append(f"{usbport.address_of(device)}: " + str(error).replace("\n", ";"))
            usbport.give_back(device)
    return found, failed
