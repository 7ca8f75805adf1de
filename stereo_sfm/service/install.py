"""What `stereo-sfm service install` puts on a robot: systemd unit, user, udev rules, folders, a first robot.toml."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.drivers.devices import UDEV_FILE, udev_rules
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.config import RobotConfig, explain

UNIT_FILE = "/etc/systemd/system/stereo-sfm.service"
CONFIG_FILE = "/etc/stereo-sfm/robot.toml"
STATE = "/var/lib/stereo-sfm"
USER = "stereo-sfm"
UNIT_NAME = "stereo-sfm.service"

_UNIT = """[Unit]
Description=stereo-sfm: where the robot is, and the map of its store
After=local-fs.target network.target time-sync.target
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={program} serve -c {config}
WorkingDirectory={state}
Restart=always
RestartSec=1
WatchdogSec=10
TimeoutStartSec=10min
TimeoutStopSec=10
KillMode=mixed
User={user}
SupplementaryGroups=plugdev video
StateDirectory=stereo-sfm
CacheDirectory=stereo-sfm
RuntimeDirectory=stereo-sfm
UMask=0027
Environment=HOME={state} NUMBA_CACHE_DIR=/var/cache/stereo-sfm MPLCONFIGDIR=/var/cache/stereo-sfm
LimitNOFILE=4096
OOMPolicy=continue
LimitNICE=-5
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictSUIDSGID=yes
LockPersonality=yes
{writable}
[Install]
WantedBy=multi-user.target
"""


@dataclass(frozen=True)
class Place:
    """Where and for whom the service is installed.

    Attributes:
        program: the `stereo-sfm` to run. user: it runs as. config: its robot.toml; made when there is none.
        root: folder used instead of "/", for a preview or to build an image.
    """

    program: Path
    user: str = USER
    config: Path = Path(CONFIG_FILE)
    root: Path = Path("/")

    def at(self, path: str | Path) -> Path:
        """A path below the root."""
        return self.root / str(path).lstrip("/")


def this_program() -> Path:
    """The `stereo-sfm` that runs now.

    Raises:
        StereoSfmError: it is not installed as a program.
    """
    for found in (Path(sys.executable).with_name("stereo-sfm"), shutil.which("stereo-sfm")):
        if found is not None and Path(found).exists():
            return Path(found).absolute()
    raise StereoSfmError("there is no program stereo-sfm beside this Python: pip install stereo-sfm")


def unit(place: Place, writable: tuple[Path, ...] = ()) -> str:
    """The text of the systemd unit; `writable` folders outside its state folder may be written to."""
    lines = "".join(f"ReadWritePaths={path}\n" for path in writable)
    return _UNIT.format(program=place.program, config=place.config, user=place.user, state=STATE, writable=lines)


def robot_toml() -> str:
    """A first robot.toml: every setting with its description, folders in the state folder."""
    text = explain(RobotConfig())
    return text.replace('folder = "store"', f'folder = "{STATE}/store"').replace(
        'folder = "recordings"', f'folder = "{STATE}/recordings"'
    )


def files(place: Place, writable: tuple[Path, ...] = ()) -> Iterator[tuple[Path, str]]:
    """Every file that is installed, with its text; robot.toml only where there is none."""
    yield place.at(UNIT_FILE), unit(place, writable)
    yield place.at(UDEV_FILE), udev_rules()
    if not place.at(place.config).exists():
        yield place.at(place.config), robot_toml()


def commands(place: Place) -> list[list[str]]:
    """What is run after the files are there; nothing where another folder stands for "/"."""
    if place.root != Path("/"):
        return []
    return [
        ["useradd", "--system", "--home-dir", STATE, "--shell", "/usr/sbin/nologin", place.user],
        ["groupadd", "--system", "--force", "plugdev"],
        ["install", "-d", "-o", place.user, "-g", place.user, STATE],
        ["udevadm", "control", "--reload-rules"],
        ["udevadm", "trigger"],
        ["systemctl", "daemon-reload"],
        ["systemctl", "enable", UNIT_NAME],
    ]


def install(place: Place, writable: tuple[Path, ...] = ()) -> list[Path]:
    """Write the files and run the commands; the service is enabled, not started.

    Raises:
        StereoSfmError: no root rights, no systemd, a program that the service's user cannot reach, or a command failed.
    """
    todo = list(files(place, writable))
    _check_rights(place)
    if place.root == Path("/"):
        for program in (place.program, Path(sys.executable).resolve()):
            check_reach(program, place.user)
    for path, text in todo:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    place.at(STATE).mkdir(parents=True, exist_ok=True)
    for command in commands(place):
        _call(command, {9} if command[0] == "useradd" else set())  # 9: the user exists already
    return [path for path, _ in todo]


def check_reach(program: Path, user: str) -> None:
    """Raises StereoSfmError where another user may not enter a folder of a program, as those of home folders."""
    try:
        known = pwd.getpwnam(user)
    except KeyError:  # it is made later, and owns nothing
        uid, groups = -1, list[int]()
    else:
        uid, groups = known.pw_uid, os.getgrouplist(user, known.pw_gid)

    def enters(folder: Path) -> bool:
        about = folder.stat()
        bit = 0o100 if about.st_uid == uid else 0o010 if about.st_gid in groups else 0o001
        return uid == 0 or bool(about.st_mode & bit)

    closed = next((folder for folder in reversed(program.parents) if not enters(folder)), None)
    if closed is not None:
        raise StereoSfmError(f"the user {user} may not enter {closed}: install stereo-sfm elsewhere, such as in /opt")


def uninstall(place: Place) -> list[Path]:
    """Stop the service and remove its unit and udev rules; maps, recordings and robot.toml stay.

    Raises:
        StereoSfmError: no root rights.
    """
    _check_rights(place)
    if place.root == Path("/"):
        _call(["systemctl", "disable", "--now", UNIT_NAME], {1, 5})  # it was not installed
    removed = [path for path in (place.at(UNIT_FILE), place.at(UDEV_FILE)) if path.exists()]
    for path in removed:
        path.unlink()
    if place.root == Path("/"):
        _call(["systemctl", "daemon-reload"], set())
    return removed


def status() -> str:
    """State of the installed service in a line or two.

    Raises:
        StereoSfmError: there is no systemd, or the service is not installed.
    """
    if not Path(UNIT_FILE).exists():
        raise StereoSfmError("the service is not installed: 'stereo-sfm service install'")
    shown = _call(["systemctl", "show", UNIT_NAME, "-p", "ActiveState,SubState,StatusText,NRestarts,MainPID"], set())
    values = {name: value for name, _, value in (line.partition("=") for line in shown.splitlines())}
    text = f": {values['StatusText']}" if values.get("StatusText") else ""
    return (
        f"{values.get('ActiveState')} ({values.get('SubState')}){text}\n"
        f"process {values.get('MainPID')}, started again {values.get('NRestarts')} times; "
        f"journalctl -u {UNIT_NAME} shows its log"
    )


def _check_rights(place: Place) -> None:
    if place.root == Path("/") and os.geteuid() != 0:
        raise StereoSfmError("this writes to /etc: run it with sudo, or preview it with --dry-run")
    if place.root == Path("/") and shutil.which("systemctl") is None:
        raise StereoSfmError("there is no systemd here: run 'stereo-sfm serve' in another way, such as a container")


def _call(command: list[str], allowed: set[int]) -> str:
    """The output of a command.

    Raises:
        StereoSfmError: it is missing or failed.
    """
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise StereoSfmError(f"{' '.join(command)}: {error}") from None
    if done.returncode not in {0, *allowed}:
        raise StereoSfmError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")
    return done.stdout
