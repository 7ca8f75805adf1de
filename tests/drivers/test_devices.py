"""The output of `devices` and `udev`."""

from __future__ import annotations

import json
import re

import pytest

from stereo_sfm import cli
from stereo_sfm.drivers.devices import list_devices, udev_rules
from stereo_sfm.drivers.driver import Attached
from stereo_sfm.drivers.live.errors import DeviceFault
from stereo_sfm.drivers.t265.simulated.bus import SimulatedBus
from stereo_sfm.drivers.t265.simulated.camera import SimulatedCamera
from stereo_sfm.drivers.t265.simulated.faults import Faults
from tests.drivers.oak_rig import FakeOak
from tests.drivers.t265_rig import noise_content


def camera(faults: Faults | None = None, serial: str = "0000D0C0FFEE", booted: bool = True) -> SimulatedCamera:
    out = SimulatedCamera(noise_content(1), faults, serial=serial)
    out.booted = booted
    return out


def list_on(
    bus: SimulatedBus, monkeypatch: pytest.MonkeyPatch, probe: bool = False
) -> tuple[list[Attached], list[str]]:
    monkeypatch.setattr("stereo_sfm.drivers.t265.usb_device.default_backend", lambda: bus)
    return list_devices(probe)


@pytest.fixture
def oak(monkeypatch: pytest.MonkeyPatch) -> FakeOak:
    fake = FakeOak(attached=0)
    monkeypatch.setattr("stereo_sfm.drivers.oak.library.load", lambda: fake)
    return fake


def test_every_state_of_a_t265(oak: FakeOak, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STEREO_SFM_T265_FIRMWARE", "/no/such/file")
    cameras = [
        camera(booted=False),
        camera(serial="00000000ABCD"),
        camera(Faults(refuse_open=13)),
        camera(Faults(refuse_claim=16)),
        camera(Faults(speed=3, uncalibrated=True)),
        camera(Faults(silent_commands=True)),
    ]
    found, problems = list_on(SimulatedBus(cameras), monkeypatch)
    assert problems == []
    unbooted, good, forbidden, busy, slow, silent = found
    assert (unbooted.firmware, unbooted.usb_speed, unbooted.calibrated) == ("none", "high", None)
    assert "/no/such/file" in unbooted.note and "firmware extract" in unbooted.note
    assert (good.id, good.usb_speed, good.firmware, good.calibrated, good.note) == (
        "t265:00000000ABCD", "super", "0.2.0.951", True, "",
    )  # fmt: skip
    assert "stereo-sfm udev" in forbidden.note
    assert "another program" in busy.note
    assert (slow.calibrated, slow.usb_speed) == (False, "high") and "USB 2" in slow.note
    assert "does not answer" in silent.note
    assert not any(c.boot_bytes for c in cameras)  # looking boots nothing


def test_oaks_are_listed_and_only_probed_on_request(oak: FakeOak, monkeypatch: pytest.MonkeyPatch) -> None:
    oak.attached = 2
    found, _ = list_on(SimulatedBus([]), monkeypatch)
    assert [(d.id, d.driver, d.calibrated) for d in found] == [
        ("oak:18443010", "oak", None),
        ("oak:18443011", "oak", None),
    ]
    assert oak.opened == 0
    found, _ = list_on(SimulatedBus([]), monkeypatch, probe=True)
    assert [(d.usb_speed, d.calibrated) for d in found] == [("super", True)] * 2
    oak.open_error = "X_LINK_DEVICE_ALREADY_IN_USE"
    found, _ = list_on(SimulatedBus([]), monkeypatch, probe=True)
    assert "another program" in found[0].note


def test_a_failing_driver_does_not_hide_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise DeviceFault("no depthai here")

    monkeypatch.setattr("stereo_sfm.drivers.oak.library.load", broken)
    found, problems = list_on(SimulatedBus([camera()]), monkeypatch)
    assert [d.driver for d in found] == ["t265"]
    assert problems == ["oak: no depthai here"]


def test_commands(oak: FakeOak, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("stereo_sfm.drivers.t265.usb_device.default_backend", lambda: SimulatedBus([camera()]))
    assert cli.main(["devices"]) == 0
    assert re.search(r"t265:0000D0C0FFEE +t265 +0000D0C0FFEE +super +0\.2\.0\.951 +yes", capsys.readouterr().out)
    assert cli.main(["devices", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["devices"][0]["firmware"] == "0.2.0.951"
    monkeypatch.setattr("stereo_sfm.drivers.t265.usb_device.default_backend", lambda: SimulatedBus([]))
    assert cli.main(["devices"]) == 0
    assert "no OAK or RealSense or T265 attached" in capsys.readouterr().out
    assert cli.main(["t265", "reset"]) == 2
    assert "no T265 attached" in capsys.readouterr().err


def test_reset_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    one = camera()
    monkeypatch.setattr("stereo_sfm.drivers.t265.usb_device.default_backend", lambda: SimulatedBus([one]))
    assert cli.main(["t265", "reset"]) == 0
    assert not one.booted
    assert "the next run or recording boots it" in capsys.readouterr().out


def test_udev_rules_cover_all_ids(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["udev", "-q"]) == 0
    message = capsys.readouterr()
    assert message.out == udev_rules() and message.err == ""
    rules = [line for line in udev_rules().splitlines() if not line.startswith("#")]
    for vendor, product in (("8087", "0b37"), ("8087", "0af3"), ("03e7", None)):
        fitting = [r for r in rules if f'ATTR{{idVendor}}=="{vendor}"' in r and (product is None or product in r)]
        assert len(fitting) == 1
        assert 'TAG+="uaccess"' in fitting[0] and 'MODE="0660"' in fitting[0]
