"""The operator's page: what it shows and does in a real browser, and what it refuses to others."""

from __future__ import annotations

import http.client
import json
import shlex
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, FloorPlan, write_floor_plan
from stereo_sfm.geometry import se3
from stereo_sfm.recording.describe import describe_file
from stereo_sfm.recording.segments import recordings, segments
from stereo_sfm.service.config import RobotConfig
from stereo_sfm.service.messages import Event, ServiceState
from stereo_sfm.service.outputs.access import Access, Links
from stereo_sfm.service.outputs.ports import ports
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.outputs.settings import (
    FoxgloveConfig,
    OutputsConfig,
    PageConfig,
    PoseSocketConfig,
    Ros2Config,
    SecurityConfig,
)
from stereo_sfm.service.page import app, server
from stereo_sfm.service.page.server import PageOutput
from stereo_sfm.service.page.state import PageState
from stereo_sfm.service.page.verdicts import GOOD, Verdicts, problems
from stereo_sfm.service.publisher import COMMANDS, Reply
from stereo_sfm.types import U8
from tests.pipeline.test_pipeline import SlidingWall
from tests.recording.test_segments import record, start
from tests.service.browser import CHROMIUM, FIREFOX, Browser, Chromium, Firefox
from tests.service.service_messages import FakeService, cloud, health, picture, pose_update, started, status

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

DEMO = Path(__file__).parents[2] / "recordings" / "demo.mcap"
TOKEN = "a-token-of-thirty-two-characters"
COMMAND = {"Content-Type": "application/json", "X-Stereo-Sfm": "1"}


def _recordings(folder: Path) -> dict[str, Reply]:
    files = [folder / "drive" / f"{i}.mcap" for i in range(2)]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(file.name.encode() * 1000)
    row = {
        "id": "00007 <b>&1", "began": "2026-11-22T10:00:00", "source": "t265", "mode": "full", "seconds": 75,
        "segments": 3, "with_images": 1, "bytes": 12_000_000, "marked": True, "recording": True,
    }  # fmt: skip
    return {
        "recordings": Reply(True, "", {"recordings": [row, {**row, "id": "20261126_081233_t265", "recording": False}]}),
        "recording_files": Reply(True, "", {"files": [str(f) for f in files]}),
        "status": Reply(
            True,
            "",
            {"settings": {"map.save_every_min": 5.0, "recording.quota_gb": 20.0, "recording.mark_losses": True}},
        ),
        "save_map": Reply(False, "the disk is full"),
    }


@contextmanager
def _serving(
    service: FakeService | None = None, rules: Access | None = None, surface: str = ""
) -> Iterator[PageOutput]:
    output = PageOutput("127.0.0.1", 0, 4.0, rules, surface=surface)
    output.open(service or FakeService())
    try:
        yield output
    finally:
        output.close()


def _ask(
    output: PageOutput, method: str, path: str, body: bytes | str | None = None, headers: dict[str, str] | None = None
) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", output.port, timeout=10)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read(), {k.lower(): v for k, v in answer.getheaders()}
    finally:
        connection.close()


def _show(output: PageOutput, frame: int, state: ServiceState = ServiceState.RUNNING, **others: Any) -> None:
    pose = se3.exp(np.array([0.3, 0, 0.5 + 0.05 * frame, 0, 0.4, 0]))
    messages = [started(), pose_update(frame, pose), picture(frame), health(), status(state, **others)]
    for message in (*messages, cloud(3000, 12)):
        output.put(message)


def _plan() -> tuple[U8, float, tuple[float, float]]:
    """A room of 6 m x 4 m with a shelf at x 2.4 ... 3.2, y 0 ... 0.5 (in axes of the floor)."""
    image = np.full((80, 120), FREE, np.uint8)  # the last row has the least y
    image[:3] = image[-3:] = OCCUPIED
    image[:, :3] = image[:, -3:] = OCCUPIED
    image[40:50, 64:80] = OCCUPIED
    return image, 0.05, (-0.8, -1.5)


def _tilted() -> Rig:
    """A camera that looks half down."""
    rig = started().rig
    return replace(rig, body_T_left=se3.exp(np.array([0, 0, 0, 0, 0.7, 0.3])) @ rig.base_T_left)


def _press(browser: Browser, key: str, code: str, text: str = "") -> None:
    """A key on what has the focus, with what the browser itself does then."""
    browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=code, text=text)
    browser.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=code)


def _touch(browser: Browser, steps: list[list[tuple[int, int]]]) -> None:
    """Fingers go through these places together."""
    for k, places in enumerate(steps):
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        browser.call("Input.dispatchTouchEvent", type="touchMove" if k else "touchStart", touchPoints=points)
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


