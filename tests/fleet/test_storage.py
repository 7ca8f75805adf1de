"""Places in a bucket: what is written is read, and every failure is one line without a secret."""

from __future__ import annotations

import socket
import time
from datetime import datetime
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.recording.segments import Segment, new_recording
from stereo_sfm.recording.upload import Uploader
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUMS, Pace, fetch, send_file, send_folder, sha256, sum_of
from stereo_sfm.storage.objects import Missing, Unreachable
from stereo_sfm.storage.remote import Remote, place
from stereo_sfm.storage.stream import PAGE, RangeStream
from tests.fleet.s3_server import READER, Server
from tests.fleet.writers import winners
from tests.maps.maps import small_map


@pytest.mark.parametrize(
    ("uri", "text"),
    [
        ("s4://bucket/x", "unknown scheme 's4://'"),
        ("http://host/x", "unknown scheme 'http://'"),
        ("s3://", "names no bucket"),
        ("s3://key:secret@bucket/x", "no credentials in an address"),
        ("file://host/x", "begins with three slashes"),
        ("s3://my bucket/x", "no name of a bucket"),
        ("s3://bucket/a//b", "an empty name or dots"),
        ("s3://bucket/a/../b", "an empty name or dots"),
    ],
)
def test_a_wrong_address_is_one_line(uri: str, text: str) -> None:
    with pytest.raises(StereoSfmError, match=text) as error:
        place(uri)
    assert "secret" not in str(error.value) and "\n" not in str(error.value)


def test_a_path_stays_a_path() -> None:
    assert place("a/b") == Path("a/b") and place("file:///a%20b/c") == Path("/a b/c")
    assert str(Remote.of("s3://bucket/a/") / "b") == "s3://bucket/a/b"


def test_failures_are_one_line(place: str, s3: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Missing, match="there is no s3://"):
        objects.read(Remote.of(place) / "nothing")
    with pytest.raises(StereoSfmError, match="there is no bucket s3://absent"):
        objects.listed(Remote.of("s3://absent/x"))
    objects.write(Remote.of(place) / "x", b"1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", READER)
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
    assert objects.read(Remote.of(place) / "x") == b"1"
    with pytest.raises(StereoSfmError, match="no right to write") as error:
        objects.write(Remote.of(place) / "x", b"2")
    assert "the-secret" not in str(error.value) and READER not in str(error.value)


@pytest.mark.parametrize("name", ["401", "507", "credential"])
def test_the_name_of_an_object_says_nothing_about_its_server(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for key, value in (("ENDPOINT_URL", "http://127.0.0.1:9"), ("ACCESS_KEY_ID", "a"), ("SECRET_ACCESS_KEY", "b")):
        monkeypatch.setenv(f"AWS_{key}", value)
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
    with objects.patience(1.0), pytest.raises(Unreachable, match="no answer"):
        objects.read(Remote.of(f"s3://bucket/{name}"))
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]


def test_a_server_that_never_answers_costs_the_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes the connection, and holds it."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        for key, value in (("ENDPOINT_URL", url), ("ACCESS_KEY_ID", "a"), ("SECRET_ACCESS_KEY", "b")):
            monkeypatch.setenv(f"AWS_{key}", value)
        objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
        begin = time.monotonic()
        with objects.patience(1.0), pytest.raises(Unreachable, match="no answer"):
            objects.read(Remote.of("s3://bucket/x"))
        assert time.monotonic() - begin < 20.0
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]


@pytest.mark.parametrize("name", ["a//x.mcap", "a/%2E%2E/x.mcap"])
def test_a_name_of_another_program_is_named(name: str, place: str, s3: Server) -> None:
    s3.request("PUT", f"/{Remote.of(place).bucket}/{Remote.of(place).key}/{name}")
    with pytest.raises(StereoSfmError, match="give it another name") as error:
        objects.listed(Remote.of(place))
    assert f"{Remote.of(place).key}/{name.replace('%2E', '.')}" in str(error.value)
    assert not isinstance(error.value, Unreachable)


def test_what_is_stopped_is_no_failure_of_the_network(place: str, tmp_path: Path) -> None:
    segment = Segment.of(new_recording(tmp_path, "sim:aisle", "full", datetime(2026, 11, 25, 22)), 0, 0)
    segment.poses.write_bytes(bytes(10_000_000))
    with pytest.raises(InterruptedError):
        send_file(segment.poses, Remote.of(place) / "x", Pace(1e6), lambda: True)
    assert not objects.exists(Remote.of(place) / "x")
    uploader = Uploader(tmp_path, Remote.of(place), 1e6)
    uploader.start()
    time.sleep(0.5)
    uploader.close()
    assert uploader.problem == "" and not objects.exists(Remote.of(place) / segment.folder.name / segment.poses.name)


