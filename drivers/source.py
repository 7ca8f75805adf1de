"""The source protocol and the table of sources."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self
from urllib.parse import parse_qsl

from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from calib.rig import Rig
    from drivers.rig_option import RigOption
    from stereo_sfm.types import StereoImage, Trajectory


class Source(Protocol):
    """What every driver is."""

    @property
    def name(self) -> str:
        """For people: "sim:loop", "euroc:mh01"."""
        ...

    @property
    def rig(self) -> Rig:
        """Known when the source is open, before the first frame."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """world_T_cam0 where the source has it."""
        ...

    @property
    def frame_count(self) -> int | None:
        """None when unknown (live)."""
        ...

    @property
    def live(self) -> bool:
        """Frames come whether or not somebody takes them."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def __iter__(self) -> Iterator[StereoImage]: ...


# name -> (module, factory). A factory takes what follows the colon and keyword options, and returns a Source.
TABLE: dict[str, tuple[str, str]] = {
    "sim": ("drivers.sim.source", "open_sim"),
    "kitti": ("drivers.kitti", "open_kitti"),
    "kitti_raw": ("drivers.kitti_raw", "open_kitti_raw"),
    "euroc": ("drivers.euroc", "open_euroc"),
    "tum_vi": ("drivers.euroc", "open_tum_vi"),
    "tum_rgbd": ("drivers.tum_rgbd", "open_tum_rgbd"),
    "images": ("drivers.images", "open_images"),
    "kapture": ("drivers.kapture", "open_kapture"),
    "mcap": ("drivers.mcap", "open_mcap"),
    "t265": ("drivers.t265.source", "open_t265"),
    "oak": ("drivers.oak", "open_oak"),
}


DEVICES = ("t265", "oak")  # kinds that are live cameras


def is_device(spec: str) -> bool:
    """Whether a source's name stands for a live camera."""
    return spec.partition(":")[0] in DEVICES


def path_of(spec: str) -> Path:
    """The file or folder that a source's text names, if it names one."""
    kind, colon, rest = spec.partition(":")
    return Path(rest.partition("?")[0] if colon and kind in TABLE else spec).expanduser()


def _factory(name: str) -> Callable[..., Source]:
    module, attribute = TABLE[name]
    return getattr(importlib.import_module(module), attribute)


def open_source(spec: str | Path, rig: RigOption = None, **options: Any) -> Source:
    """Open a source by name.

    Args:
        spec: `sim:loop?camera=pinhole&seed=3`, `t265`, `oak`, a folder (its kind is recognised), an .mcap file, or
            `kind:path` to say the kind.
        rig: calibration instead of the source's own, or a file of one.
        **options: passed to the driver; options in the spec's query come as strings.

    Raises:
        StereoSfmError: unknown name, missing folder, unrecognised folder, or whatever the driver finds wrong.
    """
    if rig is not None:
        options["rig"] = rig
    text = str(spec)
    kind, colon, rest = text.partition(":")
    if kind in TABLE and (colon or text == kind):
        rest, _, query = rest.partition("?")
        return _factory(kind)(rest, **{**dict(parse_qsl(query, keep_blank_values=True)), **options})
    path = Path(text).expanduser()
    if not path.exists():
        looks_like_path = "/" in text or "." in text
        what = f"no such file or folder: {text}" if looks_like_path else f"unknown source '{text}'"
        raise StereoSfmError(f"{what} (sources: {', '.join(TABLE)}, a dataset folder, or an .mcap file)")
    if path.is_file():
        return _factory("mcap")(str(path), **options)
    from drivers.recognise import recognise_folder

    return _factory(recognise_folder(path))(str(path), **options)