# -- in a browser ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(Chromium, marks=pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")),
        pytest.param(Firefox, marks=pytest.mark.skipif(FIREFOX is None, reason="no Firefox")),
    ],
)
@pytest.mark.parametrize(("width", "height"), [(1440, 900), (768, 1024), (390, 844)])
def test_an_operator_sees_and_does_everything(
    kind: type[Chromium] | type[Firefox], width: int, height: int, tmp_path: Path
) -> None:
    service = FakeService(_recordings(tmp_path))
    with _serving(service, surface=str(tmp_path)) as output, kind(width, height) as browser:
        stop = threading.Event()
        told: dict[str, Any] = {"state": ServiceState.RUNNING, "reason": "", "remedy": ""}

        def feed() -> None:
            frame = 0
            while not stop.wait(0.1):
                _show(output, frame := frame + 1, **told)

        output.put(Event(0, "warning", "tracker", "lost in <i>aisle 3</i>"))
        feeding = threading.Thread(target=feed)
        feeding.start()
        try:
            browser.go(f"http://127.0.0.1:{output.port}/")
            browser.until("document.getElementById('state').textContent === 'running'")
            browser.until("document.getElementById('image').naturalWidth === 320")
            drawn = "[...document.getElementById('plan').getContext('2d').getImageData(0,0,640,480).data]"
            assert browser.until(f"{drawn}.filter(v => v).length > 4000")
            text = browser.run("document.body.innerText")
            for shown in ("29.9 images a second", "14.0 ms", "3 ring", "51 °C", "42.0 GB free", "row error 0.12 px"):
                assert shown in text
            browser.until("document.getElementById('recordings').innerText.includes('00007 <b>&1 ★')")  # no markup
            assert "1:15 min, 12 MB" in text or "1:15 min, 12 MB" in browser.run("document.body.innerText")
            text = browser.run("document.body.innerText")
            assert "2 of 3 segments without images" in text and "being recorded" in text
            left_T_robot = np.linalg.inv(RobotAxes(started().rig).base_T_left)
            output._state._take_plan(*_plan(), left_T_robot)  # pyright: ignore[reportPrivateUsage]
            told.update(map_is_new=True)
            browser.until("document.getElementById('plan').dataset.plan === 'shown' && plan !== null")
            _surface(tmp_path)
            browser.run("refresh()")
            browser.until("document.getElementById('plan').dataset.surface === 'shown'")
            assert "lost in <i>aisle 3</i>" in browser.run("document.getElementById('events').innerText")
            assert browser.run("document.documentElement.scrollWidth") <= width  # nothing hangs over the side
            inside = "[...document.querySelectorAll('section')].every(s => s.scrollWidth <= s.clientWidth)"
            browser.until(f"document.getElementById('recordings').innerText.includes('reindex') && {inside}", 60)
            browser.screenshot(tmp_path / "running.png")
            browser.run("document.querySelector('[data-command=save_map]').click()")
            browser.until("document.getElementById('reply').textContent === 'the disk is full'")
            browser.run("document.getElementById('record').click()")
            browser.until("document.getElementById('reply').textContent === 'start_recording done'")
            browser.run("document.querySelector('[data-command=mark]').click()")
            assert "save every min" not in text and "Most minutes between two saves" in text  # names, units and help
            browser.run("document.querySelector('#settings input[role=switch]').click()")
            browser.until("document.getElementById('reply').textContent === 'set_setting done'")
            assert ("set_setting", {"name": "recording.mark_losses", "value": "false"}) in service.calls
            press = "document.dispatchEvent(new KeyboardEvent('keydown', {key: '%s', bubbles: true}))"
            before = browser.run("view.scale")
            browser.run(press % "f")
            browser.until(f"view.follow && view.scale > 2 * {before}")
            browser.run(press % "0")
            browser.until("!view.follow && view.zoom === 1")
            assert browser.run("document.querySelectorAll('#history svg path').length") == 4
            browser.run("window.confirm = () => true; document.querySelector('[data-command=reset]').click()")
            buttons = "[...document.querySelectorAll('#recordings button')]"
            browser.run(f"{buttons}.find(b => b.textContent === 'files').click()")
            browser.until("document.querySelectorAll('#files a').length === 2")
            browser.run(f"{buttons}.find(b => b.textContent === 'delete').click()")
            browser.until("document.getElementById('reply').textContent === 'delete_recording done'")
            told.update(state=ServiceState.CAMERA_GONE, reason="The camera is gone.", remedy="Plug it in again.")
            browser.until("document.getElementById('remedy').textContent === 'Plug it in again.'")
            assert browser.run("document.getElementById('state').className") == "badge bad"
            browser.screenshot(tmp_path / "gone.png")
        finally:
            stop.set()
            feeding.join()
        names = [name for name, _ in service.calls]
        assert {"save_map", "start_recording", "mark", "reset"} <= set(names)
        assert ("delete_recording", {"id": "00007 <b>&1"}) in service.calls
        output.close()
        browser.until("document.getElementById('state').textContent === 'no connection'")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_link_logs_the_browser_in_once() -> None:
    code = Links(TOKEN).new()
    with _serving(rules=Access(TOKEN)) as output:
        _show(output, 1)
        for first in (True, False):
            with Chromium(800, 600) as browser:
                browser.call("Page.navigate", url=f"http://127.0.0.1:{output.port}/#{code}")
                shown = "document.getElementById('state').textContent === 'running'"
                browser.until(shown if first else "!document.getElementById('login').hidden")
                assert browser.run("location.hash") == ""  # nobody reads it over a shoulder, or in the history


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_the_browser_asks_for_the_token() -> None:
    with _serving(rules=Access(TOKEN)) as output, Chromium(800, 600) as browser:
        _show(output, 1)
        browser.go(f"http://127.0.0.1:{output.port}/")
        browser.until("!document.getElementById('login').hidden")
        give = "document.getElementById('token').value = '%s'; document.getElementById('login').requestSubmit()"
        browser.run(give % "wrong")
        browser.until("document.getElementById('login-reply').textContent === 'this is not the token'")
        browser.run(give % TOKEN)
        browser.until("document.getElementById('state').textContent === 'running'")
        assert browser.run(
            "document.getElementById('login').hidden && !document.cookie && !location.href.includes('tok')"
        )


