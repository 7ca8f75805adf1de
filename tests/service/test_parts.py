"""The parts of the service that need no processes: state, poses, map cloud, camera, notifications."""

from __future__ import annotations

import dataclasses
import os
import shutil
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import MadeSource, SourceChoice
from stereo_sfm.drivers.repeated import RepeatedSource
from stereo_sfm.geometry import se3
from stereo_sfm.log.provenance import Opening
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Compiling, Localized
from stereo_sfm.pipeline.channels import Failed
from stereo_sfm.pipeline.images import SlotImage
from stereo_sfm.pipeline.processes import _error  # pyright: ignore[reportPrivateUsage]
from stereo_sfm.service import map_cloud, pipelines
from stereo_sfm.service import recorder as service_recorder
from stereo_sfm.service.camera import patient, same_camera
from stereo_sfm.service.commands import Commands
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig
from stereo_sfm.service.health import HealthCollector, free_bytes
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.map_cloud import MapCloudBuilder
from stereo_sfm.service.map_keeper import MapKeeper
from stereo_sfm.service.messages import Event, MapCloud, ServiceState, Status
from stereo_sfm.service.notify import SystemdNotifier
from stereo_sfm.service.pipelines import IMMEDIATE_RESTARTS, Pipelines
from stereo_sfm.service.poses import HostClock, PoseConverter
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.robot_mounting import RobotMounting
from stereo_sfm.service.session import COMPILING, Session
from stereo_sfm.service.states import Facts, derive_state
from stereo_sfm.types import F64, Frame, MapUpdate, Observations, StereoImage, TrackState
from tests.pipeline.test_pipeline import SlidingWall
from tests.synthetic import pinhole_rig

NONE = np.zeros(0, np.int64)
MS = 1_000_000


def frame(k: int, pose: F64, version: int = 0, state: TrackState = TrackState.OK) -> Frame:
    covariance = np.diag([1e-4, 1e-4, 4e-4, 1e-6, 1e-6, 1e-6])
    return Frame(k, 1000 + k * 33 * MS, pose, covariance, state, "", Observations.empty(), -1, np.eye(4), version)


def update(version: int, map_T_odom: F64, point_ids: list[int], culled: tuple[int, ...] = ()) -> MapUpdate:
    ids = np.array(point_ids, np.int64)
    return MapUpdate(
        version, version, np.array([version]), map_T_odom[None], ids, np.ones((len(ids), 3)) * version,
        np.array(culled, np.int64), np.zeros((0, 2), np.int64), map_T_odom,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("facts", "state"),
    [
        (Facts(), ServiceState.STARTING),
        (Facts(starting="", image_s=9.9), ServiceState.RUNNING),
        (Facts(starting="", image_s=9.9, lost_ns=600 * MS), ServiceState.LOST),
        (Facts(starting="", image_s=8.0, interval_s=0.033), ServiceState.CAMERA_GONE),
        (Facts(starting="", image_s=8.0), ServiceState.RUNNING),  # it may be a source of 1 Hz
        (Facts(starting="", image_s=4.0), ServiceState.CAMERA_GONE),
        (Facts(source_error="no T265 found"), ServiceState.CAMERA_GONE),
        (Facts(starting="", image_s=9.9, disk_problem="full"), ServiceState.DISK_FULL),
        (Facts(starting="", image_s=9.9, lost_ns=600 * MS, disk_problem="full"), ServiceState.LOST),
        (Facts(stopping="SIGTERM", source_error="x"), ServiceState.STOPPING),
    ],
)
def test_the_most_severe_problem_is_the_state(facts: Facts, state: ServiceState) -> None:
    judged, reason = derive_state(facts, 10.0)
    assert judged == state and bool(reason) == (state != ServiceState.RUNNING)


