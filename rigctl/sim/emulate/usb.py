"""An emulated USB bus below pyusb: FT601 bridges with spike cameras behind them, byte-exact, with faults as data."""

from __future__ import annotations

import errno
import struct
from array import array
from collections.abc import Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import usb.core

from spikerig.rigctl.host import Host
from spikerig.rigctl.sim.emulate.bridge import Bridge

_CODES = {
    errno.ENODEV: (-4, "No such device (it may have been disconnected)"),
    errno.EPIPE: (-9, "Pipe error"),
    errno.EOVERFLOW: (-8, "Overflow"),
    errno.EIO: (-1, "Input/Output Error"),
    errno.EBUSY: (-6, "Resource busy"),
    errno.EACCES: (-3, "Access denied (insufficient permissions)"),
    errno.EINTR: (-10, "System call interrupted (perhaps due to signal)"),
    errno.ETIMEDOUT: (-7, "Operation timed out"),
    errno.ENOENT: (-5, "Entity not found"),
}


def usb_error(number: int) -> usb.core.USBError:
    """The exception that pyusb's libusb1 backend raises for an errno."""
    code, text = _CODES[number]
    kind = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    return kind(text, code, number)


class Plug:
    """A device as enumerated once: after an unplug the next enumeration makes another."""

    def __init__(self, bridge: Bridge, plugged: int, address: int) -> None:
        self.bridge, self.plugged, self.address = bridge, plugged, address