# -- without one -------------------------------------------------------------------------------------------------------


def test_the_live_state_is_a_stream_of_events() -> None:
    with _serving() as output:
        _show(output, 3, ServiceState.LOST, reason="It is dark.")
        connection = http.client.HTTPConnection("127.0.0.1", output.port, timeout=10)
        connection.request("GET", "/api/live")
        answer = connection.getresponse()
        first = json.loads(answer.readline().removeprefix(b"data: "))
        output.put(pose_update(9, tracked=False, state="LOST"))
        frames = [
            json.loads(line[6:])["pose"]["frame_id"]
            for line in (answer.readline() for _ in range(8))
            if line[6:].strip()
        ]
        connection.close()
    assert first["status"]["reason"] == "It is dark." and first["pose"]["frame_id"] == 3 and frames[-1] == 9
    assert first["pose"]["x"] > 0.5 and first["pose"]["heading"] == pytest.approx(-0.4)
    assert first["health"]["latency_ms"] == [14.0, 21.5]


def test_the_map_is_thinned_and_nothing_grows() -> None:
    with _serving() as output:
        output.put(started())
        for i in range(300):
            output.put(Event(i, "info", "map", "saved"))
        output.put(cloud(200_000, 10_000))
        shown = json.loads(_ask(output, "GET", "/api/map")[1])
        live = output._state.snapshot()  # pyright: ignore[reportPrivateUsage]
    assert 1000 < len(shown["points"]) <= 6001 and 100 < len(shown["path"]) <= 3001
    assert len(json.loads(live)["events"]) == 60 and len(live) < 20_000


@pytest.mark.filterwarnings("error")
def test_a_point_without_a_place_is_not_shown() -> None:
    with _serving() as output:
        output.put(started())
        near = cloud(500, 10)
        points = near.points.copy()
        points[3], points[4, 1], points[5, 2] = np.nan, np.inf, -1e30
        output.put(replace(near, points=points))
        end = time.monotonic() + 10
        while not (shown := json.loads(_ask(output, "GET", "/api/map")[1], parse_constant=pytest.fail))["points"]:
            assert time.monotonic() < end
            time.sleep(0.01)
    assert 400 < len(shown["points"]) <= 497 and np.abs(shown["points"]).max() < 1e3


def test_the_floor_plan_is_in_the_axes_of_the_poses() -> None:
    with _serving() as output:
        assert _ask(output, "GET", "/api/floor_plan.png")[0] == 204
        state = output._state  # pyright: ignore[reportPrivateUsage]
        left_T_robot = np.linalg.inv(RobotAxes(started().rig).base_T_left)
        state._take_plan(*_plan(), left_T_robot)  # pyright: ignore[reportPrivateUsage]
        state.put(started(_tilted()))
        tilted = json.loads(state.snapshot())["plan"]
        state.put(started())
        extent = json.loads(state.snapshot())["plan"]
        code, data, headers = _ask(output, "GET", "/api/floor_plan.png")
    assert code == 200 and headers["content-type"] == "image/png" and extent["version"] > tilted["version"]
    assert extent["x"] != tilted["x"]
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))

    def pixel(x: float, y: float) -> list[int]:
        return image[int((extent["x"] - x) / 0.05), int((extent["y"] - y) / 0.05)].tolist()

    assert pixel(2.8, 0.25) == [60, 50, 40, 255]  # the shelf
    assert pixel(1.0, 0.25) == pixel(2.8, 0.75) == [255, 255, 255, 255]
    assert image.shape[0] * 0.05 == pytest.approx(extent["along_x"])


