"""Text of the stages and counters of a camera in the log, the sinks and the viewer, inline and with processes."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

import pytest

from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.statistics import statistics, summary
from stereo_sfm.log import topics
from stereo_sfm.log.provenance import TOTALS
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import messages
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.messages import LogLine, SourceCounters
from stereo_sfm.pipeline import child
from stereo_sfm.pipeline.channels import End, Outbox
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.types import StereoImage
from tests.pipeline.test_pipeline import CONFIG, SlidingWall

logger = logging.getLogger("stereo_sfm")


@pytest.fixture(autouse=True)
def fresh_logger(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a library has it: the command line leaves its own settings behind."""
    monkeypatch.setattr(logger, "propagate", True)
    monkeypatch.setattr(logger, "handlers", [])
    monkeypatch.setattr(logger, "level", logging.NOTSET)
    logger.manager._clear_cache()  # type: ignore[attr-defined]


class TroubledWall(SlidingWall):
    """Warns and counts as a camera does."""

    def __iter__(self) -> Iterator[StereoImage]:
        self.counters = {"pairs": 0.0, "stalls": 0.0, "temperature_c": 41.5}
        for image in super().__iter__():
            self.counters["pairs"] += 1
            if image.frame_id == 7:
                self.counters["stalls"] += 1
                logger.warning("wall sent no image for %d ms", 500)
                logger.info("wall is back")
            yield image


class TalkativeWall(SlidingWall):
    """Says something while it is opened, as a camera that boots does."""

    def __enter__(self) -> Self:
        logger.info("the wall boots")
        return super().__enter__()


class Kept:
    """A sink that collects messages."""

    def __init__(self) -> None:
        self.lines: list[LogLine] = []
        self.counters: list[SourceCounters] = []

    def put(self, message: object) -> None:
        if isinstance(message, LogLine):
            self.lines.append(message)
        elif isinstance(message, SourceCounters):
            self.counters.append(message)


def between_processes(path: Path, sinks: list[Any]) -> None:
    opener = MadeSource.of(TroubledWall, 12)
    with ProcessRun(opener, CONFIG, sinks, log=LogOptions(path, "none")) as run:
        assert len(list(run)) == 12


def inline(path: Path, sinks: list[Any]) -> None:
    source = TroubledWall(12)
    log = RunLog(LogWriter(path), source.rig, CONFIG, source="wall", mode="inline", image_format="none")
    assert len(list(run_inline(source, CONFIG, [*sinks, log]))) == 12
    log.close()


@pytest.mark.parametrize(("run", "stage"), [(between_processes, "capture"), (inline, "main")])
def test_warnings_and_counters_reach_the_log_and_the_sinks(
    run: Callable[[Path, list[Any]], None], stage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    kept, record = Kept(), RunRecord()
    run(tmp_path / "run.mcap", [kept, record])
    counts = {"pairs": 12.0, "stalls": 1.0, "temperature_c": 41.5}
    assert kept.lines[0] == LogLine(stage, "WARNING", "wall sent no image for 500 ms")
    assert kept.counters[-1] == SourceCounters(11, counts)
    with LogReader(tmp_path / "run.mcap") as reader:
        texts = [(m.name, m.message) for _, m in messages(reader, [topics.LOG])]
        logged = [m for _, m in messages(reader, [topics.COUNTERS])]
        totals = reader.metadata(TOTALS)
    assert texts == [(line.stage, line.text) for line in kept.lines]
    assert texts.count((stage, "wall sent no image for 500 ms")) == 1
    assert logged[-1].counts == counts
    assert (totals["pairs"], totals["stalls"], totals["frames"]) == ("12", "1", "12")
    message = [r for r in caplog.records if r.getMessage() == "wall sent no image for 500 ms"]
    assert [r.levelname for r in message] == ["WARNING"]  # once on the screen too, wherever it was said
    if stage == "capture":  # a stage tells everything, main shows what it is set to show
        assert LogLine(stage, "INFO", "wall is back") in kept.lines
        assert "wall is back" not in caplog.text

    stats = statistics(record, 1.0)
    assert stats["camera"] == counts
    assert "camera: 12 stereo images, stalls 1" in summary(stats)


def test_text_of_a_source_while_it_opens_is_kept(tmp_path: Path) -> None:
    kept = Kept()
    with ProcessRun(
        MadeSource.of(TalkativeWall, 5), CONFIG, [kept], log=LogOptions(tmp_path / "run.mcap", "none")
    ) as run:
        assert len(list(run)) == 5
    assert kept.lines[0] == LogLine("capture", "INFO", "the wall boots")
    with LogReader(tmp_path / "run.mcap") as reader:
        assert "the wall boots" in [m.message for _, m in messages(reader, [topics.LOG])]


def _warn(to_main: Outbox) -> None:
    logger.warning("%s is tired", "somebody")


@pytest.mark.parametrize("stage", ["tracker", "mapper", "loop", "logger"])
def test_every_worker_forwards_its_text(stage: str) -> None:
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=child.guarded, args=(stage, _warn, send))
    process.start()
    send.close()
    message = _all(receive)
    process.join()
    assert message == [LogLine(stage, "WARNING", "somebody is tired"), End(stage)]


def _all(receive: Connection) -> list[object]:
    out: list[object] = []
    try:
        while True:
            out.append(receive.recv())
    except EOFError:
        return out


def test_files_have_no_counters_in_the_summary() -> None:
    record = RunRecord()
    for _ in run_inline(SlidingWall(3), CONFIG, [record]):
        pass
    stats = statistics(record, 1.0)
    assert stats["camera"] == {}
    assert not any(line.startswith("camera:") for line in summary(stats))