def test_missing_credentials_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(StereoSfmError, match=r"no credentials for az://: .*AZURE_STORAGE_ACCOUNT_NAME"):
        objects.read(Remote.of("az://bucket/x"))
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", "/nowhere.json")
    with pytest.raises(StereoSfmError, match="no credentials for gs://"):
        objects.read(Remote.of("gs://bucket/x"))


def test_one_of_many_writers_wins(place: str) -> None:
    """Ten exchange the same object at the same time, four times."""
    target, tag = Remote.of(place) / "head", None
    for turn in range(4):
        won = winners(target, turn, tag, 10)
        raw, tag = objects.read_tagged(target)
        assert len(won) == 1 and raw == f"{turn} {won[0]}".encode()


def test_an_exchange_whose_answer_is_lost_has_happened(place: str, s3: Server) -> None:
    """The server carries half of the failing requests out: the second try finds the first one's object."""
    target, tag = Remote.of(place) / "head", None
    s3.faults(0.4)
    for k in range(12):
        objects.exchange(target, f"{k}".encode(), tag)
        raw, tag = objects.read_tagged(target)
        assert raw == f"{k}".encode()


def test_a_stream_reads_what_is_asked_for(place: str) -> None:
    data = bytes(k * 7 % 251 for k in range(5 * PAGE + 3))
    objects.write(Remote.of(place) / "x", data)
    with RangeStream(Remote.of(place) / "x") as stream:
        for offset, size in ((3 * PAGE - 5, 10), (0, 3), (len(data) - 4, 100), (PAGE, 2 * PAGE)):
            stream.seek(offset)
            assert stream.read(size) == data[offset : offset + size]
        stream.seek(-4, 2)
        assert stream.read() == data[-4:]
        stream.seek(0)
        assert stream.read() == data and stream.received <= len(data) + 4 * PAGE
        assert stream.ranges([(1, 2), (PAGE, 3)]) == [data[1:3], data[PAGE : PAGE + 3]]


def test_a_folder_comes_back_and_is_sent_once(place: str, tmp_path: Path) -> None:
    folder, target = tmp_path / "f", Remote.of(place) / "f"
    (folder / "sub").mkdir(parents=True)
    (folder / "a").write_bytes(b"1" * 1000)
    (folder / "sub" / "b").write_bytes(b"2")
    assert send_folder(folder, target) == 1001 and send_folder(folder, target) == 0
    (folder / "a").write_bytes(b"3" * 1000)
    assert send_folder(folder, target) == 1000
    here = fetch(target)
    assert (here / "a").read_bytes() == b"3" * 1000 and (here / "sub" / "b").read_bytes() == b"2"
    assert fetch(target) == here