def test_what_a_service_shows_after_a_restart_has_other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that was open meanwhile asks for it."""
    versions = list[tuple[int, int]]()
    for now_s in (1_700_000_000, 1_700_000_009):
        monkeypatch.setattr(time, "time_ns", lambda now_s=now_s: now_s * 10**9)
        state = PageState()
        state.put(started())
        state._take_plan(*_plan(), np.eye(4))  # pyright: ignore[reportPrivateUsage]
        state.put(cloud(30, 3))
        shown = json.loads(state.snapshot())
        assert shown["map_version"] == json.loads(state.map())["version"]
        versions.append((shown["plan"]["version"], shown["map_version"]))
    assert not set(versions[0]) & set(versions[1])


def _surface(folder: Path, height: int = 20, width: int = 30) -> None:
    """What `dense` writes: 10 cm a pixel, red at x 1 ... 1.5, y 0.4 ... 0.9 of the robot's map."""
    picture = np.zeros((height, width, 4), np.uint8)
    picture[-10:-5, 15:20] = (0, 0, 255, 255)
    left_T_robot = se3.inverse(RobotAxes(started().rig).base_T_left)
    plan = FloorPlan(np.zeros((height, width), np.uint8), 0.1, (-0.5, -0.1), left_T_robot)
    write_floor_plan(plan, folder / "costmap")
    cv2.imwrite(str(folder / "height.png"), picture)


def test_a_surface_lies_under_the_map(tmp_path: Path) -> None:
    with _serving(surface=str(tmp_path)) as output:
        assert _ask(output, "GET", "/api/surface")[0] == 204, "no camera yet"
        output.put(started())
        assert _ask(output, "GET", "/api/surface")[0] == _ask(output, "GET", "/api/surface.png")[0] == 204
        _surface(tmp_path)
        extent = json.loads(_ask(output, "GET", "/api/surface")[1])
        code, data, headers = _ask(output, "GET", "/api/surface.png")
        output._state.put(started(_tilted()))  # pyright: ignore[reportPrivateUsage]
        tilted = json.loads(_ask(output, "GET", "/api/surface")[1])
        output._state.put(started())  # pyright: ignore[reportPrivateUsage]
        assert tilted["version"] != extent["version"] and tilted["x"] != extent["x"]
        _surface(tmp_path, 2400, 5000)
        large = json.loads(_ask(output, "GET", "/api/surface")[1])
        reduced = cv2.imdecode(np.frombuffer(_ask(output, "GET", "/api/surface.png")[1], np.uint8), -1)
        assert reduced is not None
        for bad in (b"", b"no: [picture"):
            (tmp_path / "costmap.yaml").write_bytes(bad)
            (tmp_path / "height.png").touch()
            assert _ask(output, "GET", "/api/surface")[0] == 204
    assert code == 200 and headers["content-type"] == "image/png"
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))

    def pixel(x: float, y: float) -> list[int]:
        return image[int((extent["x"] - x) / 0.1), int((extent["y"] - y) / 0.1)].tolist()

    assert pixel(1.05, 0.45) == pixel(1.45, 0.85) == [0, 0, 255, 255]
    assert pixel(1.05, 0.3) == pixel(1.6, 0.65) == [0, 0, 0, 0]
    assert extent["version"] != large["version"] and max(np.shape(reduced)) <= 2048
    assert large["along_x"] == pytest.approx(500, abs=1)


def test_recordings_have_the_verdict_of_info(tmp_path: Path) -> None:
    good, bad = tmp_path / "good", tmp_path / "bad"
    for folder in (good, bad):
        folder.mkdir()
    folders = {"good": good, "bad": bad, "deleted": None}
    found = {good: [], bad: ["2 gaps between images", "no right images"]}
    verdicts = Verdicts(folders.get, found.__getitem__)
    rows: list[dict[str, Any]] = [
        {"id": id, "bytes": 7, "segments": 1, "with_images": 1, "recording": False} for id in folders
    ]
    assert {row["verdict"] for row in verdicts.add(rows)} == {"being checked"}
    end = time.monotonic() + 10
    while (shown := [row["verdict"] for row in verdicts.add(rows)])[:2] != [GOOD, "; ".join(found[bad])]:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert shown[2] == "being checked"
    rows[0] |= {"bytes": 8}
    assert verdicts.add(rows)[0]["verdict"] == "being checked"  # it has grown
    assert verdicts.add([{**rows[0], "recording": True}])[0]["verdict"] == "being recorded"
    assert verdicts.add([{**rows[0], "with_images": 0}])[0]["verdict"] == "poses only"


