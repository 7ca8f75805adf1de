"""A whole service whose recordings go to a bucket: offline until its quota is full, then online; nothing is lost."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.fleet.plan import find_walks, load_plan
from stereo_sfm.recording.quota import used_bytes
from stereo_sfm.recording.segments import recordings, segments
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUMS, read_sums
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import Server

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PATIENCE_S = 600.0  # of a busy computer
QUOTA_GB = 0.01  # the least
SOURCE = "sim:aisle?size=212x200&rate=15"


def wait_for(what: Callable[[], object], service: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert service.poll() is None and time.monotonic() < end
        time.sleep(0.2)


def test_recordings_arrive_whole_after_a_night_offline(place: str, s3: Server, tmp_path: Path) -> None:
    target, folder = Remote.of(place) / "a" / "walks" / "r1", tmp_path / "recordings"
    settings = [
        "source.repeat=true", "map.mode='none'", "recording.mode='full'", "recording.image_format='raw'",
        f"recording.folder='{folder}'", "recording.segment_min=0.02", f"recording.quota_gb={QUOTA_GB}",
        "recording.min_free_gb=0", "recording.quota_percent=100", f"recording.upload='{target}'",
        "recording.mark_losses=false", "watchdog.silent_s=60",
    ]  # fmt: skip
    command = [sys.executable, "-m", "stereo_sfm.cli", "serve", SOURCE, "-v"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    s3.faults(1.0)
    with (tmp_path / "log").open("wb") as log:
        service = subprocess.Popen(
            [*command, *(part for setting in settings for part in ("--set", setting))], env=environment, stderr=log
        )
        try:
            wait_for(lambda: folder.is_dir() and used_bytes(folder) > 1e9 * QUOTA_GB, service)
            recording = recordings(folder)[-1]
            first = segments(recording)[0]
            seconds = len(segments(recording))
            wait_for(lambda: len(segments(recording)) >= seconds + 2, service)  # poses are recorded, nothing deleted
            assert first.images.is_file() and used_bytes(folder) > 1e9 * QUOTA_GB
            s3.faults(0.0)
            wait_for(lambda: not first.poses.exists() and used_bytes(folder) < 1e9 * QUOTA_GB, service)
            newest = segments(recording)[-1]
            wait_for(
                lambda: segments(recording)[-1] != newest and not newest.unsent() and newest.images.is_file(), service
            )
            service.send_signal(signal.SIGTERM)
            assert service.wait(PATIENCE_S) == 0
        finally:
            service.kill()
            service.wait()
    assert main(["fleet", "upload", str(folder), str(target)]) == 0  # what was being written when it stopped
    sent = {name: size for name, size, _ in objects.listed(target / recording.name)}
    last = segments(recording)[-1]
    numbers = sorted(int(name[:5]) for name in sent if name.endswith(".mcap") and ".images." not in name)
    assert numbers == list(range(int(last.name[:5]) + 1))
    sums = read_sums(objects.read(target / recording.name / SUMS).decode())
    assert sums.keys() == {name for name in sent if name.endswith((".mcap", ".marked"))}
    for name, digest in sums.items():
        assert hashlib.sha256(objects.read(target / recording.name / name)).hexdigest() == digest
    plan = tmp_path / "plan.toml"
    plan.write_text(f'[fleet]\nroot = "{place}"\n')
    walks, waiting = find_walks(load_plan(plan))
    assert [walk.name for walk in walks] == [f"r1/{recording.name}"] and not waiting