@pytest.mark.parametrize("name", ["../../out", "/out", "a//out", "a/../../out"])
def test_nothing_is_written_outside_of_the_cache(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """S3 takes such names, and gives them back."""
    monkeypatch.setenv("STEREO_SFM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(objects, "size_and_tag", lambda remote: (_ for _ in ()).throw(Missing("a folder")))
    monkeypatch.setattr(objects, "listed", lambda remote: [("a", 1, "1"), (name, 1, "1")])
    with pytest.raises(StereoSfmError, match="is no file in a folder"):
        fetch(Remote.of("s3://bucket/folder"))
    assert not list(tmp_path.rglob("out"))


def test_a_truncated_upload_is_found(place: str, tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "a").write_bytes(b"1" * 1000)
    target = Remote.of(place) / "f"
    send_folder(tmp_path / "f", target)
    objects.write(target / "a", b"1" * 500)
    with pytest.raises(StereoSfmError, match="a is not what was sent"):
        fetch(target)
    assert not [*(tmp_path / "cache").rglob("a")]
    assert SUMS in [name for name, _, _ in objects.listed(target)]


def test_a_folder_sent_again_mends_a_truncated_upload(place: str, tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    for name in ("a", "b", "c"):
        (tmp_path / "f" / name).write_bytes(name.encode() * 1000)
    target = Remote.of(place) / "f"
    send_folder(tmp_path / "f", target)
    objects.write(target / "a", b"a" * 500)
    objects.delete([target / "b"])
    assert send_folder(tmp_path / "f", target) == 2000 and send_folder(tmp_path / "f", target) == 0
    assert (fetch(target) / "a").read_bytes() == b"a" * 1000


def test_a_single_file_is_checked_as_well(place: str, tmp_path: Path) -> None:
    (tmp_path / "here.mcap").write_bytes(b"1" * 1000)
    target = Remote.of(place) / "there.mcap"
    assert main(["fleet", "upload", str(tmp_path / "here.mcap"), str(target)]) == 0
    assert objects.read(sum_of(target)).endswith(b"  there.mcap\n")  # the name that `sha256sum -c` finds
    assert fetch(target).read_bytes() == b"1" * 1000
    for damaged in (b"1" * 500, b"2" * 1000):
        objects.write(target, damaged)
        with pytest.raises(StereoSfmError, match=r"there\.mcap is not what was sent"):
            fetch(target)
    objects.delete([sum_of(target)])  # of another program
    assert fetch(target).read_bytes() == b"2" * 1000
    right = sha256(fetch(target)).upper()
    for text in (right, f"SHA256 (there.mcap) = {right}", "no checksum"):  # as other programs write it
        objects.write(sum_of(target), f"{text}\n".encode())
        assert fetch(target).read_bytes() == b"2" * 1000


def test_a_pace_is_kept(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"0" * 30_000)
    begin = time.monotonic()
    assert sum(len(piece) for piece in Pace(100_000).pieces(tmp_path / "x")) == 30_000
    assert time.monotonic() - begin > 0.15


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", "s5://b/x.mcap"],
        ["run", "s3://absent/x.mcap", "--inline"],
        ["map", "versions", "s3://absent/store"],
        ["batch", "sim:aisle", "-o", "s3://absent/runs"],
        ["map", "merge", "s3://absent/a", "s3://absent/b", "-o", "out"],
        ["record", "sim:aisle?size=96x80&frames=2", "-o", "s3://absent/x.mcap", "-q"],
    ],
)
def test_commands_say_it_in_one_line(arguments: list[str], s3: Server, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == StereoSfmError.exit_code
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_what_is_read_may_be_in_a_bucket(
    place: str, s3: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STEREO_SFM_CACHE", str(tmp_path / "cache"))
    save_map(small_map()[1], tmp_path / "map")
    assert main(["map", "info", str(tmp_path / "map")]) == 0
    said = capsys.readouterr().out
    send_folder(tmp_path / "map", Remote.of(place) / "map")
    assert main(["map", "info", f"{place}/map"]) == 0
    assert capsys.readouterr().out.replace(str(tmp_path / "cache"), "").count("keyframes") == said.count("keyframes")
    assert main(["export", f"{place}/map", "--format", "ply", "-o", str(tmp_path / "points.ply")]) == 0
    assert (tmp_path / "points.ply").stat().st_size > 1000


def test_a_run_that_fails_is_in_the_bucket_and_not_replaced(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from stereo_sfm.commands import _execute

    def unplugged(options: _execute.RunOptions) -> tuple[int, Path]:
        assert options.output is not None
        options.output.mkdir()
        (options.output / "run.mcap").write_bytes(b"what was seen")
        raise StereoSfmError("the camera was unplugged")

    monkeypatch.setattr(_execute, "execute", unplugged)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    command = ["run", "sim:loop", "-o", f"{place}/walk"]
    objects.write(Remote.of(place) / "walk" / "stats.json", b"of an earlier run")
    assert main(command) == 2 and "exists: choose another -o" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 2 and "unplugged" in capsys.readouterr().err
    assert [name for name, _, _ in objects.listed(Remote.of(place) / "walk")] == [SUMS, "run.mcap"]
    assert not [*tmp_path.iterdir()]

    def unreachable(*args: object) -> int:
        raise Unreachable("no network")

    monkeypatch.setattr("stereo_sfm.storage.folders.send_folder", unreachable)
    assert main([*command, "--overwrite"]) == 2
    kept = Path(capsys.readouterr().err.strip().rpartition(" ")[2])
    assert (kept / "run.mcap").read_bytes() == b"what was seen"


def test_no_right_to_write_is_one_line(
    place: str, s3: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(small_map()[1], tmp_path / "map")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", READER)
    objects._store.cache_clear()  # pyright: ignore[reportPrivateUsage]
    for arguments in (
        ["map", "update", f"{place}/store", str(tmp_path / "map")],
        ["record", "sim:aisle?size=96x80&frames=2", "-o", f"{place}/x.mcap", "-q"],
        ["fleet", "upload", str(tmp_path / "map"), f"{place}/map"],
    ):
        assert main(arguments) == StereoSfmError.exit_code
        said = capsys.readouterr().err.strip()
        assert len(said.splitlines()) == 1 and "no right to write s3://" in said and READER not in said