@pytest.mark.slow
def test_the_verdict_is_what_info_prints(tmp_path: Path) -> None:
    assert problems(DEMO) == describe_file(DEMO).problems == []
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(DEMO.read_bytes()[:-200_000])
    assert problems(cut) == describe_file(cut).problems != []


def test_images_are_made_only_while_a_page_is_open() -> None:
    with _serving() as output:
        output.put(picture(1))
        assert _ask(output, "GET", "/api/image.jpg")[0] == 204
        output.put(picture(2))
        code, data, headers = _ask(output, "GET", "/api/image.jpg")
        assert code == 200 and data[:2] == b"\xff\xd8" and headers["content-type"] == "image/jpeg"


def test_recordings_are_loaded_by_id_and_number(tmp_path: Path) -> None:
    service = FakeService(_recordings(tmp_path))
    (tmp_path / "secret").write_text("secret")
    with _serving(service) as output:
        code, data, headers = _ask(output, "GET", "/api/recordings/r1/1")
        assert code == 200 and data == b"1.mcap" * 1000 and 'filename="drive_1.mcap"' in headers["content-disposition"]
        names = json.loads(_ask(output, "GET", "/api/recordings/r1")[1])
        assert names == [{"name": f"{i}.mcap", "bytes": 6000} for i in range(2)]
        for path in (
            "/api/recordings/r1/2", "/api/recordings/r1/-1", "/api/recordings/..%2f..%2fsecret/0x", "/../secret",
            "/static/../secret", "/%2e%2e/secret", "/api/recordings/../../secret", "/page", "/app.py",
        ):  # fmt: skip
            code, data, _ = _ask(output, "GET", path)
            assert code == 404 and b"secret" not in data, path


def _recorded(root: Path) -> Path:
    """A recording of five seconds in segments of one."""
    recorder = start(root)
    record(recorder, list(SlidingWall(150)))
    recorder.close(20.0)
    return recordings(root)[0]


