"""Lines of the package's logger, from any process of a run, for the run's sinks: the log and the viewer."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Self

from stereo_sfm.messages import LogLine

LOGGER = "stereo_sfm"
_PASSED_ON = "stereo_sfm_stage"  # attribute of records that came from another process


class Listener(logging.Handler):
    """While entered, passes every line of the package's logger on as a `LogLine`."""

    def __init__(self, stage: str, put: Callable[[LogLine], None]) -> None:
        """Args: stage, whose process this is; put, takes the lines, from any thread."""
        super().__init__()
        self._stage, self._put = stage, put

    def emit(self, record: logging.LogRecord) -> None:
        if not hasattr(record, _PASSED_ON):
            self._put(LogLine(self._stage, record.levelname, record.getMessage()))

    def __enter__(self) -> Self:
        logging.getLogger(LOGGER).addHandler(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        logging.getLogger(LOGGER).removeHandler(self)


def emit(line: LogLine) -> None:
    """Log a line from another process at this process's level; listeners ignore it."""
    logger = logging.getLogger(LOGGER)
    level = logging.getLevelNamesMapping().get(line.level, logging.WARNING)
    if logger.isEnabledFor(level):
        record = logger.makeRecord(LOGGER, level, line.stage, 0, line.text, (), None, extra={_PASSED_ON: line.stage})
        logger.handle(record)
