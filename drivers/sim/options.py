"""Options of `sim:SCENE?...`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from stereo_sfm.drivers.options import SourceOptions, option


def _size(value: Any) -> tuple[int, int] | None:
    """WIDTHxHEIGHT; "" and None: the camera's own."""
    if not value:
        return None
    width, _, height = value.partition("x") if isinstance(value, str) else (str(value[0]), "", str(value[1]))
    if not (width.isdigit() and height.isdigit() and 32 <= int(width) <= 4096 and 32 <= int(height) <= 4096):
        raise ValueError("WIDTHxHEIGHT, such as 424x400")
    return int(width), int(height)


def _interval(value: Any) -> tuple[float, float]:
    """Seconds of FROM-TO; (0, 0) if empty."""
    if not value:
        return 0.0, 0.0
    begin, _, end = value.partition("-") if isinstance(value, str) else (value[0], "", value[1])
    try:
        low, high = float(begin), float(end)
    except ValueError:
        low, high = 0.0, 0.0
    if not 0 <= low < high:
        raise ValueError("FROM-TO in seconds, such as 10-11.5")
    return low, high


@dataclass(frozen=True)
class SimOptions(SourceOptions):
    """Options of `sim:SCENE`."""

    GROUPS = {  # noqa: RUF012
        "store": (
            "seed", "walk", "exchange", "nights", "fill", "gaps", "setback", "round", "hanging", "glossy", "clear",
            "glass", "bare", "polish", "carts", "people", "encounters", "flicker", "dark",
        ),
        "drive": (
            "length", "path", "returns", "speed", "corner", "spot_turns", "thresholds", "ramps", "pushed", "rest",
            "vibration", "robot",
        ),
        "camera": (
            "camera", "size", "rate", "noise", "blur", "shutter", "rays", "dirt", "jpeg", "residual", "decentered",
            "tilted", "rows", "right_exposure", "right_blur", "stamp_jitter_ms", "stamped", "readout", "drop",
            "effects",
        ),
        "IMU and wheels": (
            "imu", "imu_offset_ms", "wheel", "wheel_grade", "wheel_slip", "wheel_offset_ms",
        ),
    }  # fmt: skip

    camera: Literal["fisheye", "pinhole", "distorted"] = option("fisheye", "lenses of the simulated pair")
    size: tuple[int, int] | None = option(None, "WIDTHxHEIGHT, scales the images", read=_size)
    seed: int = option(0, "seed of products, sensor noise and people", low=0, high=2**31)
    walk: int = option(0, "another session through the same store", low=0, high=1000)
    length: float = option(0.0, "metres driven, 0: the scene's own", low=0, high=100_000)
    start: int = option(0, "first frame", low=0, high=10**7)
    frames: int = option(0, "number of frames at most, 0: all", low=0, high=10**7)
    rate: float = option(30.0, "frames a second", low=1, high=1000)
    path: str = option("", "trajectory file to drive along; the market is built around it", file=True)
    exchange: float = option(0.0, "fraction of product rows with another product than at 0", low=0, high=1)
    nights: int = option(0, "number of nights that each exchange that fraction of the rows", low=0, high=1000)
    returns: bool = option(True, "whether the camera returns to earlier places")
    fill: float = option(-1, "fraction of product rows that are present, -1: the scene's own; so below", low=-1, high=1)
    gaps: float = option(-1, "fraction of the facings that are sold out", low=-1, high=1)
    setback: float = option(-1, "metres, largest setback of a product row", low=-1, high=1)
    round: float = option(-1, "share of the products that are cans and bottles", low=-1, high=1)
    hanging: float = option(-1, "share that hangs from hooks", low=-1, high=1)
    glossy: float = option(-1, "share that is varnished or of foil", low=-1, high=1)
    clear: float = option(-1, "share of the round ones that is transparent", low=-1, high=1)
    glass: float = option(-1, "share of the shelves' length behind glass doors", low=-1, high=1)
    bare: float = option(-1, "share of the shelves' length that is a white wall", low=-1, high=0.9)
    polish: float = option(-1, "of the floor, which mirrors lamps and shelves", low=-1, high=1)
    carts: int = option(-1, "shopping carts in the aisles; none in sim:market", low=-1, high=200)
    people: int = option(-1, "how many, -1: the scene's own", low=-1, high=60)
    encounters: str = option(
        "", "encounters of people with the robot, in turn: approach, stop, cover, lens, cart, beside, group; all"
    )
    speed: float = option(0.0, "metres a second, 0: the scene's own", low=0, high=5)
    corner: float = option(0.0, "seconds over which a corner is rounded, 0: the scene's own", low=0, high=5)
    spot_turns: bool = option(False, "the robot stops at corners and turns on the spot")
    thresholds: int = option(0, "number of low edges across the path, which the robot drives over", low=0, high=1000)
    ramps: int = option(0, "number of ramps, up and down again; the drawn floor stays flat", low=0, high=100)
    pushed: tuple[float, float] = option(
        (0.0, 0.0), "FROM-TO in seconds: interval in which the robot is pushed by hand", read=_interval
    )
    rest: float = option(0.0, "seconds at rest before the drive, 0: the scene's own", low=0, high=10_000)
    vibration: float = option(1.0, "scales the camera's vibration", low=0, high=10)
    drop: float = option(0.0, "fraction of frames lost", low=0, high=0.9)
    noise: float = option(1.0, "scales the sensor's noise", low=0, high=20)
    blur: float = option(1.0, "scales the exposure time", low=0, high=10)
    shutter: int = option(
        0, "images rendered during an exposure, whose mean is exact motion blur; 0: pixels blur along their motion",
        low=0, high=64,
    )  # fmt: skip
    rays: int = option(
        1, "of a pixel, squared: 1 places content to 0.06 px, 4 to 0.02 px in nine times the time", low=1, high=8
    )
    robot: bool = option(False, "the robot's own edge and a hand rail are in view")
    dirt: float = option(0.0, "spots on the lenses", low=0, high=1)
    flicker: float = option(0.0, "swing of the lamps' brightness, 100 times a second", low=0, high=1)
    jpeg: int = option(0, "quality of a lossy link, 0: none", low=0, high=100)
    residual: float = option(0.0, "px rms of distortion that no term of the calibration describes", low=0, high=10)
    decentered: float = option(
        0.0, "px rms by which lenses are decentered, of which the calibration does not know", low=0, high=10
    )
    tilted: float = option(0.0, "px rms of lenses or sensors that are tilted, the same", low=0, high=10)
    rows: float = option(
        0.0, "px rms by which rows of the right image are off, differently over the image", low=0, high=10
    )
    right_exposure: float = option(1.0, "brightness of the right image over that of the left", low=0.05, high=20)
    right_blur: float = option(0.0, "px, standard deviation: the right lens is out of focus", low=0, high=20)
    stamp_jitter_ms: float = option(0.0, "random errors of the images' stamps, standard deviation", low=0, high=1000)
    stamped: float = option(
        0.0, "images a second by their stamps, 0: the rate; wrong as where a folder has no stamps", low=0, high=1000
    )
    readout: float = option(
        0.0, "rolling shutter: seconds from the exposure of the first row to that of the last", low=-0.1, high=0.1
    )
    dark: tuple[float, float] = option((0.0, 0.0), "FROM-TO in seconds: interval with the lights off", read=_interval)
    imu: Literal["", "ideal", "t265", "oak", "bno086"] = option(
        "", "inertial samples of an ideal sensor, a T265 (BMI055), an OAK with a BMI270 or one with a BNO086"
    )
    imu_offset_ms: float = option(
        0.0, "clock of the inertial sensor minus the camera's; part of the calibration", low=-1000, high=1000
    )
    wheel: Literal["", "differential", "skid_steer", "mecanum", "twist"] = option("", "wheel odometry of a robot")
    wheel_grade: Literal["robot", "ideal"] = option("robot", "wheels with wrong radii, noise and ticks, or without")
    wheel_slip: float = option(0.0, "share by which wheels turn too far in turns and on thresholds", low=0, high=2)
    wheel_offset_ms: float = option(
        0.0, "clock of the wheels minus the camera's; part of the calibration", low=-1000, high=1000
    )
    effects: bool = option(True, "off: images without blur, noise and vignetting")
    realtime: bool = option(False, "deliver frames in real time")