def test_a_recording_is_played_back_by_its_thumbnails(tmp_path: Path) -> None:
    folder = _recorded(tmp_path)
    service = FakeService({"recording_files": Reply(True, "", {"files": [str(p) for p in sorted(folder.iterdir())]})})
    with _serving(service) as output:
        place = f"/api/recordings/{folder.name}"
        code, data, _ = _ask(output, "GET", f"{place}/timeline")
        times = json.loads(data)
        assert code == 200 and times[0] == 0.0 and np.allclose(np.diff(times), 2.0, atol=0.1) and len(times) == 3
        images = [_ask(output, "GET", f"{place}/thumbnails/{k}") for k in range(3)]
        assert all(code == 200 and data[:2] == b"\xff\xd8" for code, data, _ in images)
        assert len({data for _, data, _ in images}) == 3
        assert _ask(output, "GET", f"{place}/thumbnails/3")[0] == 204
        last = segments(folder)[-1].poses
        last.write_bytes(last.read_bytes()[:-8])  # it is being written
        assert len(json.loads(_ask(output, "GET", f"{place}/timeline")[1])) < 3
        last.write_bytes(b"\x89MCAP0\r\n" + bytes(200) + b"\x89MCAP0\r\n")
        assert _ask(output, "GET", f"{place}/timeline")[0] in (200, 404)
    gone = FakeService({"recording_files": Reply(False, "no recording")})
    with _serving(gone) as output:
        assert _ask(output, "GET", "/api/recordings/none/timeline")[0] == 404
        assert _ask(output, "GET", "/api/recordings/none/thumbnails/0")[0] == 404


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_an_operator_plays_a_recording_by_keyboard_in_the_dark(width: int, height: int, tmp_path: Path) -> None:
    folder = _recorded(tmp_path)
    row = {
        "id": folder.name, "began": "2026-11-22T10:00:00", "source": "wall", "mode": "full", "seconds": 5,
        "segments": 5, "with_images": 5, "bytes": 12_000_000, "marked": False, "recording": False,
    }  # fmt: skip
    service = FakeService(
        {
            "recordings": Reply(True, "", {"recordings": [row]}),
            "recording_files": Reply(True, "", {"files": [str(p) for p in sorted(folder.iterdir())]}),
            "status": Reply(True, "", {"settings": {"recording.quota_gb": 20.0}}),
        }
    )
    press = "document.getElementById('%s').dispatchEvent(new KeyboardEvent('keydown', {key: '%s', bubbles: true}))"
    with _serving(service) as output, Chromium(width, height) as browser:
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
        _show(output, 1)
        browser.go(f"http://127.0.0.1:{output.port}/")
        browser.until("document.querySelector('.thumbnail')?.naturalWidth > 0")
        buttons = "[...document.querySelectorAll('#recordings button')]"
        browser.run(f"{buttons}.find(b => b.textContent === 'play').click()")
        browser.until("document.getElementById('player').open && document.getElementById('frame').naturalWidth > 0")
        browser.until("played.at === 2 && !played.timer")  # played to its end
        browser.run(press % ("player", "ArrowLeft"))
        browser.until("played.at === 1 && document.getElementById('time').textContent === '0:02 of 0:04'")
        browser.run(press % ("player", " "))
        browser.until("played.timer !== 0 || played.at === 2")
        dark = (
            "getComputedStyle(document.body).backgroundColor + getComputedStyle(document.documentElement).colorScheme"
        )
        assert "light dark" in browser.run(dark) and browser.run("matchMedia('(prefers-color-scheme: dark)').matches")
        assert browser.run("document.documentElement.scrollWidth") <= width
        browser.screenshot(tmp_path / "player.png")
        browser.run("pause(); document.getElementById('close').focus()")
        _press(browser, " ", "Space", " ")
        browser.until("!document.getElementById('player').open && !played.timer")
        browser.screenshot(tmp_path / "dark.png")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_finger_scrolls_the_page_and_two_move_and_zoom_the_map() -> None:
    with _serving() as output, Chromium(390, 844) as browser:
        browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        _show(output, 1)
        browser.go(f"http://127.0.0.1:{output.port}/")
        browser.until("map.points.length && (redraw(), view.cx !== undefined)")
        box = "document.getElementById('plan').getBoundingClientRect()"
        x, y = (round(v) for v in browser.run(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})"))
        _touch(browser, [[(x - 20 - 5 * k, y), (x + 20 + 5 * k, y)] for k in range(9)])
        browser.until("Math.abs(view.zoom - 3) < 0.01")
        zoom, cx, cy = browser.run("[view.zoom, view.cx, view.cy]")
        _touch(browser, [[(x, y + 10 * k), (x + 40, y + 10 * k)] for k in range(7)])
        browser.until(f"Math.abs(view.cx - {cx} - 60 / view.scale) < 0.01 && Math.abs(view.cy - {cy}) < 0.01")
        assert browser.run("view.zoom") == pytest.approx(zoom)
        assert browser.run("visualViewport.scale === 1 && scrollY === 0")
        before = browser.run("[view.zoom, view.cx, view.cy]")
        _touch(browser, [[(x, y - 10 * k)] for k in range(11)])
        browser.until("scrollY > 30")
        assert browser.run("[view.zoom, view.cx, view.cy]") == before


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_arrow_keys_move_the_map_and_a_reload_keeps_the_plots() -> None:
    with _serving() as output, Chromium(1440, 900) as browser:
        address = f"http://127.0.0.1:{output.port}/"
        _show(output, 1)
        browser.go(address)
        browser.until("map.points.length && (redraw(), view.cx !== undefined) && history_.length > 2")
        cx, cy = browser.run("document.getElementById('plan').focus(), [view.cx, view.cy]")
        _press(browser, "ArrowUp", "ArrowUp")
        browser.until(f"view.cx > {cx} && view.cy === {cy} && scrollY === 0")
        _press(browser, "ArrowRight", "ArrowRight")
        browser.until(f"view.cy < {cy}")
        _press(browser, "0", "Digit0", "0")
        browser.until(f"view.x === null && view.cx === {cx}")
        first = browser.run("history_[0].at")
        browser.call("Page.reload")
        browser.until(f"document.readyState === 'complete' && history_.length > 3 && history_[0].at === {first}")
        assert browser.run("document.querySelectorAll('#history svg path').length") == 4


