"""Damaged and crafted files: each is read, or one line and exit code 2; never a traceback, a hang or gigabytes.

The commands run in one process whose address space is bounded. What a large search found stays found: the seeds are
fixed. Few cases by default, 2,600 with `-m slow`; FUZZ_SEED=10000 begins with another seed, FUZZ_TIMES=3 takes so many
times as many cases.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from stereo_sfm.calib import save_rig
from stereo_sfm.calib.formats import FORMATS
from stereo_sfm.config import Config, dump
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.service.config import RobotConfig, explain
from stereo_sfm.service.outputs.settings import OutputsConfig, PageConfig, PoseSocketConfig
from stereo_sfm.types import Trajectory
from tests.calib.test_formats import CANNOT, RIGS, target
from tests.drivers import dataset_folders
from tests.drivers.test_mcap import _write as write_foreign
from tests.fuzz import bombs, formats
from tests.fuzz.mutate import damaged, damaged_json, damaged_text
from tests.log.recordings import fisheye_rig, stereo_images, write_recording
from tests.maps.maps import small_map

MOST_SECONDS = 40.0  # of processor time for one file of two gigabytes
MOST_MB = 600  # of the process that reads one file after the other
MOST_LINES = 40  # that one command may say
HANGS_S = 300.0  # of wall clock
FIRST_SEED = int(os.environ.get("FUZZ_SEED", "0"))
TIMES = int(os.environ.get("FUZZ_TIMES", "1"))


def own_recording(path: Path) -> Path:
    """Four frames with everything that a recording can hold."""
    truth = Trajectory(np.arange(4) * 10**9, np.tile(np.eye(4), (4, 1, 1)))
    write_recording(path, MemorySource(fisheye_rig(), stereo_images(4, np.random.default_rng(0)), truth))
    return path


class Child:
    """The process that reads the files."""

    def __init__(self, warm_up: list[str]) -> None:
        command = [sys.executable, "-m", "tests.fuzz.child", json.dumps(warm_up)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def outcome(self, argv: list[str]) -> dict[str, Any]:
        """What became of a command."""
        assert self._process.stdin is not None and self._process.stdout is not None
        watchdog = threading.Timer(HANGS_S, self._process.kill)
        watchdog.start()
        self._process.stdin.write(json.dumps(argv) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        watchdog.cancel()
        assert answer, f"{argv} ended the process or did not end: {self._process.wait()}"
        return json.loads(answer)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def child(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Child]:
    recording = own_recording(tmp_path_factory.mktemp("warm") / "a.mcap")
    process = Child(["frames", str(recording)])
    yield process
    process.close()


def check(child: Child, case: str, argv: list[str]) -> list[str]:
    """What is wrong with the outcome of one case."""
    found = child.outcome(argv)
    wrong: list[str] = []
    if found["trace"]:
        wrong.append(found["trace"][-1500:])
    elif found["code"] not in (0, 1, 2, 3) or (found["code"] == 1 and argv[0] != "diff"):
        wrong.append(f"exit code {found['code']}")
    errors = [line for line in found["message"].splitlines() if not line.startswith("warning: ")]
    if not found["trace"] and (len(errors) != (found["code"] == 2) or len(found["message"].splitlines()) > MOST_LINES):
        wrong.append(f"says {found['message'][:600]!r}")
    if found["seconds"] > MOST_SECONDS:
        wrong.append(f"{found['seconds']:.1f} s")
    if found["peak_mb"] > MOST_MB:
        wrong.append(f"{found['peak_mb']} MB")
    return [f"{case}: {' '.join(argv[:1])}: {text}" for text in wrong]


def search(count: int, case: Callable[[int], tuple[str, list[list[str]]]], child: Child, *found: int) -> None:
    """Every case of every seed, and of those that a wider search found faults with; all are reported together."""
    wrong: list[str] = []
    for seed in dict.fromkeys((*found, *range(FIRST_SEED, FIRST_SEED + TIMES * count))):
        name, commands = case(seed)
        for argv in commands:
            wrong += check(child, f"seed {seed}, {name}", argv)
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


def few_or_many(few: int, many: int) -> Any:
    """The number of cases: few, and in slow tests many."""
    return pytest.mark.parametrize("count", [few, pytest.param(many, marks=pytest.mark.slow)])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Our own recording, one of another program, and both with other compressions."""
    folder = tmp_path_factory.mktemp("recordings")
    own_recording(folder / "own.mcap")
    write_foreign(folder / "foreign.mcap", count=3)
    paths = [folder / "own.mcap", folder / "foreign.mcap"]
    for compression in (CompressionType.LZ4, CompressionType.NONE):
        for path in paths[:2]:
            paths.append(folder / f"{path.stem}_{compression.name}.mcap")
            rewritten(path, paths[-1], lambda data: data, compression)
    return paths


