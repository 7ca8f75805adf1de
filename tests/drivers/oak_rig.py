"""A camera that is not there, made of depthai's own messages, queues and calibration handler."""

from __future__ import annotations

import threading
import time
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from stereo_sfm.drivers.oak.library import load

dai = load()
FIXTURES = Path(__file__).parent / "fixtures"
SIZE = (640, 400)
PERIOD_S = 1 / 30


def calibration(name: str = "oak_d") -> Any:
    """depthai's handler from a file as `eepromToJsonFile` writes it."""
    return dai.CalibrationHandler(str(FIXTURES / f"{name}.json"))


def frame(socket: int, number: int, stamp_s: float, exposure_us: int = 8000, size: tuple[int, int] = SIZE) -> Any:
    """An ImgFrame as CAM_B (1) or CAM_C (2) sends it; its stamp is the end of the exposure."""
    out = dai.ImgFrame()
    pixels = np.full((size[1], size[0]), (number * 7 + socket) % 256, np.uint8)
    out.setCvFrame(pixels, dai.ImgFrame.Type.GRAY8)
    out.setInstanceNum(socket)
    out.setSequenceNum(number)
    out.setTimestampDevice(timedelta(seconds=stamp_s))
    out.setTimestamp(timedelta(seconds=stamp_s + 100))
    out.cam.exposureTimeUs = exposure_us
    out.cam.sensitivityIso = 400
    return out


def motion(stamp_s: float, value: float) -> Any:
    """An IMUData of one packet."""
    packet = dai.IMUPacket()
    for report, late in ((packet.acceleroMeter, 0.0), (packet.gyroscope, 0.001)):
        nanoseconds = round((stamp_s + late) * 1e9)
        stamp = dai.Timestamp()
        stamp.sec, stamp.nsec = divmod(nanoseconds, 1_000_000_000)
        report.tsDevice = stamp
        report.x, report.y, report.z = value, 0.0, 9.81
    out = dai.IMUData()
    out.packets = [packet]
    return out


class FakeOak:
    """Stands in for the parts of depthai that need a camera: Device, Pipeline, nodes. Everything else is depthai."""

    def __init__(self, attached: int = 1, speed: str = "SUPER", calibrated: bool = True) -> None:
        self.attached, self.speed, self.calibrated = attached, speed, calibrated
        self.opened = 0
        self.loses_after: int | None = None  # frames of the first segment
        self.open_error = ""
        self.outputs: list[dict[str, Any]] = []
        self.controls: list[Any] = []
        self.projector: list[float] = []
        self.skip: set[int] = set()  # sequence numbers of the left camera that never come

    def __getattr__(self, name: str) -> Any:
        return getattr(dai, name)

    @property
    def Device(self) -> Any:
        fake = self

        class Device:
            def __init__(self, info: Any) -> None:
                if fake.open_error:
                    raise RuntimeError(fake.open_error)
                fake.opened += 1
                self.closed = False

            @staticmethod
            def getAllAvailableDevices() -> list[Any]:
                return [
                    SimpleNamespace(
                        deviceId=f"1844301{k}", name=f"1.{k}", state="XLinkDeviceState.X_LINK_UNBOOTED",
                        protocol="XLinkProtocol.X_LINK_USB_VSC", status="XLinkError_t.X_LINK_SUCCESS",
                    )
                    for k in range(fake.attached)
                ]  # fmt: skip

            def getUsbSpeed(self) -> Any:
                return getattr(dai.UsbSpeed, fake.speed)

            def getCalibration(self) -> Any:
                return calibration() if fake.calibrated else dai.CalibrationHandler()

            def isCalibrationAvailable(self) -> bool:
                return fake.calibrated

            def getProductName(self) -> str:
                return "OAK-D"

            def getConnectedIMU(self) -> str:
                return "BNO086"

            def setIrLaserDotProjectorIntensity(self, intensity: float) -> bool:
                fake.projector.append(intensity)
                return True

            def setIrFloodLightIntensity(self, intensity: float) -> bool:
                raise RuntimeError("no flood light")

            def close(self) -> None:
                self.closed = True

        return Device

    @property
    def Pipeline(self) -> Any:
        fake = self

        class Pipeline:
            def __init__(self, device: Any) -> None:
                self.queues: list[Any] = []
                self.running = threading.Event()
                self.segment = fake.opened

            def create(self, kind: Any) -> Any:
                return Node(self)

            def start(self) -> None:
                self.running.set()
                threading.Thread(target=self.feed, daemon=True).start()

            def stop(self) -> None:
                self.running.clear()

            def feed(self) -> None:
                left, right, *imu = self.queues
                last = fake.loses_after if self.segment == 1 else None
                for number in range(10_000):
                    if not self.running.is_set() or number == last:
                        break
                    stamp = 5 + number * PERIOD_S
                    if number not in fake.skip:
                        left.send(frame(1, number, stamp))
                    right.send(frame(2, number, stamp + 1e-5))
                    for queue in imu:
                        queue.send(motion(stamp - 0.01, number))
                    time.sleep(PERIOD_S)
                for queue in self.queues:
                    queue.close()

        class Node:
            def __init__(self, pipeline: Any) -> None:
                self.pipeline, self.out = pipeline, self
                self.initialControl = dai.CameraControl()

            def build(self, socket: Any, sensorFps: float) -> Any:
                fake.controls.append((socket, self.initialControl))
                return self

            def requestOutput(self, size: tuple[int, int], **how: Any) -> Any:
                fake.outputs.append({"size": size, **how})
                return self

            def createOutputQueue(self, maxSize: int, blocking: bool) -> Any:
                queue = dai.MessageQueue("out", maxSize, blocking)
                self.pipeline.queues.append(queue)
                return queue

            def enableIMUSensor(self, sensors: Any, rate: int) -> None:
                assert [s.name for s in sensors] == ["ACCELEROMETER_RAW", "GYROSCOPE_RAW"]

            def setBatchReportThreshold(self, count: int) -> None: ...

            def setMaxBatchReports(self, count: int) -> None: ...

        return Pipeline
