"""Whole files and folders of each format, to be copied and damaged."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zstandard
from rosbags import rosbag2

from stereo_sfm.calib.mask import encode_mask, mask_to_text
from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from stereo_sfm.export.trajectories import write_euroc, write_kitti, write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.recording.segments import Segment, new_recording
from stereo_sfm.types import Trajectory
from tests.drivers.dataset_folders import RIG, make_images
from tests.drivers.ros_bags import KINDS, compressed_bag, write_bag
from tests.fuzz.bombs import zstd_zeros
from tests.fuzz.mutate import damaged, damaged_json, damaged_text
from tests.maps.maps import small_map

TEXTS = (".csv", ".tum", ".kitti", ".toml", ".txt", ".yaml")
JSON = ".json"


def damage(path: Path, rng: random.Random) -> None:
    """Damage a file as its kind can be damaged, sometimes as any file can."""
    if path.suffix == JSON and rng.random() < 0.7:
        path.write_text(damaged_json(path.read_text(), rng))
    elif path.suffix in (*TEXTS, JSON) and rng.random() < 0.7:
        path.write_text(damaged_text(path.read_text(), rng))
    elif path.suffix == ".db3" and rng.random() < 0.7:
        _damage_rows(path, rng)
    else:
        path.write_bytes(damaged(path.read_bytes(), rng))


def damaged_copy(source: Path, folder: Path, rng: random.Random, *names: str) -> tuple[Path, str]:
    """A copy of a file or a folder with one file damaged, whose name is given, too.

    `names`: patterns of those that may be damaged.
    """
    folder.mkdir()
    copy = folder / source.name
    if source.is_file():
        shutil.copy(source, copy)
        victims = [copy]
    else:
        shutil.copytree(source, copy)
        victims = sorted(p for name in names or ("**/*",) for p in copy.glob(name) if p.is_file())
    victim = rng.choice(victims)
    damage(victim, rng)
    return copy, victim.name


def _damage_rows(path: Path, rng: random.Random) -> None:
    """Other values in a column of a table."""
    values: list[Any] = [
        None,
        "",
        "x",
        -1,
        0,
        1.5,
        1 << 62,
        -(1 << 63),
        b"",
        b"\x00\x01\x00\x00",
        "[" * 5000,
        "- {a: *b}",
    ]
    with closing(sqlite3.connect(path)) as base:
        rows = base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall()
        table = rng.choice(sorted(name for name, _ in rows))
        column = rng.choice([row[1] for row in base.execute(f"PRAGMA table_info({table})")])
        value = rng.choice(values)
        base.execute("PRAGMA ignore_check_constraints = 1")
        where = "" if rng.random() < 0.3 else " WHERE rowid = 1 + abs(random()) % 5"
        try:
            base.execute(f"UPDATE OR REPLACE {table} SET {column} = ?{where}", (value,))
        except sqlite3.Error:  # the column takes no such value
            base.execute(f"DELETE FROM {table}")
        base.commit()


def make_bags(folder: Path) -> list[Path]:
    """A bag of each kind, and those whose messages, chunks and files are compressed."""
    paths: list[Path] = []
    with open_source("sim:loop?size=80x64&frames=4&start=40&imu=t265") as source:
        images = list(source)
        for number, kind in enumerate(KINDS):
            (folder / str(number)).mkdir()
            paths.append(write_bag(folder / str(number), kind, source.rig, images))
    packed = shutil.copytree(paths[0], folder / "packed")
    pack_messages(packed, lambda data: zstandard.compress(data))
    modes = rosbag2.CompressionMode
    chunks = compressed_bag(paths[2], modes.STORAGE, rosbag2.StoragePlugin.MCAP)
    files = compressed_bag(paths[0], modes.FILE, rosbag2.StoragePlugin.SQLITE3)
    return [*paths, packed, chunks, files]


def pack_messages(bag: Path, pack: Callable[[bytes], bytes]) -> None:
    """Compress each message of a folder with a .db3."""
    about = bag / "metadata.yaml"
    text = about.read_text().replace("compression_format: ''", "compression_format: zstd")
    about.write_text(text.replace("compression_mode: ''", "compression_mode: message"))
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as base:
        for row, data in base.execute("SELECT id, data FROM messages").fetchall():
            base.execute("UPDATE messages SET data = ? WHERE id = ?", (pack(data), row))
        base.commit()


def make_store(folder: Path) -> Path:
    """A store with labels, a floor plan and a drawing of zones."""
    save_map(small_map()[1], folder)
    for words in (
        ["label", str(folder), "aisle 4", "1,1", "3,1"],
        ["label", str(folder), "stockroom", "1,1", "3,1", "--door"],
    ):
        assert main(["map", *words]) == 0
    assert main(["map", "plan", str(folder)]) == 0
    return folder


def make_trajectories(folder: Path) -> list[Path]:
    """The same path in the three formats."""
    rng = np.random.default_rng(0)
    steps = np.concatenate([rng.normal(0, 0.1, (20, 3)), rng.normal(0, 0.02, (20, 3))], axis=1)
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ se3.exp(step))
    path = Trajectory(1_403_636_579_763_555_584 + 50_000_000 * np.arange(len(poses)), np.array(poses))
    write_tum(folder / "path.tum", path)
    write_euroc(folder / "path.csv", path)
    write_kitti(folder / "path.kitti", path.poses)
    return [folder / name for name in ("path.tum", "path.csv", "path.kitti")]


def make_image_folders(folder: Path) -> list[Path]:
    """Images of each kind of file; with masks in files and in the calibration itself."""
    folders: list[Path] = []
    for suffix in (".png", ".jpg", ".pgm", ".tif", ".bmp"):
        folders.append(make_images(folder / suffix[1:], [f"{i}{suffix}" for i in range(3)]))
    mask = np.ones((48, 64), bool)
    mask[40:] = False
    for name, text in (("masked", "mask.png"), ("inline", mask_to_text(mask))):
        folders.append(make_images(folder / name, ["0.png", "1.png"]))
        (folders[-1] / "mask.png").write_bytes(encode_mask(mask))
        (folders[-1] / "rig.yaml").write_text(RIG.replace("distortion: []}", f'distortion: [], mask: "{text}"}}'))
    deep = np.full((48, 64), 1000, np.uint16)
    cv2.imwrite(str(folders[0] / "left" / "0.png"), deep)
    return folders


def make_recordings(root: Path, recording: Path) -> Path:
    """The root of a service's recordings, with one of two segments, of which one is marked and sent."""
    folder = new_recording(root, "sim:loop", "map", datetime(2026, 11, 22, 15, 14))
    for number in range(2):
        segment = Segment.of(folder, number, 10 * number)
        shutil.copy(recording, segment.images)
        shutil.copy(recording, segment.poses)
    (folder / "00000_000000.marked").write_text("lost: no pose\nthe door\n")
    (folder / "SHA256SUMS").write_text(f"{'0' * 64}  00000_000000.mcap\n# complete\n")
    return root