@pytest.mark.parametrize("interval_s", [1 / 30, 1.0, 3.0])
def test_a_slow_source_and_a_busy_computer_are_no_loss(interval_s: float) -> None:
    """Losses are the tracker's to tell: neither the source's rate nor the computer's load makes one."""
    facts, now, states = Facts(), 100.0, list[ServiceState]()
    for k in range(40):
        now += interval_s * (1.9 if k % 7 == 3 else 1.0)  # late, as on a busy computer
        facts.image(now)
        facts.frame(k * int(interval_s * 1e9), True, "")
        states.append(derive_state(facts, now + 0.9 * interval_s)[0])  # the pose comes late, too
    assert set(states) == {ServiceState.RUNNING}
    for k in range(40, 40 + int(0.4 / interval_s)):  # a moment without a pose
        facts.frame(k * int(interval_s * 1e9), False, "dark")
        assert derive_state(facts, now)[0] == ServiceState.RUNNING
    facts.frame(60 * int(interval_s * 1e9), False, "dark")
    assert derive_state(facts, now) == (ServiceState.LOST, "dark")
    facts.frame(61 * int(interval_s * 1e9), True, "")
    assert derive_state(facts, now)[0] == ServiceState.RUNNING
    assert derive_state(facts, now + max(1.0, 6 * interval_s) + 0.1)[0] == ServiceState.CAMERA_GONE
    facts.starting = "the tracker is started again"
    facts.image(now)
    facts.frame(90 * int(interval_s * 1e9), False, "no pose yet")  # what a restart takes is no loss of the tracker
    assert derive_state(facts, now)[0] == ServiceState.RUNNING
    facts.frame(5, False, "dark")  # another source, whose clock begins anew
    facts.image(now)
    assert derive_state(facts, now)[0] == ServiceState.RUNNING


def test_a_command_that_fails_by_an_error_of_ours_is_answered_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    nothing: Any = None
    commands = Commands(RobotConfig(), nothing, nothing, nothing, nothing, nothing)
    reply = commands.call("reset")
    assert not reply.ok and reply.text.startswith("reset failed")
    assert "AttributeError" in caplog.text


