"""`stereo-sfm devices`: list the attached cameras."""

from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--probe", action="store_true", help="start cameras whose calibration cannot be read otherwise (takes seconds)"
    )


def run(args: argparse.Namespace) -> int:
    """List them; 0 also when there are none."""
    from stereo_sfm.drivers.devices import list_devices, no_cameras

    cameras, problems = list_devices(probe=args.probe)
    if args.json:
        import dataclasses
        import json

        print(json.dumps({"devices": [dataclasses.asdict(c) for c in cameras], "problems": problems}, indent=2))
        return 0
    if cameras:
        yes_no = {True: "yes", False: "NO", None: "?"}
        rows = [("id", "driver", "serial", "usb", "firmware", "calibrated", "note")]
        rows += [
            (c.id, c.driver, c.serial or "?", c.usb_speed or "?", c.firmware or "?", yes_no[c.calibrated], c.note)
            for c in cameras
        ]
        widths = [max(len(r[k]) for r in rows) for k in range(7)]
        print("\n".join("  ".join(v.ljust(w) for v, w in zip(r, widths, strict=True)).rstrip() for r in rows))
    else:
        print(no_cameras())
    for problem in problems:
        print(problem)
    return 0
