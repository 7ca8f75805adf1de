"""Every command block of the documentation runs, on small files in the place of the reader's, or says what it needs."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.service import config as service_config
from tests.reader_files import file_of

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")),
         *sorted((ROOT / "packaging").rglob("*.md"))]  # fmt: skip
PROGRAMS = (
    "stereo-sfm",
    "python3",
    "pip",
    "source",
    ".venv/bin",
    ".ci",
    "sudo",
    "podman",
    "curl",
    "rosdep",
    "colcon",
    "ros2",
)

# What a line needs that a test does not have; nothing else excuses a line from running.
NEEDS = {
    r"^(\.venv/bin/)?(python3 -m (venv|pip)|pip)": "a network: .ci/run and .ci/try_release install",
    r"^(source|\.venv/bin/(pip|pre-commit|python -m build)|\.ci)": "a network: .ci/run and .ci/try_release install",
    r"^sudo|service status$": "root and systemd",
    "^podman": "podman",
    "^(rosdep|colcon|ros2) |'ros2:": "ROS",
    "^stereo-sfm record (oak|realsense) ": "a camera",
    "webcam:0": "two webcams",
    "sources webcam|webcam:left": "the example installed: tests/drivers/test_plugin.py does both",
    "--target aprilgrid": "pictures of an AprilGrid: tests/calib/test_calibrate.py runs it on EuRoC's",
    "://BUCKET|^stereo-sfm fleet ": "a bucket: tests/fleet has a server of its own",
    "^curl": "a running service: tests/service/test_page.py sends it",
}
SLOW = ("tutorial.md", "tasks/batch.md", "tasks/dense.md", "tasks/saved-maps.md", "tasks/masks.md", "ablation.md",
        "tasks/service.md", "tasks/calibrate.md")  # fmt: skip
# What a page calls its reader's files -> ours; X,Y are metres on a floor plan.
OURS = {
    "SOURCE": "session.mcap", "SESSION...": "wednesday.mcap", "RUN": "runs/a", "DIR": "runs/a", "MAP": "store",
    "STORE": "store", "A": "store", "B": "store3", "FORMAT": "tum", "OUT": "exported", "t265": "t265:simulated",
}  # fmt: skip
SHORTER = {
    "run": "--inline -q",
    "check-calib": "--max-frames 30",
    "rectify": "--frames 3",
    "ablation": "--frames 5 --features orb --odometry um --stages tracking --systems none",
}
EXITS = {"check-calib": (0, 3), "diff": (0, 3)}  # a finding, runs that differ
FEW = 12  # images that a page that is not slow runs on: too few for a map, exit code 4


def command_lines(page: Path) -> list[str]:
    """Lines of a page's blocks that a reader would type, without what is said beside them."""
    text = re.sub(r"```bash\n(.*?)```", lambda m: re.sub("(?m)^", "    ", m[1]), page.read_text(), flags=re.S)
    text = re.sub(r"```.*?```", "", text, flags=re.S)
    lines = [re.split(r"\s{2,}|\s#\s", line.strip())[0] for line in re.findall(r"(?m)^    .*", text)]
    return [line for line in lines if line.startswith(PROGRAMS)]


def need_of(line: str) -> str:
    return next((need for pattern, need in NEEDS.items() if re.search(pattern, line)), "")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT / "docs" if ROOT / "docs" in page.parents else ROOT).as_posix()


WITH_COMMANDS = {name_of(page): lines for page in PAGES if (lines := command_lines(page))}
RUN = {name: lines for name, lines in WITH_COMMANDS.items() if not all(map(need_of, lines))}


@pytest.fixture
def shop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which a page's commands run, one after the other."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


# -- the commands ------------------------------------------------------------------------------------------------------


def source_of(line: str) -> str:
    """What stands in the place of SOURCE: a target's images for `calibrate`, else a recording."""
    if "--imu" in line:
        return "sim:loop?size=424x400&rate=15&frames=450&imu=t265&wheel=differential&wheel_grade=ideal"
    return "boards" if "--target" in line else OURS["SOURCE"]


def words_of(line: str) -> list[str]:
    """The words after `stereo-sfm`, with our files, and short."""
    words = [source_of(line) if word == "SOURCE" else OURS.get(word, word) for word in shlex.split(line)[1:]]
    words = [f"{k},0" if word == "X,Y" else word for k, word in enumerate(words)]
    if words[0] == "record":
        words = [re.sub(r"seed=3$", "seed=3&frames=150", word) for word in words]
        return [*words, "--frames", "5"] if "t265:simulated" in words else words
    return words + shlex.split(SHORTER.get(words[0], ""))


def call(line: str, shop: Path, few: bool) -> None:
    words = words_of(line)
    if few and words[0] == "run":
        words += ["--max-frames", str(FEW)]
    written = {value for option, value in itertools.pairwise(words) if option in ("-o", "--correct", "--map-out")}
    for word in words:
        if word not in written:
            file_of(shop, word)
        elif (shop / word).is_dir():  # an example beside this one wrote it
            shutil.rmtree(shop / word)
        else:
            (shop / word).unlink(missing_ok=True)
    if words[0] == "serve":
        serve(words, shop)
    else:
        assert main(words) in EXITS.get(words[0], (0, 4) if few and words[0] == "run" else (0,)), line


def serve(words: list[str], shop: Path) -> None:
    """It prints the link of its page, and ends when it is asked to."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "stereo_sfm.cli", *words, "--set", f"page.port={port}"]
    with subprocess.Popen(command, cwd=shop, env=os.environ | {"PYTHONPATH": str(ROOT)}, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as service:  # fmt: skip
        assert service.stdout is not None
        said: list[str] = []
        for text in service.stdout:
            said.append(text)
            if "http://" in text:
                service.send_signal(signal.SIGTERM)
        assert service.wait() == 0 and any("http://" in text for text in said), said


PAGES_THAT_RUN = [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in RUN]


@pytest.mark.parametrize("name", PAGES_THAT_RUN)
def test_the_commands_of_a_page_run(name: str, shop: Path) -> None:
    for line in RUN[name]:
        if not need_of(line):
            call(line, shop, name not in SLOW)


def test_only_hardware_networks_and_other_programs_are_needed() -> None:
    """Each excuse is used, and no page is excused as a whole but those about installing, ROS and ports."""
    lines = [line for page in WITH_COMMANDS.values() for line in page]
    assert all(any(re.search(pattern, line) for line in lines) for pattern in NEEDS)
    assert set(WITH_COMMANDS) - set(RUN) == {"README.md", "CONTRIBUTING.md", "packaging/ros2/README.md", "drivers.md",
                                               "tasks/fleet.md", "tasks/service-outputs.md"}  # fmt: skip


def test_the_service_takes_every_block_of_settings(shop: Path) -> None:
    """The sections that its two pages show."""
    pages = [(ROOT / "docs" / "tasks" / name).read_text() for name in ("service.md", "service-outputs.md")]
    blocks = [block for page in pages for block in re.findall(r"```toml\n(.*?)```", page, re.S)]
    assert len(blocks) > 5
    for block in blocks:
        (shop / "robot.toml").write_text(block)
        service_config.load(shop / "robot.toml")


@pytest.mark.slow
def test_the_service_of_the_python_page_runs(shop: Path) -> None:
    """Until its recording ends."""
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "tasks" / "service.md").read_text(), re.S)
    assert code is not None
    (shop / "robot.toml").write_text('[source]\nspec = "sim:loop?size=212x200&frames=30"\n[map]\nfolder = "store"\n')
    exec(compile(code[1], "service.md", "exec"), {})
    assert (shop / "store" / "map.json").is_file()