class EmulatedUsb:
    """What `usb.core.find(backend=...)` talks to: the methods of pyusb's `IBackend` that a bulk device needs.

    Args:
        host: time; the emulation's true time is this host's.
        bridges: what is on the bus.
    """

    def __init__(self, host: Host, bridges: Sequence[Bridge]) -> None:
        self.host, self.bridges = host, list(bridges)
        self._address = 1
        self._plugs: dict[int, Plug] = {}
        self.calls: list[str] = []  # of clear_halt, reset and claims, so that tests see what was done

    # -- finding ----------------------------------------------------------------------------------------------------
    def enumerate_devices(self) -> Iterable[Plug]:
        """Devices that are plugged in now."""
        found = []
        for number, bridge in enumerate(self.bridges):
            plugged = bridge.plugged(self.host.now_ns())
            if plugged is None:
                continue
            known = self._plugs.get(number)
            if known is None or known.plugged != plugged:
                self._address += 1
                known = self._plugs[number] = Plug(bridge, plugged, self._address)
            found.append(known)
        return iter(found)

    def get_parent(self, dev: Plug) -> None:
        """No hub is emulated."""
        return None

    def get_device_descriptor(self, dev: Plug) -> SimpleNamespace:
        """18 bytes' worth, and where it is plugged in."""
        b = dev.bridge
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0300, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=9, idVendor=b.vendor, idProduct=b.product, bcdDevice=0, iManufacturer=1, iProduct=2,
            iSerialNumber=3, bNumConfigurations=1, bus=2, address=dev.address, port_number=b.port,
            port_numbers=(b.port,), speed=4,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Plug, config: int) -> SimpleNamespace:
        """One configuration."""
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=62, bNumInterfaces=2, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0xE0, bMaxPower=12, extra_descriptors=b"",
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Plug, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Commands on interface 0, data on 1."""
        if intf > 1 or alt or config:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=0xFF, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=b"",
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Plug, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """0x01 bulk and 0x81 interrupt; 0x02 and 0x82 bulk."""
        layout = (((0x01, 2, 1024), (0x81, 3, 64)), ((0x02, 2, 1024), (0x82, 2, 1024)))
        if alt or config or intf > 1 or ep > 1:
            raise IndexError(ep)
        address, kind, size = layout[intf][ep]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=kind, wMaxPacketSize=size,
            bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=b"",
        )  # fmt: skip

    # -- handles ----------------------------------------------------------------------------------------------------
    def open_device(self, dev: Plug) -> Plug:
        """A handle dies with the plug it was opened on."""
        self._alive(dev)
        if dev.bridge.fault(self.host.now_ns(), "denied"):
            raise usb_error(errno.EACCES)
        return Plug(dev.bridge, dev.plugged, dev.address)

    def close_device(self, dev_handle: Plug) -> None:
        """Interfaces go back."""
        if dev_handle.bridge.owner is dev_handle:
            dev_handle.bridge.release(self.host.now_ns())

    def set_configuration(self, dev_handle: Plug, config_value: int) -> None:
        """There is only one."""
        self._alive(dev_handle)

    def get_configuration(self, dev_handle: Plug) -> int:
        """The one there is."""
        self._alive(dev_handle)
        return 1

    def claim_interface(self, dev_handle: Plug, intf: int) -> None:
        """Taken by one handle at a time."""
        self.calls.append(f"claim {intf}")
        bridge = self._alive(dev_handle)
        taken = bridge.owner is not None and bridge.owner is not dev_handle
        if taken or bridge.fault(self.host.now_ns(), "busy"):
            raise usb_error(errno.EBUSY)
        bridge.owner = dev_handle

    def release_interface(self, dev_handle: Plug, intf: int) -> None:
        """Only the last one counts: the driver gives both back together."""
        self._alive(dev_handle)

    def is_kernel_driver_active(self, dev_handle: Plug, intf: int) -> bool:
        """True while a kernel driver (ft60x.ko) holds it."""
        return bool(self._alive(dev_handle).fault(self.host.now_ns(), "busy"))

    def clear_halt(self, dev_handle: Plug, ep: int) -> None:
        """Ends a stall."""
        self.calls.append(f"clear_halt 0x{ep:02x}")
        self._alive(dev_handle).halted = False

    def reset_device(self, dev_handle: Plug) -> None:
        """The bridge forgets its stream."""
        self.calls.append("reset")
        self._alive(dev_handle).release(self.host.now_ns())

    # -- transfers --------------------------------------------------------------------------------------------------
    def bulk_write(self, dev_handle: Plug, ep: int, intf: int, data: array, timeout: int) -> int:
        """Commands; anything that is not one stalls the endpoint."""
        bridge = self._alive(dev_handle)
        if ep != 0x01 or len(data) != 20:
            raise usb_error(errno.EPIPE)
        _, pipe, verb, zero, length, _, _ = struct.unpack("<IBBHIII", data.tobytes())
        if verb > 3 or zero or pipe not in (0, 0x02, 0x82):
            raise usb_error(errno.EPIPE)
        bridge.command(self.host.now_ns(), verb, pipe, length)
        return len(data)

    def bulk_read(self, dev_handle: Plug, ep: int, intf: int, buff: array, timeout: int) -> int:
        """Bytes of the stream: sleeps until they are there, or until the timeout."""
        bridge = self._alive(dev_handle)
        size = len(buff) * buff.itemsize
        if ep != 0x82:
            raise usb_error(errno.EIO)
        began = self.host.now_ns()
        until = began + (timeout * 1_000_000 if timeout else 1 << 62)
        plan = bridge.read(began, size, until, dev_handle.plugged)
        early = getattr(bridge.wire.source, "timeless", False)  # as the bus does it: while they come, not afterwards
        if not early:
            self.host.sleep_until(plan.done_ns)
        out = np.frombuffer(buff, np.uint8)
        at = 0
        for run in plan.runs:
            bridge.wire.copy(run.start, out[at : at + run.stop - run.start])
            at += run.stop - run.start
        self.host.sleep_until(plan.done_ns)
        if plan.error:
            raise usb_error(plan.error)
        return at

    def intr_read(self, dev_handle: Plug, ep: int, intf: int, buff: array, timeout: int) -> int:
        """No notifications come: they are off in the chip's settings."""
        self._alive(dev_handle)
        self.host.sleep_until(self.host.now_ns() + timeout * 1_000_000)
        raise usb_error(errno.ETIMEDOUT)

    def _unused(self, *args: object) -> int:
        raise usb_error(errno.EIO)

    intr_write = iso_read = iso_write = _unused  # pyusb looks them up at every transfer

    def ctrl_transfer(
        self, dev_handle: Plug, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: array, timeout: int
    ) -> int:
        """Strings, the chip's version and its settings; anything else stalls."""
        bridge = self._alive(dev_handle)
        reply = bridge.control(self.host.now_ns(), bmRequestType, bRequest, wValue)
        if reply is None:
            raise usb_error(errno.EPIPE)
        n = min(len(reply), len(data))
        data[:n] = array("B", reply[:n])
        return n

    def _alive(self, plug: Plug) -> Bridge:
        if plug.bridge.plugged(self.host.now_ns()) != plug.plugged:
            raise usb_error(errno.ENODEV)
        return plug.bridge

    def truth(self) -> Iterator[dict[str, Any]]:
        """What really happened, a bridge at a time."""
        for bridge in self.bridges:
            yield bridge.truth(self.host.now_ns())
