"""Which kind of dataset a folder is, by what lies in it."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.errors import StereoSfmError


def _is_kitti(folder: Path) -> bool:
    if any((folder / p).is_dir() for p in ("sequences", "dataset/sequences")):
        return True
    sequences = (folder, *sorted(folder.glob("[0-9][0-9]")))
    return any((s / "calib.txt").is_file() and (s / f"image_{i}").is_dir() for s in sequences for i in (0, 2))


def _is_kitti_raw(folder: Path) -> bool:
    drives = (folder, *sorted(folder.glob("*_drive_*")))
    return any((drive / f"image_0{i}" / "data").is_dir() for drive in drives for i in (0, 2))


def _is_tum_vi(folder: Path) -> bool:
    return any((folder / p).is_file() for p in ("camchain.yaml", "dso/camchain.yaml")) and (folder / "mav0").is_dir()


def _is_euroc(folder: Path) -> bool:
    return any((folder / p).is_dir() for p in ("mav0/cam0", "cam0/data"))


def _is_tum_rgbd(folder: Path) -> bool:
    return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()


def _is_kapture(folder: Path) -> bool:
    return any((folder / p).is_file() for p in ("kapture_sensors.txt", "sensors/sensors.txt"))


def _is_images(folder: Path) -> bool:
    from drivers.images import find_pair

    return find_pair(folder) is not None


# kind as in drivers.source.TABLE -> test, the most telling first
KINDS = {
    "kitti": _is_kitti,
    "kitti_raw": _is_kitti_raw,
    "tum_vi": _is_tum_vi,
    "euroc": _is_euroc,
    "tum_rgbd": _is_tum_rgbd,
    "kapture": _is_kapture,
    "images": _is_images,
}


def recognise_folder(folder: Path) -> str:
    """The kind of a dataset folder, a key of `drivers.source.TABLE`.

    Raises:
        StereoSfmError: nothing known lies there.
    """
    for kind, test in KINDS.items():
        if test(folder):
            return kind
    raise StereoSfmError(
        f"{folder} is no dataset that is known here: expected KITTI (sequences/NN), KITTI raw (image_00/data), "
        "EuRoC or TUM VI (mav0/), TUM RGB-D (rgb.txt, depth.txt), kapture, or two image folders (left/, right/) "
        "with a rig file"
    )