def rewritten(
    source: Path, copy: Path, change: Callable[[bytes], bytes], compression: CompressionType = CompressionType.ZSTD
) -> None:
    """The same recording with its messages and attachments changed, checksums and index as they should be."""
    with source.open("rb") as stream, copy.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out, compression=compression, chunk_size=1 << 16)
        writer.start()
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, change(schema.data))
            if channel.id not in channels:
                to = schemas[channel.schema_id]
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, to)
            writer.add_message(
                channels[channel.id], message.log_time, change(message.data), message.publish_time, message.sequence
            )
        for a in reader.iter_attachments():
            writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, change(a.data))
        for m in reader.iter_metadata():
            writer.add_metadata(m.name, {k: change(v.encode()).decode("latin-1") for k, v in m.metadata.items()})
        writer.finish()


@few_or_many(16, 320)
def test_recordings(count: int, recordings: list[Path], child: Child, tmp_path: Path) -> None:
    def case(seed: int) -> tuple[str, list[list[str]]]:
        rng = random.Random(seed)
        source, path = recordings[seed % len(recordings)], tmp_path / f"{seed}.mcap"
        if rng.random() < 0.5:
            path.write_bytes(damaged(source.read_bytes(), rng))
        else:
            rewritten(source, path, lambda data: damaged(data, rng) if data and rng.random() < 0.2 else data)
        mended = str(tmp_path / f"{seed}_mended.mcap")
        commands = [["info", str(path)], ["frames", str(path)]]
        more = [["recover", str(path), "-o", mended], ["diff", str(path), str(source)]]
        return source.name, [*commands, more[seed % 2]]

    search(count, case, child, 10819, 20669)


@few_or_many(24, 195)
def test_calibrations(count: int, child: Child, tmp_path: Path) -> None:
    kinds = [(name, rig) for name in FORMATS for rig in RIGS if (name, rig) not in CANNOT]

    def case(seed: int) -> tuple[str, list[list[str]]]:
        rng = random.Random(seed)
        name, rig = kinds[seed % len(kinds)]
        folder = tmp_path / str(seed)
        folder.mkdir()
        path = target(folder, name)
        save_rig(RIGS[rig], path, name)
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        victim = rng.choice(files)
        if rng.random() < 0.7:
            victim.write_text(damaged_text(victim.read_text(), rng))
        else:
            victim.write_bytes(damaged(victim.read_bytes(), rng))
        output = str(folder / "out.yaml")
        chosen = ["--from", name] if rng.random() < 0.5 else []
        return f"{name} {rig}", [["convert-calib", str(path), output, "--to", "rig", "--overwrite", *chosen]]

    search(count, case, child, 20576)


@pytest.fixture(scope="module")
def saved_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps") / "map"
    save_map(small_map()[1], folder)
    return folder


@few_or_many(12, 99)
def test_maps(count: int, saved_map: Path, child: Child, tmp_path: Path) -> None:
    def case(seed: int) -> tuple[str, list[list[str]]]:
        rng = random.Random(seed)
        folder = tmp_path / str(seed)
        shutil.copytree(saved_map, folder)
        if seed % 3 == 0:
            victim = rng.choice(sorted(folder.iterdir()))
            victim.write_bytes(damaged(victim.read_bytes(), rng))
            return victim.name, [["map", "info", str(folder)]]
        name, column = bombs.crafted_map(folder, rng)
        outputs = ["-o", str(folder / "new")]
        commands = [["map", "info", str(folder)], ["map", "prune", str(folder), "--min-views", "2", *outputs]]
        return f"{name} {column}", commands

    search(count, case, child)


