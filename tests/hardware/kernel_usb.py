"""The driver, libusb and a real kernel against the simulated T265 as a USB device.

Needs root and Linux with vhci_hcd (`modprobe vhci-hcd`). Without such a kernel: `python -m tests.hardware.qemu_guest`,
which boots one. Run: python -m tests.hardware.kernel_usb [--seconds 10]
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import threading
import time
from pathlib import Path
from typing import Any

from stereo_sfm.drivers.live.source import Patience
from stereo_sfm.drivers.t265.acquire import Access
from stereo_sfm.drivers.t265.camera import Settings
from stereo_sfm.drivers.t265.link import Timing
from stereo_sfm.drivers.t265.simulated.camera import SimulatedCamera
from stereo_sfm.drivers.t265.simulated.faults import preset
from stereo_sfm.drivers.t265.simulated.source import SimulatedT265Source, checked_firmware
from stereo_sfm.drivers.t265.usb_device import attached, default_backend
from tests.drivers.t265_rig import noise_content
from tests.hardware.usbip_server import SUPER_SPEED, UsbIpServer, import_device

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
NEEDS = "needs root and Linux with vhci_hcd ('modprobe vhci-hcd'), or 'python -m tests.hardware.qemu_guest'"


class Plug(threading.Thread):
    """Plugs the camera into the virtual host controller whenever it is on its bus and not plugged in."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._port = port
        self.plugged = 0

    def run(self) -> None:
        while True:
            if not self._used():
                found = import_device(self._port)
                if found is not None:
                    connection, device, speed = found
                    with connection:
                        place = self._free("ss" if speed == SUPER_SPEED else "hs")
                        (VHCI / "attach").write_text(f"{place} {connection.fileno()} {device} {speed}\n")
                    self.plugged += 1
            time.sleep(0.05)

    @staticmethod
    def _ports() -> list[list[str]]:
        """hub, port, status (4: free), ... per line."""
        return [line.split() for line in (VHCI / "status").read_text().splitlines()[1:]]

    def _used(self) -> bool:
        return any(p[2] != "004" for p in self._ports())

    def _free(self, hub: str) -> int:
        return next(int(p[1]) for p in self._ports() if p[0] == hub and p[2] == "004")


def exercise(seconds: float, faults: str, paced: bool) -> dict[str, Any]:
    """Boot, stream, and with the fault 'unplug' reconnect, through the kernel."""
    camera = SimulatedCamera(noise_content(4), preset(faults), paced)
    server = UsbIpServer(camera)
    plug = Plug(server.port)
    plug.start()
    backend = default_backend()
    deadline = time.monotonic() + 10
    while not attached(backend) and time.monotonic() < deadline:
        time.sleep(0.05)
    seen = [f"{d.idVendor:04x}:{d.idProduct:04x} speed {d.speed}" for d in attached(backend)]
    access = Access(backend, firmware=checked_firmware, timing=Timing(settle_s=0.5, read_ms=2000))
    wrong = 0
    with SimulatedT265Source(camera, access, Settings(), Patience(stall_s=2.0), 60) as source:
        seen += [f"{d.idVendor:04x}:{d.idProduct:04x} speed {d.speed}" for d in attached(backend)]
        began, cpu = time.monotonic(), time.process_time()
        count = 0
        for image in source:
            count += 1
            left, _ = camera.content.image(source.frame_shown(image.stamp_ns))
            wrong += int(image.left[::50, ::50].tobytes() != left[::50, ::50].tobytes())
            if time.monotonic() - began > seconds:
                break
        wall, cpu = time.monotonic() - began, time.process_time() - cpu
    counters = {k: v for k, v in source.counters.items() if v}
    server.close()
    return {
        "kernel": Path("/proc/version").read_text().split()[2],
        "usb_devices": seen,
        "times_plugged_in": plug.plugged,
        "seconds": round(wall, 2),
        "pairs": count,
        "wrong_images": wrong,
        "camera_overruns": camera.overruns,
        "cpu_percent_with_server": round(100 * cpu / wall, 1),
        "counters": counters,
    }


def main() -> int:
    """Command line; 3 when a wrong image came, or none."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--faults", default="none", help="names of stereo_sfm.drivers.t265.simulated.faults.PRESETS")
    parser.add_argument("--paced", action="store_true", help="30 Hz; else as fast as this computer reads")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if not (VHCI / "attach").exists():
        print(f"no virtual USB host controller here: {NEEDS}", file=sys.stderr)
        return 2
    report = exercise(options.seconds, options.faults, options.paced)
    print("REPORT " + json.dumps(report))
    return 3 if report["wrong_images"] or not report["pairs"] else 0


if __name__ == "__main__":
    sys.exit(main())
