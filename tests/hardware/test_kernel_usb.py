"""The simulated T265 as a real USB device: a kernel enumerates it, libusb carries it, the driver streams it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.hardware.kernel_usb import NEEDS, VHCI
from tests.hardware.qemu_guest import missing, run_in_guest
from tests.hardware.usb_descriptors import configuration, device, standard_request

KERNEL = Path(os.environ["STEREO_SFM_GUEST_KERNEL"]) if "STEREO_SFM_GUEST_KERNEL" in os.environ else None


def test_descriptors_contain_their_length() -> None:
    for booted in (False, True):
        assert len(device(booted)) == device(booted)[0] == 18
        whole = configuration(booted)
        assert int.from_bytes(whole[2:4], "little") == len(whole)
        at = count = 0
        while at < len(whole):
            count += whole[at + 1] == 5
            at += whole[at]
        assert (at, count) == (len(whole), whole[9 + 4])
    assert standard_request(bytes.fromhex("8006000100000800"), True, "") == device(True)[:8]
    assert standard_request(bytes.fromhex("8006000700000800"), True, "") is None


@pytest.mark.hardware
def test_through_this_kernel(report: dict[str, Any]) -> None:
    """On Linux with vhci_hcd, as root."""
    if not (VHCI / "attach").exists():
        pytest.skip(NEEDS)
    done = subprocess.run(
        [sys.executable, "-m", "tests.hardware.kernel_usb"], capture_output=True, text=True, check=False
    )
    report["output"] = done.stdout[-2000:]
    assert done.returncode == 0, done.stderr


@pytest.mark.hardware
@pytest.mark.parametrize("faults", ["none", "unplug"])
def test_through_the_kernel_of_a_guest(faults: str, report: dict[str, Any]) -> None:
    """$STEREO_SFM_GUEST_KERNEL names an unpacked kernel package; about three minutes each without KVM."""
    lack = missing(KERNEL)
    if lack or KERNEL is None:
        pytest.skip(lack)
    got, message = run_in_guest(KERNEL, ["--seconds", "15", "--faults", faults], timeout_s=400)
    assert got is not None, message[-3000:]
    report |= got
    assert got["wrong_images"] == 0
    assert any("03e7:2150" in d for d in got["usb_devices"])
    assert any("8087:0b37" in d for d in got["usb_devices"])
    assert got["pairs"] > 20
    if faults == "unplug":
        assert got["counters"]["disconnects"] >= 1
    else:
        assert "dropped" not in got["counters"]  # it lists what is not zero