@few_or_many(16, 74)
def test_configurations(count: int, child: Child, tmp_path: Path) -> None:
    text = dump(Config())

    def case(seed: int) -> tuple[str, list[list[str]]]:
        rng = random.Random(seed)
        path = tmp_path / f"{seed}.toml"
        if rng.random() < 0.8:
            path.write_text(damaged_text(text, rng))
        else:
            path.write_bytes(damaged(text.encode(), rng))
        return "toml", [["config", "dump", "-c", str(path)]]

    search(count, case, child)


@few_or_many(14, 280)
def test_dataset_folders(count: int, child: Child, tmp_path: Path) -> None:
    makers = [getattr(dataset_folders, name) for name in sorted(vars(dataset_folders)) if name.startswith("make_")]

    def case(seed: int) -> tuple[str, list[list[str]]]:
        rng = random.Random(seed)
        folder = makers[seed % len(makers)](tmp_path / str(seed))
        texts = [p for p in sorted(folder.rglob("*")) if p.suffix in (".csv", ".txt", ".yaml") and p.is_file()]
        for victim in rng.sample(texts, min(len(texts), 2)):
            victim.write_text(damaged_text(victim.read_text(), rng))
        return folder.name, [["frames", str(folder)], ["info", str(folder)]]

    search(count, case, child)


@few_or_many(8, 160)
def test_robots(count: int, child: Child, tmp_path: Path) -> None:
    text = explain(RobotConfig(page=PageConfig(True), outputs=OutputsConfig(PoseSocketConfig(True))))

    def case(seed: int) -> tuple[str, list[list[str]]]:
        path = tmp_path / f"{seed}.toml"
        path.write_text(damaged_text(text, random.Random(seed)))
        return "robot.toml", [["serve", "-c", str(path), "--print-ports"]]

    search(count, case, child)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return formats.make_bags(tmp_path_factory.mktemp("bags"))


@few_or_many(20, 300)
def test_bags(count: int, bags: list[Path], child: Child, tmp_path: Path) -> None:
    def case(seed: int) -> tuple[str, list[list[str]]]:
        source, rng = bags[seed % len(bags)], random.Random(seed)
        path, name = formats.damaged_copy(source, tmp_path / str(seed), rng)
        return f"{source.parent.name}, {name}", [["info", str(path)], ["frames", str(path)]]

    search(count, case, child, 10061, 10876, 11451, 20436)


@few_or_many(8, 160)
def test_stores(count: int, child: Child, tmp_path: Path) -> None:
    store = formats.make_store(tmp_path / "store")

    def case(seed: int) -> tuple[str, list[list[str]]]:
        path, name = formats.damaged_copy(store, tmp_path / str(seed), random.Random(seed), "store.yaml", "keepout.*")
        words = [["versions", str(path)], ["label", str(path), "aisle 5", "0,0", "1,1"], ["plan", str(path)]]
        return name, [["map", *some] for some in words]

    search(count, case, child)


