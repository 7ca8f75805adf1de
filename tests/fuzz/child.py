"""Runs commands one after the other in a process of bounded memory and reports their results.

Reads one JSON list of arguments a line, writes one JSON object a line. "frames PATH" reads every frame of a source,
"recordings PATH" lists the recordings of a service, "earlier PATH" reads the result of a batch of "a.mcap".
"""

from __future__ import annotations

import contextlib
import io
import json
import resource
import sys
import time
import traceback
from pathlib import Path
from typing import Any

HEADROOM = 1 << 30  # bytes of address space beyond what the program needs when it is loaded


def frames(path: str) -> int:
    """Read a whole source as a command would."""
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.errors import StereoSfmError

    try:
        with open_source(path) as source:
            for _ in source:
                pass
    except StereoSfmError as error:
        print(f"stereo-sfm frames: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def recordings(path: str) -> int:
    """List recordings as the page of a service does."""
    from stereo_sfm.recording.segments import listed, recordings, segments

    for folder in recordings(Path(path)):
        json.dumps(listed(folder))
        assert all(isinstance(part.unsent() == [] and part.marked_by_hand, bool) for part in segments(folder))
    return 0


def earlier(path: str) -> int:
    """Make a row of an earlier result as a batch does that goes on."""
    from stereo_sfm.config import Config
    from stereo_sfm.eval.batch import BatchTask, finished, table_row, write_results

    result = finished(BatchTask("a.mcap", path, Config(), False))
    if result is not None:
        write_results([table_row("a", result)], Path(path))
    return 0


OWN = {"frames": frames, "recordings": recordings, "earlier": earlier}


def outcome(argv: list[str]) -> dict[str, Any]:
    """Exit code (None after an exception that no command should raise), standard error, processor seconds."""
    from stereo_sfm.cli import main

    code, trace = None, ""
    message, began = io.StringIO(), time.process_time()
    with contextlib.redirect_stderr(message), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = OWN[argv[0]](argv[1]) if argv[0] in OWN else main(argv)
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException:  # whatever it is, it is what the test looks for
            trace = traceback.format_exc()
    return {"code": code, "message": message.getvalue(), "trace": trace, "seconds": time.process_time() - began}


def _kilobytes(field: str) -> int:
    """Of memory. `getrusage` would give the peak of the process that started this one, if that was more."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(field))


def _limit() -> None:
    used = _kilobytes("VmSize") << 10
    resource.setrlimit(resource.RLIMIT_AS, (used + HEADROOM, used + HEADROOM))


if __name__ == "__main__":
    outcome(json.loads(sys.argv[1]))  # loads the libraries
    _limit()
    for line in sys.stdin:
        result = outcome(json.loads(line))
        print(json.dumps({**result, "peak_mb": _kilobytes("VmHWM") >> 10}), flush=True)
