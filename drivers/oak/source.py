"""The OAK as a source: `oak`, `oak:ID?size=640x400&fps=30`."""

from __future__ import annotations

import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stereo_sfm.drivers.live.errors import NotFound, TooSlowLink
from stereo_sfm.drivers.live.source import LiveSource, Patience, with_rig
from stereo_sfm.drivers.oak.calibration import read_calibration
from stereo_sfm.drivers.oak.library import NO_OAK, choose, device_error, find, load, on_usb
from stereo_sfm.drivers.oak.stream import OakStream

if TYPE_CHECKING:
    from stereo_sfm.drivers.oak import OakOptions

logger = logging.getLogger("stereo_sfm")

_USB2_BYTES_PER_S = 30e6  # practical throughput of a high-speed link
_IMU_RATE_HZ = 200


@dataclass(frozen=True)
class Settings:
    """Stream settings."""

    size: tuple[int, int] = (640, 400)
    rate_hz: float = 30.0
    exposure_us: int | None = None  # None: automatic
    iso: int = 400  # with manual exposure
    anti_flicker: str = "MAINS_50_HZ"  # with automatic exposure
    max_exposure_us: int | None = None  # with automatic exposure
    imu: bool = True
    allow_slow: bool = False
    queue_frames: int = 30


class OakSource(LiveSource):
    """Live stereo images of one OAK (left CAM_B, right CAM_C), not rectified, with the factory calibration.

    Args:
        wanted: id or address, empty for the only one.
        settings: what to stream.
        patience: timeouts.
        name: of the source.
    """

    def __init__(self, wanted: str, settings: Settings, patience: Patience, name: str = "oak") -> None:
        super().__init__(name, "OAK", round(1e9 / settings.rate_hz), patience)
        if not wanted and not on_usb():
            raise NotFound(NO_OAK)
        self._settings, self._dai = settings, load()
        self._wanted = choose(find(self._dai), wanted).device_id or wanted
        self._device: Any = None
        try:
            self._open()
            handler = self._device.getCalibration()
            product = str(self._device.getProductName() or self._device.getDeviceName())
            self.rig = read_calibration(self._dai, handler, settings.size, product, self._wanted)
        except RuntimeError as error:
            self.close()
            raise device_error(error) from None
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        self._device = self._dai.Device(choose(find(self._dai), self._wanted).info)
        self._check_link()

    def _check_link(self) -> None:
        s, speed = self._settings, self._device.getUsbSpeed()
        needed = 2 * s.size[0] * s.size[1] * s.rate_hz
        slow = speed in (self._dai.UsbSpeed.LOW, self._dai.UsbSpeed.FULL, self._dai.UsbSpeed.HIGH)
        if slow and needed > _USB2_BYTES_PER_S and not s.allow_slow:
            raise TooSlowLink(
                f"the OAK is on a USB 2 link, which cannot carry {needed / 1e6:.0f} MB/s of images: use a USB 3 port "
                "and cable, a smaller size or rate (oak?size=640x400&fps=20), or allow losses with allow_slow=1"
            )

    def _start(self) -> OakStream:
        try:
            if self._device is None:
                self._open()
            return self._stream()
        except RuntimeError as error:
            raise device_error(error) from None

    def _stream(self) -> OakStream:
        dai, s = self._dai, self._settings
        pipeline = dai.Pipeline(self._device)
        left, right = (self._camera(pipeline, getattr(dai.CameraBoardSocket, name)) for name in ("CAM_B", "CAM_C"))
        imu = self._imu(pipeline) if s.imu and self._device.getConnectedIMU() else None
        with contextlib.suppress(RuntimeError):  # cameras without a projector raise
            self._device.setIrLaserDotProjectorIntensity(0.0)
            self._device.setIrFloodLightIntensity(0.0)
        pipeline.start()
        stream = OakStream(
            dai, left, right, imu, s.size, self._counters, self._period_ns, s.queue_frames, lambda: _stop(pipeline)
        )
        stream.start()
        return stream

    def _camera(self, pipeline: Any, socket: Any) -> Any:
        dai, s = self._dai, self._settings
        camera = pipeline.create(dai.node.Camera).build(socket, sensorFps=s.rate_hz)
        set_exposure(dai, camera.initialControl, s)
        raw = {"resizeMode": dai.ImgResizeMode.CROP, "enableUndistortion": False}
        output = camera.requestOutput(s.size, type=dai.ImgFrame.Type.GRAY8, fps=s.rate_hz, **raw)
        return output.createOutputQueue(maxSize=8, blocking=False)

    def _imu(self, pipeline: Any) -> Any:
        dai = self._dai
        imu = pipeline.create(dai.node.IMU)
        imu.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], _IMU_RATE_HZ)
        imu.setBatchReportThreshold(5)
        imu.setMaxBatchReports(20)
        return imu.out.createOutputQueue(maxSize=50, blocking=False)

    def _release(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            with contextlib.suppress(RuntimeError):
                device.close()


def set_exposure(dai: Any, control: Any, settings: Settings) -> None:
    """Manual or automatic exposure, written into a CameraControl."""
    if settings.exposure_us is not None:
        control.setManualExposure(settings.exposure_us, settings.iso)
        return
    control.setAutoExposureEnable()
    control.setAntiBandingMode(getattr(dai.CameraControl.AntiBandingMode, settings.anti_flicker))
    if settings.max_exposure_us is not None:
        control.setAutoExposureLimit(settings.max_exposure_us)


def _stop(pipeline: Any) -> None:
    with contextlib.suppress(RuntimeError):
        pipeline.stop()


ANTI_FLICKER = {"50": "MAINS_50_HZ", "60": "MAINS_60_HZ", "auto": "AUTO", "off": "OFF"}  # of depthai


def open_oak(wanted: str, options: OakOptions) -> OakSource:
    """Open an OAK.

    Args:
        wanted: id or network address, "" for the only one attached.
        options: see there.

    Raises:
        DeviceError: no camera, no permission, ...
    """
    settings = Settings(
        size=options.size,
        rate_hz=options.fps,
        exposure_us=options.exposure,
        iso=options.iso,
        anti_flicker=ANTI_FLICKER[options.anti_flicker],
        max_exposure_us=options.max_exposure,
        imu=options.imu,
        allow_slow=options.allow_slow,
        queue_frames=options.queue,
    )
    patience = Patience(first_image_s=5.0, reconnect_s=options.reconnect)
    return with_rig(OakSource(wanted, settings, patience, f"oak:{wanted}" if wanted else "oak"), options.rig)