@few_or_many(24, 240)
def test_trajectories(count: int, child: Child, tmp_path: Path) -> None:
    paths = formats.make_trajectories(tmp_path)

    def case(seed: int) -> tuple[str, list[list[str]]]:
        path, name = formats.damaged_copy(paths[seed % 3], tmp_path / str(seed), random.Random(seed))
        pair = [str(path), str(paths[seed // 3 % 3])][:: -1 if seed % 2 else 1]
        align = ("se3", "sim3", "origin", "none")[seed % 4]
        return name, [["eval", pair[0], "--ref", pair[1], "--align", align]]

    search(count, case, child, 162, 179, 11305)


@few_or_many(28, 280)
def test_images_and_masks(count: int, child: Child, tmp_path: Path) -> None:
    folders = formats.make_image_folders(tmp_path)

    def case(seed: int) -> tuple[str, list[list[str]]]:
        source = folders[seed % len(folders)]
        wanted = ("mask.png", "rig.yaml") if (source / "mask.png").exists() else ("*/*",)
        path, name = formats.damaged_copy(source, tmp_path / str(seed), random.Random(seed), *wanted)
        return f"{source.name}, {name}", [["frames", str(path)], ["info", str(path)]]

    search(count, case, child, 24)


@few_or_many(8, 160)
def test_recording_folders(count: int, recordings: list[Path], child: Child, tmp_path: Path) -> None:
    root = formats.make_recordings(tmp_path / "recordings", recordings[0])

    def case(seed: int) -> tuple[str, list[list[str]]]:
        path, name = formats.damaged_copy(root, tmp_path / str(seed), random.Random(seed))
        return name, [["recordings", str(path)], ["info", str(next(path.iterdir()))]]

    search(count, case, child)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return formats.make_run(tmp_path_factory.mktemp("runs") / "run")


@few_or_many(8, 160)
def test_runs(count: int, run_folder: Path, child: Child, tmp_path: Path) -> None:
    def case(seed: int) -> tuple[str, list[list[str]]]:
        names = ("*.json", "*.toml", "*.tum", "*.kitti", "rig.yaml")
        path, name = formats.damaged_copy(run_folder, tmp_path / str(seed), random.Random(seed), *names)
        page = ["compare", str(path), str(run_folder), "-o", str(tmp_path / "page")]
        kitti = str(path / "trajectory_odom.kitti")
        more = [["eval", str(path)], ["eval", kitti, "--ref", str(run_folder / "trajectory_odom.tum")], page]
        return name, [["diff", str(path), str(run_folder)], more[seed % 3]]

    search(count, case, child)


@few_or_many(8, 160)
def test_results_of_batches(count: int, run_folder: Path, child: Child, tmp_path: Path) -> None:
    task = {"ok": True, "recording": "a.mcap", "config": dump(Config())}
    stats = json.loads((run_folder / "stats.json").read_text())

    def case(seed: int) -> tuple[str, list[list[str]]]:
        rng, folder = random.Random(seed), tmp_path / str(seed)
        folder.mkdir()
        whole = json.dumps({**task, "stats": stats})
        part = json.dumps({**task, "stats": json.loads(damaged_json(json.dumps(stats), rng))})
        (folder / "result.json").write_text(part if rng.random() < 0.7 else damaged_json(whole, rng))
        return "result.json", [["earlier", str(folder)]]

    search(count, case, child)


@pytest.mark.parametrize("kind", ["recording", "image", "calibration", "map", "configuration", "bag"])
def test_bombs(
    kind: str, recordings: list[Path], saved_map: Path, bags: list[Path], child: Child, tmp_path: Path
) -> None:
    makers = {
        "recording": lambda: bombs.recordings(tmp_path, recordings),
        "image": lambda: bombs.images(tmp_path),
        "calibration": lambda: bombs.calibrations(tmp_path),
        "map": lambda: bombs.maps(tmp_path, saved_map),
        "configuration": lambda: bombs.configurations(tmp_path),
        "bag": lambda: formats.bag_bombs(tmp_path, bags[0]),
    }
    wrong = [fault for name, argv in makers[kind]() for fault in check(child, name, argv)]
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ({"trace": "Traceback ... IndexError"}, "IndexError"),
        ({"code": 2}, "says ''"),
        ({"code": 2, "message": "a\nb\n"}, "says 'a"),
        ({"code": 1}, "exit code 1"),
        ({"seconds": 60.0}, "60.0 s"),
        ({"peak_mb": 700}, "700 MB"),
    ],
)
def test_faults_are_seen(found: dict[str, Any], says: str) -> None:
    class Answers(Child):
        def __init__(self) -> None:
            pass

        def outcome(self, argv: list[str]) -> dict[str, Any]:
            return {"code": 0, "message": "", "trace": "", "seconds": 0.0, "peak_mb": 0, **found}

    faults = check(Answers(), "case", ["info"])
    assert faults and says in faults[0]
