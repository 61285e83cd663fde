"""An emulated rig below the drivers: bytes on a USB backend, a serial port, a radio, all on one emulated time."""
