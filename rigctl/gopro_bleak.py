"""Bluetooth to a real GoPro through bleak (the extra "ble"): its asyncio loop runs in a thread of its own."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Coroutine
from concurrent.futures import TimeoutError as LateError
from types import ModuleType
from typing import Any

from spikerig.dataset.errors import HostError
from spikerig.rigctl.gopro_ble import REPLIES, uuid
from spikerig.rigctl.gopro_radio import LinkLost

SERVICE = "0000fea6-0000-1000-8000-00805f9b34fb"
_SCAN_S, _CONNECT_S, _WRITE_S = 10.0, 20.0, 5.0


class BleakLink:
    """A connection to a GoPro near by; `BleLink`.

    Args:
        name: of the camera ("GoPro 1234" or its last four digits); empty: the first one found.

    Raises:
        HostError: bleak is not installed, or there is no Bluetooth adapter.
        LinkLost: no camera found, or it did not connect this time.
    """

    def __init__(self, name: str = "") -> None:
        self._bleak = _bleak()
        self._notes: queue.Queue[tuple[str, bytes] | None] = queue.Queue()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="bleak", daemon=True)
        self._thread.start()
        self._client: Any = None
        self._gone = False
        try:
            self._client = self._run(self._connect(name), _SCAN_S + _CONNECT_S)
        except BaseException:
            self.close()
            raise

    def write(self, characteristic: str, packet: bytes) -> None:
        """Write a packet with response."""
        if self._gone:
            raise LinkLost("the Bluetooth connection is gone")
        self._run(self._client.write_gatt_char(characteristic, packet, response=True), _WRITE_S)

    def receive(self, timeout_ns: int) -> tuple[str, bytes] | None:
        """The next notification, or None."""
        if self._gone and self._notes.empty():
            raise LinkLost("the Bluetooth connection is gone")
        try:
            note = self._notes.get(timeout=max(timeout_ns, 1) / 1e9)
        except queue.Empty:
            return None
        if note is None:
            raise LinkLost("the Bluetooth connection broke off")
        return note

    def close(self) -> None:
        """Hang up and end the thread; may be called twice."""
        if self._loop.is_closed():
            return
        client, self._client, self._gone = self._client, None, True
        if client is not None:
            try:
                self._run(client.disconnect(), _WRITE_S)
            except LinkLost:
                pass  # it is gone anyway
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_WRITE_S)
        if not self._thread.is_alive():
            self._loop.close()

    async def _connect(self, name: str) -> Any:
        def ours(device: Any, told: Any) -> bool:
            seen = f"{device.name or ''} {getattr(told, 'local_name', None) or ''}"
            return SERVICE in (told.service_uuids or []) and name in seen

        device = await self._bleak.BleakScanner.find_device_by_filter(ours, timeout=_SCAN_S)
        if device is None:
            raise LinkLost(f"no GoPro {name or ''} is heard".replace("  ", " "))
        client = self._bleak.BleakClient(device, disconnected_callback=self._lost, timeout=_CONNECT_S)
        await client.connect()
        for short in REPLIES.values():
            await client.start_notify(uuid(short), lambda _, data, u=uuid(short): self._notes.put((u, bytes(data))))
        return client

    def _lost(self, client: Any) -> None:
        self._gone = True
        self._notes.put(None)

    def _run(self, work: Coroutine[Any, Any, Any], patience_s: float) -> Any:
        """Run something on the loop; every failure of Bluetooth is a lost link."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(patience_s)
        except LateError as error:
            future.cancel()
            raise LinkLost(f"no answer within {patience_s:g} s") from error
        except (OSError, EOFError, self._bleak.exc.BleakError) as error:
            if "NotAvailable" in type(error).__name__ or "No such file" in str(error):
                raise HostError("there is no Bluetooth here", cause=str(error), next="bluetoothctl show") from error
            raise LinkLost("the Bluetooth connection failed", cause=str(error)) from error


def _bleak() -> ModuleType:
    try:
        import bleak  # pyright: ignore[reportMissingImports]
        import bleak.exc  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise HostError(
            "control of a GoPro needs bleak, which is not installed", cause="the extra 'ble' was left out",
            next='pip install "spikerig[ble]", or record by hand (gopro.link = "hand")',
        ) from error  # fmt: skip
    return bleak