@pytest.mark.parametrize("stage", ["capture", "mapper"])
def test_only_what_capture_says_is_the_cameras(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Refused:
        """One of its stages ends before the first image."""

        frames, tracking_s, map_complete, serial = 0, 0.0, False, ""

        def __init__(self, *_: object) -> None: ...

        def run(self) -> None:
            raise _error(Failed(stage, "this is the reason", True, 2))

    monkeypatch.setattr(pipelines, "Session", Refused)
    maps: Any = SimpleNamespace(begin=MapFolders, session_saved=None, mode="none")
    facts, nothing = Facts(source_error="no camera was found before"), cast(Any, None)
    opener = MadeSource(lambda: SlidingWall(1), device=True)
    tried = Pipelines(opener, Config(), 1.0, maps, nothing, nothing, facts, nothing)
    for _ in range(5):
        assert not tried._run_once()  # pyright: ignore[reportPrivateUsage]
    state = ServiceState.CAMERA_GONE if stage == "capture" else ServiceState.STARTING
    assert derive_state(facts, 0.0) == (state, "this is the reason")
    assert (tried._failures > IMMEDIATE_RESTARTS) == (stage == "mapper")  # pyright: ignore[reportPrivateUsage]


def test_a_map_that_cannot_be_read_is_not_loaded(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "map.json").write_text('{"kind": "stereo_sfm_map", "version": 99}')
    nothing: Any = None  # a restart would fail
    maps = MapKeeper(MapConfig(str(tmp_path / "store")), Config())
    reply = Commands(RobotConfig(), nothing, maps, nothing, nothing, nothing).call("load_map", {"name": "other"})
    assert not reply.ok and "is version 99, this program reads" in reply.text


def test_velocity_and_covariance_are_those_of_the_body() -> None:
    rig = dataclasses.replace(pinhole_rig(), body_T_left=se3.exp(np.array([0.3, 0.0, 0.2, 0.5, -0.5, 0.5])))
    maker = PoseConverter(rig, 1, HostClock())
    body_twist = np.array([0.6, 0.1, 0.0, 0.0, 0.0, 0.4])  # a second
    odom_T_body = [se3.exp(body_twist * 0.033 * k) for k in range(3)]
    poses = [maker.frame(frame(k, odom_T_body[k] @ rig.body_T_left)) for k in range(3)]
    assert np.isnan(poses[0].twist).all()
    np.testing.assert_allclose(poses[2].twist, body_twist, atol=1e-9)
    np.testing.assert_allclose(poses[2].odom_T_body, odom_T_body[2], atol=1e-12)
    lost = maker.frame(frame(3, np.eye(4), state=TrackState.LOST))
    assert not lost.tracked and np.isnan(lost.twist).all()
    assert np.isnan(maker.frame(frame(4, np.eye(4))).twist).all()
    # the covariance says how the body scatters in odom when the camera does as it says
    rng = np.random.default_rng(1)
    xi = rng.multivariate_normal(np.zeros(6), frame(0, np.eye(4)).covariance, 4000)
    cam = odom_T_body[2] @ rig.body_T_left
    scattered = np.array([(cam @ se3.exp(x) @ se3.inverse(rig.body_T_left))[:3, 3] for x in xi])
    np.testing.assert_allclose(np.cov(scattered.T), poses[2].covariance[:3, :3], atol=6e-5)


def test_poses_are_in_the_map_that_their_frame_knew() -> None:
    maker, moved = PoseConverter(pinhole_rig(), 7, HostClock()), se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    maker.update(update(1, np.eye(4), [1]))
    maker.localized(Localized(2))
    maker.update(dataclasses.replace(update(2, moved, [1]), down=np.array([0.0, 1.0, 0.0])))
    before, after = maker.frame(frame(0, np.eye(4), 1)), maker.frame(frame(1, np.eye(4), 2))
    assert not before.localized and after.localized and after.session == 7
    assert not before.down.any() and after.down.tolist() == [0.0, 1.0, 0.0]
    assert before.map_T_body[0, 3] == 0.0 and after.map_T_body[0, 3] == 1.0
    for version in range(3, 1000):
        maker.update(update(version, moved, [1]))
    assert maker.frame(frame(2, np.eye(4), 999)).map_version == 999


def test_a_recording_that_is_slower_than_its_stamps_does_not_age(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HostClock()
    clock.live = False
    monkeypatch.setattr("time.monotonic_ns", lambda: int(150e9))
    monkeypatch.setattr("time.time_ns", lambda: int(1_000_150e9))
    for k in range(1000):  # 30 Hz by its stamps, 20 Hz on this computer
        clock.image(k, k * 33 * MS, 100.0 + k * 0.05)
        assert abs(clock.unix_ns(k * 33 * MS) - int((1_000_100.0 + k * 0.05) * 1e9)) < 1000


def test_the_sensors_clock_is_that_of_the_fastest_image(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HostClock()
    for k in range(1000):
        clock.image(k, k * 33 * MS, 100.0 + k * 0.033 + (0.002 if k % 7 else 0.001))
    monkeypatch.setattr("time.monotonic_ns", lambda: int(133e9))
    monkeypatch.setattr("time.time_ns", lambda: int(1_000_133e9))
    assert abs(clock.unix_ns(0) - int(1_000_100.001e9)) < 1000
    monkeypatch.setattr("time.time_ns", lambda: int(1_003_733e9))  # the wall clock was set an hour later
    assert abs(clock.unix_ns(0) - int(1_003_700.001e9)) < 1000
    assert len(clock._captured) <= 301  # pyright: ignore[reportPrivateUsage]


def test_a_camera_that_does_not_keep_its_rate_does_not_age(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HostClock()
    monkeypatch.setattr("time.monotonic_ns", lambda: int(1000e9))
    monkeypatch.setattr("time.time_ns", lambda: int(1000e9))
    ages: list[float] = []
    for k in range(900):  # 30 Hz by its stamps, 10 Hz on this computer
        at = 100.0 + k * 0.1
        clock.image(k, k * 33 * MS, at)
        ages.append(at - clock.unix_ns(k * 33 * MS) * 1e-9)
    assert min(ages) > -1e-6 and max(ages) < 0.5 + 1e-6


@pytest.mark.parametrize("stalls", [((600, 0.92),), ((600, 2.9),), ((600, 0.9), (606, 0.6)), ((600, 0.55), (700, 0.9))])
@pytest.mark.parametrize("each_ms", [4, 15])
def test_images_that_waited_while_the_computer_stood_still_are_not_new(
    stalls: tuple[tuple[int, float], ...], each_ms: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera at 30 Hz; those that wait are handed over one after the other, some of them late."""
    monkeypatch.setattr("time.monotonic_ns", lambda: 0)
    monkeypatch.setattr("time.time_ns", lambda: 0)
    clock, rng, at, began = HostClock(), np.random.default_rng(1), 0.0, dict(stalls)
    for k in range(1200):
        exposed = 100.0 + k / 30
        at = max(at + rng.uniform(0.5, 1.5) * each_ms * 1e-3, exposed + 0.02 + rng.uniform(0.0, 0.003))
        at += began.get(k, 0.0)
        clock.image(k, int(k / 30 * 1e9), at)
        assert abs(clock.unix_ns(int(k / 30 * 1e9)) * 1e-9 - exposed - 0.02) < 0.005, k


@pytest.mark.parametrize("hz", [27.0, 10.0, 3.0, 1.0])
def test_a_slow_source_is_not_taken_for_a_stall(hz: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic_ns", lambda: 0)
    monkeypatch.setattr("time.time_ns", lambda: 0)
    clock, ages = HostClock(), list[float]()
    for k in range(900):
        clock.image(k, k * 33 * MS, 100.0 + k / hz)
        ages.append(100.0 + k / hz - clock.unix_ns(k * 33 * MS) * 1e-9)
    assert min(ages) > -1e-6 and max(ages[2:]) < 0.5 + 1e-6


def test_stamps_that_were_set_are_followed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic_ns", lambda: 0)
    monkeypatch.setattr("time.time_ns", lambda: 0)
    clock = HostClock()
    for k in range(600):
        stamp = k * 33 * MS - (k >= 300) * 5000 * MS
        clock.image(k, stamp, 100.0 + k * 0.033)
        assert abs(clock.unix_ns(stamp) * 1e-9 - 100.0 - k * 0.033) < 1e-6


def test_the_cloud_forgets_what_the_mapper_removed() -> None:
    clouds: list[MapCloud] = []
    follower = MapCloudBuilder(1, clouds.append)
    follower.close()
    for version in range(1, 200):  # ten points at a time, those of ten versions live
        old = tuple(range(10 * (version - 10), 10 * (version - 9)))
        follower.apply(update(version, np.eye(4), list(range(10 * version, 10 * version + 10)), old))
    cloud = follower.cloud(5, 199)
    assert len(cloud.point_ids) == 100 and cloud.point_ids.min() == 1900 and (np.diff(cloud.point_ids) > 0).all()
    assert cloud.points[-1, 0] == 199.0 and not cloud.saved


def test_the_last_update_is_sent_where_no_other_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that parks after a loop: its map is the corrected one."""
    monkeypatch.setattr(map_cloud, "EVERY_S", 0.3)
    clouds = list[MapCloud]()
    follower = MapCloudBuilder(1, clouds.append)
    for version in (1, 2):
        follower.put(update(version, np.eye(4), [version]))
        for _ in range(200):
            if clouds:
                break
            time.sleep(0.02)
    for _ in range(200):
        if len(clouds) > 1:
            break
        time.sleep(0.02)
    follower.close()
    assert [cloud.version for cloud in clouds] == [1, 2]


def test_a_late_callback_gets_the_newest_state_first_and_a_failing_one_affects_no_other() -> None:
    hub, got = Hub(()), list[Status]()
    hub.publish(Status(ServiceState.LOST, "dark"))
    hub.on(Status, lambda status: 1 / 0)
    done = hub.on(Status, got.append)
    hub.publish(Status(ServiceState.RUNNING))
    done()
    hub.publish(Status(ServiceState.STOPPING))
    hub.close()
    for _ in range(100):
        if len(got) >= 2:
            break
        __import__("time").sleep(0.02)
    assert [status.state for status in got] == [ServiceState.LOST, ServiceState.RUNNING]


def test_a_repeated_source_never_ends_and_its_stamps_go_on() -> None:
    images = iter(RepeatedSource(SlidingWall(5)))
    got = [next(images) for _ in range(13)]
    assert [image.frame_id for image in got] == list(range(13))
    assert set(np.diff([image.stamp_ns for image in got])) == {33_333_333}
    np.testing.assert_array_equal(got[11].left, got[1].left)


def test_only_the_same_camera_is_taken_again() -> None:
    camera = patient(SourceChoice.of("t265:?exposure=8000"))
    assert camera.options == {"reconnect": 86_400.0}
    assert same_camera(camera, "905312110123").spec == "t265:905312110123?exposure=8000"
    named = SourceChoice.of("t265:simulated?reconnect=5")
    assert patient(named) == named and same_camera(named, "1") == named
    assert patient(SourceChoice.of("sim:loop")) == same_camera(SourceChoice.of("sim:loop"), "1")


def test_systemd_is_notified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        monkeypatch.setenv("WATCHDOG_USEC", "2000000")
        notifier = SystemdNotifier()
        notifier.ready()
        notifier.status("running")
        notifier.status("running")
        notifier.reloading()
        notifier.stopping()
        told = [systemd.recv(1000).decode() for _ in range(4)]
    assert notifier.watchdog_s == 1.0 and told[:2] == ["READY=1", "STATUS=running"] and told[3] == "STOPPING=1"
    assert told[2].startswith("RELOADING=1\nMONOTONIC_USEC=")
    monkeypatch.delenv("NOTIFY_SOCKET")
    SystemdNotifier().ready()  # nothing listens: nothing happens


def test_closing_waits_for_callbacks_but_not_for_one_that_hangs() -> None:
    hub, taken, hang = Hub(()), list[str](), threading.Event()

    def slowly(event: Event) -> None:
        time.sleep(0.05)
        taken.append(event.text)

    hub.on(Event, slowly)
    hub.on(Status, lambda _: hang.wait(10))
    hub.publish(Status(ServiceState.RUNNING))
    for text in ("first", "last"):
        hub.publish(Event(0, "INFO", "main", text))
    began = time.monotonic()
    hub.close()
    assert taken == ["first", "last"] and time.monotonic() - began < 8.0
    hang.set()


def test_the_first_start_says_that_kernels_are_compiled() -> None:
    facts = Facts()
    session = Session(
        1, lambda: RepeatedSource(SlidingWall(2)), Config(), MapFolders(), Hub([]), facts, HealthCollector(), 1.0,
        Recorder(RecordingConfig()), lambda saved: None, RobotMounting(), None,
    )  # fmt: skip
    session.put(Compiling("tracker", "track"))
    assert derive_state(facts, 0.0) == (ServiceState.STARTING, COMPILING)
    facts.starting = ""  # images come: another kernel is no reason to say that it starts
    session.put(Compiling("mapper", "solve"))
    assert facts.starting == ""


def test_free_space_behind_a_folder_that_others_may_not_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage, asked = shutil.disk_usage, list[Path]()

    def refused(place: Path) -> Any:
        asked.append(place)
        if place != tmp_path:
            raise PermissionError(13, "Permission denied")
        return usage(place)

    monkeypatch.setattr(shutil, "disk_usage", refused)
    assert free_bytes(tmp_path / "closed" / "recordings") > 0 and len(asked) == 3
    assert free_bytes(Path("/elsewhere")) == 0


class Images:
    """What a recorder sends to its process."""

    def __init__(self) -> None:
        self.sent = list[object]()

    def send(self, message: object) -> None:
        self.sent.append(message)

    def images(self) -> int:
        return sum(isinstance(message, tuple) for message in self.sent)


def test_a_lean_recording_goes_on_where_the_sources_time_begins_anew() -> None:
    recorder, outbox = Recorder(RecordingConfig(mode="lean")), Images()
    recorder._process, recorder._outbox = (cast(Any, x) for x in (object(), outbox))  # pyright: ignore
    run: Any = SimpleNamespace(info=SimpleNamespace(rig=pinhole_rig()), ring=None, release=lambda _: None)
    for session in range(2):
        recorder.begin(run, Config(), "wall", Opening())
        for k in range(10):
            image = StereoImage(k, round((100.0 * (1 - session) + 2.0 * k) * 1e9), np.zeros((2, 2), np.uint8))
            recorder.image(SlotImage(0, image, False, False, 0.0))
            recorder._held.clear()  # pyright: ignore[reportPrivateUsage]
        recorder.end()
    assert outbox.images() == 20


def test_an_image_without_a_slot_for_the_recorder_is_sent_without_its_pixels() -> None:
    recorder, outbox = Recorder(RecordingConfig(mode="full")), Images()
    recorder._process, recorder._outbox = (cast(Any, x) for x in (object(), outbox))  # pyright: ignore
    run: Any = SimpleNamespace(info=SimpleNamespace(rig=pinhole_rig()), ring=None, release=lambda _: None)
    recorder.begin(run, Config(), "wall", Opening())
    image = StereoImage(7, 700, np.zeros((2, 2), np.uint8))
    taken = [recorder.image(SlotImage(0, image, False, False, 0.0, logged=logged)) for logged in (True, False)]
    assert taken == [True, False] and outbox.images() == 1
    assert [m.frame_id for m in outbox.sent if isinstance(m, StereoImage)] == [7]


def test_a_recorder_that_dies_at_its_start_is_not_started_all_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    started = list[float]()

    def dies(_: str, __: Any, *pipes: Any) -> Any:
        started.append(time.monotonic())
        for end in pipes:
            end.close()
        return SimpleNamespace(pid=os.getpid(), join=lambda *_: None, exitcode=1, kill=lambda: None, is_alive=bool)

    monkeypatch.setattr(service_recorder, "start_child", dies)
    monkeypatch.setattr(service_recorder, "FIRST_PAUSE_S", 0.1)
    recorder, before = Recorder(RecordingConfig(mode="full")), threading.active_count()
    run: Any = SimpleNamespace(info=SimpleNamespace(rig=pinhole_rig()), ring=None, release=lambda _: None)
    recorder.begin(run, Config(), "wall", Opening())
    time.sleep(1.0)
    recorder.close()
    time.sleep(0.2)
    assert 3 <= len(started) <= 5  # at 0, 0.1, 0.3 and 0.7 s
    assert threading.active_count() <= before + 1


@pytest.mark.parametrize("recording", [False, True])
def test_a_recorder_with_nothing_to_write_is_not_missed(recording: bool, caplog: pytest.LogCaptureFixture) -> None:
    listener = SimpleNamespace(join=lambda *_: None, is_alive=lambda: True)
    recorder = Recorder(RecordingConfig())
    recorder._process = cast(Any, SimpleNamespace(kill=lambda: None))  # pyright: ignore[reportPrivateUsage]
    recorder._listener = cast(Any, listener)  # pyright: ignore[reportPrivateUsage]
    recorder.state = dataclasses.replace(recorder.state, recording=recording)
    recorder.close()
    assert ("did not end in time" in caplog.text) == recording


def test_the_end_of_a_recorder_that_is_noticed_late_is_not_taken_for_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recorder, reaped = Recorder(RecordingConfig(mode="full")), os.waitpid

    def slow(pid: int, options: int) -> tuple[int, int]:
        time.sleep(0.2 if threading.current_thread() is threading.main_thread() else 0.0)
        result = reaped(pid, options)
        time.sleep(0.5)  # of a busy machine, before this thread can tell what it knows
        return result

    recorder.start()
    monkeypatch.setattr(os, "waitpid", slow)
    recorder.state, recorder._number = dataclasses.replace(recorder.state, recording=True), 1  # pyright: ignore
    recorder.close()
    assert "did not end in time" not in caplog.text
