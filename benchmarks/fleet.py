"""A fleet's nights with everything that goes wrong: workers killed, the storage away, uploads cut off and sent twice.

    python benchmarks/fleet.py                                    200 stores, 3 nights: half an hour on two cores
    python benchmarks/fleet.py --stores 5 --kills 3 --pause 2     a look
    python benchmarks/fleet.py --parts info delta                 only these
    python benchmarks/fleet.py --keep rows.json                   goes on with the next part after a break

An S3 server (moto's, with conditional puts that are atomic) answers a tenth of all requests with 503, half of these
after it has carried them out, and is stopped for 20 s. A Ray cluster of three nodes on this computer loses workers at
random moments, and the driver is killed and started again each night. Each store gets the map of a session from a robot
each night. The first store's robot is offline for all nights and sends everything at the end; the second one's sends
everything twice; an upload of the third one is cut off and sent again; a version of the last one is rolled back,
then comes one more night. For each sentence it prints whether it holds.
"""

from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from _fleet_costs import delta, info, overhead
from _fleet_faults import nights, two_writers
from _verdicts import Verdicts

from tests.fleet.s3_server import server

PARTS = ("writers", "nights", "overhead", "info", "delta")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--stores", type=int, default=200, help="at least 3")
    parser.add_argument("--nights", type=int, default=3)
    parser.add_argument("--kills", type=int, default=30, help="workers killed")
    parser.add_argument("--pause", type=float, default=15.0, help="mean seconds between two kills")
    parser.add_argument("--megabytes", type=int, default=10_000, help="on the disk, of the recording for info")
    parser.add_argument("--keep", type=Path, help="file of the rows of parts that ended")
    parser.add_argument("--write", action="store_true", help="replace the benchmark's figures")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    verdicts = Verdicts(options.keep)
    print("| what must hold | measured | |\n|---|---|---|")
    with server() as s3, tempfile.TemporaryDirectory() as name:
        place = Path(name)
        os.environ |= {**s3.environment(), "STEREO_SFM_CACHE": str(place / "cache")}
        os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        for part in options.parts:
            if not verdicts.begins(part):
                continue
            if part == "writers":
                two_writers(verdicts, place)
            elif part == "overhead":
                overhead(verdicts, s3, place)
            elif part == "info":
                info(verdicts, place, options.megabytes)
            elif part == "delta":
                delta(verdicts, place)
            else:
                nights(verdicts, s3, place, options.stores, options.nights, options.kills, options.pause, options.seed)
            verdicts.keep()
    if options.write:
        print(verdicts.write(PARTS, "fleet", "Nights of a fleet with faults"), file=sys.stderr)
    sys.exit(verdicts.failed)


if __name__ == "__main__":
    main()