def test_commands_of_other_sites_and_too_large_ones_are_refused() -> None:
    service = FakeService()
    with _serving(service) as output:
        body = b'{"text": "bump"}'
        form = {"Content-Type": "text/plain"}
        assert _ask(output, "POST", "/api/command/mark", body, form)[0] == 403
        for sent, headers, why in (
            (body, {**COMMAND, "Content-Type": "text/plain"}, b"Content-Type: application/json"),
            (b"[" * 50, COMMAND, b"not a JSON object"),
            (b" " * 20_000 + body, COMMAND, b"larger than 16384 bytes"),
        ):
            code, data, _ = _ask(output, "POST", "/api/command/mark", sent, headers)
            assert code == 400 and why in data
        assert _ask(output, "POST", "/api/command/recording_files", body, COMMAND)[0] == 404
        assert _ask(output, "GET", "/api/command/mark")[0] == 405
        assert not service.calls
        code, data, _ = _ask(output, "POST", "/api/command/mark", b'{"tekst": 1}', COMMAND)
        assert code == 200 and not json.loads(data)["ok"] and not service.calls
        assert _ask(output, "POST", "/api/command/mark", body, COMMAND)[0] == 200
        assert service.calls == [("mark", {"text": "bump"})]
        codes = [_ask(output, "POST", "/api/command/mark", body, COMMAND)[0] for _ in range(60)]
        assert 429 in codes


def test_the_documented_request_and_commands_are_those_of_the_page() -> None:
    text = (Path(__file__).parents[2] / "docs" / "tasks" / "service-outputs.md").read_text()
    table = text[text.index("| command | fields") : text.index("Without fields the object")]
    rows = [[cell.strip() for cell in line.split("|")[1:3]] for line in table.splitlines()[2:] if line]
    documented = {name.strip("`"): fields for name, fields in rows}
    assert tuple(documented) == app.COMMANDS
    for name, fields in documented.items():
        assert all(f"`{field}`" in fields for field in COMMANDS[name].arguments) and bool(fields) == bool(
            COMMANDS[name].arguments
        )
    (line,) = (line for line in text.splitlines() if line.startswith("    curl "))
    words = shlex.split(line)
    headers = dict(words[k + 1].split(": ") for k, word in enumerate(words) if word == "-H")
    service = FakeService()
    with _serving(service) as output:
        path = words[-1].removeprefix("127.0.0.1:8080")
        assert _ask(output, "POST", path, words[words.index("-d") + 1], headers)[0] == 200
    assert service.calls == [("mark", {"text": "a bump"})]


def test_only_this_computers_names_are_answered_and_headers_are_safe() -> None:
    """A page elsewhere may let its own name point here (DNS rebinding): such requests carry that name."""
    with _serving() as output:
        for host, code in (
            ("evil.example", 421),
            ("localhost:1", 200),
            ("127.0.0.1", 200),
            ("127.0.0.1.evil.example", 421),
        ):
            assert _ask(output, "GET", "/", None, {"Host": host})[0] == code, host
        for origin, code in (("https://evil.example", 403), ("null", 403), (f"http://127.0.0.1:{output.port}", 200)):
            assert _ask(output, "POST", "/api/command/mark", b"{}", {**COMMAND, "Origin": origin})[0] == code, origin
        headers = _ask(output, "GET", "/")[2]
    assert "default-src 'self'" in headers["content-security-policy"] and headers["x-content-type-options"] == "nosniff"
    assert "server" not in headers


def test_nothing_is_sent_without_the_token() -> None:
    with _serving(rules=Access(TOKEN)) as output:
        _show(output, 1)
        assert _ask(output, "GET", "/")[0] == 200  # the page itself says nothing
        for path in (
            "/api/live",
            "/api/map",
            "/api/image.jpg",
            "/api/floor_plan.png",
            "/api/surface",
            "/api/surface.png",
            "/api/recordings",
            "/api/recordings/r1/0",
            "/api/settings",
        ):
            assert _ask(output, "GET", path)[0] == 401, path
        assert _ask(output, "POST", "/api/command/reset", b"{}", COMMAND)[0] == 401
        assert _ask(output, "GET", f"/api/map?token={TOKEN}")[0] == 401  # never in an address
        assert _ask(output, "GET", "/api/map", None, {"Authorization": "Bearer wrong"})[0] == 401
        assert _ask(output, "GET", "/api/map", None, {"Authorization": f"Bearer {TOKEN}"})[0] == 200
        code, _, headers = _ask(output, "POST", "/login", json.dumps({"token": TOKEN}), COMMAND)
        cookie = headers["set-cookie"]
        assert code == 200 and TOKEN not in cookie and "HttpOnly" in cookie and "samesite=strict" in cookie.lower()
        assert _ask(output, "GET", "/api/map", None, {"Cookie": cookie.split(";")[0]})[0] == 200
        codes = [_ask(output, "POST", "/login", b'{"token": "x"}', COMMAND)[0] for _ in range(8)]
        assert codes[0] == 401 and codes[-1] == 429