def make_run(folder: Path) -> Path:
    """The folder of a short run with ground truth."""
    words = ["run", "sim:loop?size=160x120&frames=10&start=40", "--inline", "-q", "-o", str(folder)]
    assert main(words) == 0
    return folder


def bag_bombs(folder: Path, bag: Path) -> list[tuple[str, list[str]]]:
    """Bags that nest, that contain themselves, and that expand to gigabytes."""
    merged = "x: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 15))
    texts = {
        "brackets": "[" * 100_000,
        "braces": "{a: " * 100_000,
        "merged": "a0: &a0 {" + merged,
        "itself": "a: &a {<<: *a}",
        "aliases": "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 15)),
        "long": "a: " + "x" * (8 << 20),
    }
    cases: list[tuple[str, list[str]]] = []
    for name, text in texts.items():
        for place in ("metadata", "qualities", "table"):
            copy = shutil.copytree(bag, folder / f"{name}_{place}")
            if place == "metadata":
                (copy / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  version: 9\n{text}")
            elif place == "qualities":
                _with_qualities(copy / "metadata.yaml", text)
            else:
                with closing(sqlite3.connect(next(copy.glob("*.db3")))) as base:
                    base.execute("UPDATE topics SET offered_qos_profiles = ?", (text,))
                    base.commit()
            cases.append((f"{name} in {place}", ["info", str(copy)]))
    copy = shutil.copytree(bag, folder / "zeros")
    zeros = zstd_zeros(2 << 30)
    pack_messages(copy, lambda data: zeros if len(data) > 4000 else zstandard.compress(data))
    return [*cases, ("messages of 2 GiB", ["frames", str(copy)])]


def _with_qualities(about: Path, text: str) -> None:
    import json

    old, new = "offered_qos_profiles: []", f"offered_qos_profiles: {json.dumps(text)}"
    about.write_text(about.read_text().replace(old, new))
