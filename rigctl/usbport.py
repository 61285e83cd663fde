"""Finding and opening a spike camera's USB bridge; each way it can fail is told with its cure."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import Any

from spikerig.dataset.errors import DeviceError, HostError, RigError, UsageError
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.ft60x import (
    CONFIG_BYTES,
    CONFIG_REQUEST,
    DATA_IN,
    INTERFACES,
    PRODUCTS,
    VENDOR,
    VERSION_REQUEST,
    Fault,
    fault_of,
    parse_config,
    parse_version,
)
from spikerig.rigctl.profiles import DEFAULT, PROFILES

FALLBACKS = tuple(
    dataclasses.replace(PROFILES[DEFAULT], vendor=VENDOR, product=product) for product in PRODUCTS
)  # what `rig find` looks for
RULE_FILE = "/etc/udev/rules.d/70-spikerig.rules"


def udev_rule(vendor: int, product: int) -> str:
    """The line that lets the person at the screen use the camera."""
    return f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{vendor:04x}", ATTRS{{idProduct}}=="{product:04x}", TAG+="uaccess"'


def libusb(load: Callable[[], Any] | None = None) -> Any:
    """The real USB backend: libusb-1.0 of the system, else the one of libusb-package.

    Raises:
        HostError: there is none.
    """
    found = (load or _load)()
    if found is None:
        raise HostError(
            "libusb-1.0 was not found",
            expected="the system's library, or the Python package libusb-package",
            next="apt install libusb-1.0-0, or pip install libusb-package",
        )
    return found


def _load() -> Any:
    import usb.backend.libusb1

    found = usb.backend.libusb1.get_backend()
    if found is None:
        try:
            import libusb_package
        except ImportError:
            return None
        found = libusb_package.get_libusb1_backend()
    return found


def cameras(backend: Any, vendor: int, product: int) -> list[Any]:
    """Devices of pyusb with this identity, in the order of the bus."""
    import usb.core

    try:
        return list(usb.core.find(find_all=True, backend=backend, idVendor=vendor, idProduct=product) or [])
    except usb.core.USBError as error:
        raise refusal(error, "the USB bus cannot be searched", vendor, product) from error


def serial_of(device: Any) -> str:
    """A device's serial; empty where its strings are damaged or may not be read."""
    try:
        return device.serial_number or ""
    except (OSError, ValueError, IndexError, UnicodeDecodeError):
        return ""


def address_of(device: Any) -> str:
    """Where it is plugged in, as `bus-port`: this stays when it comes back, other than its address."""
    ports = ".".join(str(p) for p in device.port_numbers or ())
    return f"usb:{device.bus}-{ports}" if ports else f"usb:{device.bus}:{device.address}"


def pick(backend: Any, profile: WireProfile, wanted: str = "") -> Any:
    """The one device asked for.

    Args:
        backend: of pyusb.
        profile: its USB identity.
        wanted: a serial, or an address as `address_of` tells it; empty: the only one there is.

    Raises:
        DeviceError: none, or more than one.
    """
    found = cameras(backend, profile.vendor, profile.product)
    fits = [d for d in found if wanted in ("", address_of(d)) or wanted == serial_of(d)]
    if len(fits) == 1:
        return fits[0]
    listed = ", ".join(f"{serial_of(d) or '(no serial)'} at {address_of(d)}" for d in found) or "none"
    raise DeviceError(
        "more than one spike camera answers to this" if fits else "no spike camera was found",
        value=f"{profile.vendor:04x}:{profile.product:04x}, serial {wanted or 'any'}; plugged in: {listed}",
        expected="one; name it by its address where serials are alike" if fits else "",
        cause="" if fits else "not plugged in, no power, or other USB ids than the profile's",
        next="give the address as the serial" if fits else "spikerig rig find",
    )


def open_port(device: Any, profile: WireProfile) -> DeviceFacts:
    """Claim the bridge and ask what it is; a device that is opened already is only asked.

    Raises:
        DeviceError: someone else holds it, or it is gone or broken.
        HostError: no permission.
    """
    import usb.core
    import usb.util

    try:
        for interface in INTERFACES:
            usb.util.claim_interface(device, interface)
        version = parse_version(bytes(device.ctrl_transfer(0xC0, VERSION_REQUEST, 0, 0, 4, 1000)))
    except usb.core.USBError as error:
        usb.util.dispose_resources(device)
        raise refusal(error, "the spike camera cannot be opened", profile.vendor, profile.product) from error
    except NotImplementedError as error:
        raise HostError("the USB backend cannot do this", value=str(error)) from error
    more: dict[str, Any] = {"vendor": profile.vendor, "product": profile.product, "speed": device.speed}
    try:
        config = parse_config(bytes(device.ctrl_transfer(0xC0, CONFIG_REQUEST, 1, 0, CONFIG_BYTES, 1000)))
        more |= {"clock_mhz": config.clock_mhz, "channels": config.channels, "bus_bytes_s": config.bus_bytes_s}
    except (RigError, usb.core.USBError) as error:
        more["config"] = f"not read: {error}".split("\n")[0]
    size = next((e.wMaxPacketSize for i in device[0] for e in i if e.bEndpointAddress == DATA_IN), None)
    more["packet"] = size
    if size is None:
        usb.util.dispose_resources(device)
        raise UsageError("the device has no bulk endpoint 0x82", value=address_of(device), cause="not an FT60x bridge")
    model = PRODUCTS.get(profile.product, f"{profile.vendor:04x}:{profile.product:04x}")
    return DeviceFacts("spike", model, serial_of(device), version, address_of(device), more)


def give_back(device: Any) -> None:
    """Let go of a device; also of one that is gone."""
    import usb.util

    usb.util.dispose_resources(device)


def refusal(error: OSError, what: str, vendor: int, product: int) -> RigError:
    """The error to raise when a device cannot be opened or found."""
    fault, told = fault_of(error), f"{vendor:04x}:{product:04x}: {error}"
    if fault is Fault.DENIED:
        rule = udev_rule(vendor, product)
        return HostError(
            what + ": no permission", value=told, expected=f"a udev rule for it (this process is user {os.getuid()})",
            next=f"echo '{rule}' | sudo tee {RULE_FILE} && sudo udevadm control --reload && sudo udevadm trigger",
        )  # fmt: skip
    if fault is Fault.BUSY:
        return DeviceError(
            what + ": somebody else holds it", value=told,
            cause="the kernel module ft60x, or another program (the vendor's) that has it open",
            next="close the other program; sudo rmmod ft60x (and blacklist it, see docs/hardware/vidar.md)",
        )  # fmt: skip
    if fault is Fault.GONE:
        return DeviceError(what + ": it is gone", value=told, next="check the cable and the power; spikerig rig find")
    return DeviceError(what, value=told, next="unplug it, plug it in again; spikerig rig probe")