def test_a_link_logs_in_once() -> None:
    with _serving(rules=Access(TOKEN)) as output:
        code = json.dumps({"token": Links(TOKEN).new()})
        answers = [_ask(output, "POST", "/login", code, COMMAND) for _ in range(2)]
        assert [answer[0] for answer in answers] == [200, 401]
        cookie = answers[0][2]["set-cookie"].split(";")[0]
        assert _ask(output, "GET", "/api/map", None, {"Cookie": cookie})[0] == 200
        unused = json.dumps({"token": Links(TOKEN).new()})
    with _serving(rules=Access(TOKEN)) as output:  # the page was started again
        answers = [_ask(output, "POST", "/login", sent, COMMAND)[0] for sent in (code, unused, unused)]
        assert answers == [401, 200, 401]


def test_a_port_that_is_taken_and_one_open_to_all_are_one_line() -> None:
    with _serving() as output, pytest.raises(StereoSfmError, match=f"cannot listen on 127.0.0.1:{output.port}"):
        PageOutput("127.0.0.1", output.port, 4.0).open(FakeService())
    with pytest.raises(StereoSfmError, match=r"others could connect to 0\.0\.0\.0"):
        server.make(RobotConfig(page=PageConfig(True, "0.0.0.0"), security=SecurityConfig(auth="none")))


def test_what_is_open_is_listed() -> None:
    assert ports(RobotConfig()) == ["nothing listens: no output and no page is enabled"]
    outputs = OutputsConfig(PoseSocketConfig(True, "tcp://0.0.0.0:7000"), FoxgloveConfig(True), Ros2Config(True))
    security = SecurityConfig(token_file="/etc/token", tls_cert="cert.pem")
    page, poses, foxglove, *dds = ports(RobotConfig(outputs=outputs, page=PageConfig(True), security=security))
    assert "http://127.0.0.1:8080  anyone on this computer with the token in /etc/token" in page
    assert "anyone who can reach 0.0.0.0 with the token in" in poses and "ws://127.0.0.1:8765" in foxglove
    assert "every network" in dds[0] and any("ROS_LOCALHOST_ONLY=1 hides it" in line for line in dds)
    file = next(line for line in dds if "FASTRTPS_DEFAULT_PROFILES_FILE" in line).partition("=")[2].partition(",")[0]
    assert (Path(__file__).parents[2] / file).is_file() and Path(file).is_absolute()
    assert ports(RobotConfig(page=PageConfig(True), security=SecurityConfig(auth="none")))[0].endswith("this computer")
    assert "https://0.0.0.0:8080" in ports(RobotConfig(page=PageConfig(True, "0.0.0.0"), security=security))[0]


def test_serve_prints_its_ports(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--print-ports"]) == 0
    assert capsys.readouterr().out == "nothing listens: no output and no page is enabled\n"
    assert main(["serve", "--pose-socket", "tcp://127.0.0.1:7001", "--set", "page.enabled=true", "--print-ports"]) == 0
    page, poses = capsys.readouterr().out.splitlines()
    assert "127.0.0.1:8080" in page and "tcp://127.0.0.1:7001  anyone on this computer with the token" in poses
    assert main(["serve", "--print-link"]) == 0
    assert "http://127.0.0.1:8080/#once-" in capsys.readouterr().out


def test_a_source_is_an_argument_of_serve(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "sim:loop?seed='3'", "--print-config"]) == 0
    assert "spec = \"sim:loop?seed='3'\"" in capsys.readouterr().out


def test_closing_does_not_wait_for_an_open_page() -> None:
    with _serving() as output:
        connection = http.client.HTTPConnection("127.0.0.1", output.port, timeout=10)
        connection.request("GET", "/api/live")
        connection.getresponse().readline()
        begin = time.monotonic()
        output.close()
        assert time.monotonic() - begin < 4.5
        connection.close()


def test_clients_that_went_away_leave_no_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    class Slow(FakeService):
        def call(self, name: str, timeout_s: float = 5.0, /, **arguments: Any) -> Reply:
            super().call(name, timeout_s, **arguments)
            ended.wait(5.0)
            return Reply(True)

    ended, service = threading.Event(), Slow()
    with _serving(service) as output:
        clients = [http.client.HTTPConnection("127.0.0.1", output.port, timeout=10) for _ in range(3)]
        clients[0].request("POST", "/api/command/save_map", b"{}", COMMAND)
        clients[1].request("POST", "/api/command/save_map", b"{}", COMMAND)
        clients[2].request("GET", "/api/live")
        clients[2].getresponse().readline()
        while len(service.calls) < 2:
            time.sleep(0.01)
        clients[0].close()
        begin = time.monotonic()
        output.close()
        assert time.monotonic() - begin < 4.5
        ended.set()
        assert json.loads(clients[1].getresponse().read())["text"] == "the service has ended"
        for client in clients:
            client.close()
    assert not capfd.readouterr().err
