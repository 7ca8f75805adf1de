"""The tables of `benchmarks real`: mean, standard error and worst over the starts, verdicts, paired comparisons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from _real_sequences import Limits
from _real_sequences import Sequence as RealSequence

from stereo_sfm.types import F64

Run = dict[str, Any]
CLEARLY, SIGMAS = (
    0.05,
    2.0,
)  # a switch beats default by more than this share and so many standard errors (of two starts or more)
CLEARLY_LOST = 0.01  # further lost frames, as a share of all, from which a switch is worse
STEPS_FOUND = 0.9  # share that must be
BETTER = "BETTER THAN DEFAULT"

HEADING = (
    "| sequence | off | starts | ATE SE(3) mean ± se | worst | ATE Sim(3) | scale | odometry | lost mean (worst) "
    "| losses | corrections | steps | loops | processor s | verdict | paired: default − this |",
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
)


def markdown(sequences: Sequence[RealSequence], codes: Sequence[str], labels: Sequence[str], runs: list[Run]) -> str:
    """The whole report."""
    lines: list[str] = []
    for key, label in zip(codes, labels, strict=True):
        lines += [f"## {label}", "", *HEADING]
        for sequence in sequences:
            lines += _rows(sequence, [r for r in runs if r["code"] == key])
        lines += ["", *_steps([r for r in runs if r["code"] == key and "injected_s" in r]), ""]
    if len(codes) == 2:
        lines += _against(sequences, codes, labels, runs)
    return "\n".join(lines)


def _steps(runs: list[Run]) -> list[str]:
    """Which steps that were put into sequences were found, how late, and how many others were reported."""
    if not runs:
        return []
    names = list(dict.fromkeys(r["switch"] for r in runs))
    heading = "| steps found (others reported), s later | "
    lines = [heading + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for sequence in dict.fromkeys(r["sequence"] for r in runs):
        cells = [_found(_of(runs, sequence, name)) for name in names]
        lines.append(f"| {sequence} | " + " | ".join(cells) + " |")
    share = len(values(runs, "found_after_s")) / len(runs)
    return [
        *lines,
        "",
        f"{'yes' if share >= STEPS_FOUND else '**NO**'}: {100 * share:.0f} % of {len(runs)} steps found",
    ]


def _found(runs: list[Run]) -> str:
    late = values(runs, "found_after_s")
    others = sum(int(r.get("steps", 0)) for r in runs) - len(late)
    return f"{len(late)}/{len(runs)} ({others})" + (f", {np.mean(late):.1f}" if late else "")


def _of(runs: list[Run], sequence: str, switch: str) -> list[Run]:
    return [r for r in runs if r["sequence"] == sequence and r["switch"] == switch]


def _rows(sequence: RealSequence, runs: list[Run]) -> list[str]:
    """A row for each switch."""
    own = [r for r in runs if r["sequence"] == sequence.name]
    switches = list(dict.fromkeys(r["switch"] for r in own if "injected_s" not in r))
    default = _of(own, sequence.name, "default")
    rows: list[str] = []
    for switch in switches:
        some = _of(own, sequence.name, switch)
        verdict = verdict_of(sequence, some, switch, runs)
        paired = "" if switch == "default" or not default else comparison(default, some)
        rows.append(_row(sequence, switch, some, verdict, paired))
    if sequence.best_cpp:
        rows.append(f"| {sequence.name} | best C++ | | {sequence.best_cpp} " + "| " * 12 + "|")
    return rows


def _row(sequence: RealSequence, switch: str, runs: list[Run], verdict: str, paired: str) -> str:
    if all(r.get("absent") for r in runs):
        return f"| {sequence.name} | {switch} | | not in this version " + "| " * 12 + "|"
    errors = sorted({r["error"] for r in runs if r["error"]})
    return (
        f"| {sequence.name} | {switch} | {len(runs)} | {_mean(runs, 'ate_m', _metres)} | {_worst(runs, 'ate_m')} "
        f"| {_mean(runs, 'ate_sim3_m', _metres)} | {_mean(runs, 'scale', '{:.4f}'.format)} "
        f"| {_mean(runs, 'odometry_m', _metres)} | {_lost(runs)} | {_mean(runs, 'losses', '{:.1f}'.format, False)} "
        f"| {_mean(runs, 'corrections', '{:.1f}'.format, False)} | {_mean(runs, 'steps', '{:.1f}'.format, False)} "
        f"| {_mean(runs, 'loops', '{:.1f}'.format, False)} | {_mean(runs, 'processor_s', '{:.0f}'.format, False)} "
        f"| {verdict}{'; ' + '; '.join(errors)[:160] if errors else ''} | {paired} |"
    )


def values(runs: list[Run], name: str) -> list[float]:
    """Of the runs that have it."""
    return [float(r[name]) for r in runs if r.get(name) is not None]


def standard_error(found: Sequence[float]) -> float:
    """Of the mean; NaN of fewer than two."""
    return float(np.std(found, ddof=1) / np.sqrt(len(found))) if len(found) > 1 else float("nan")


def _metres(value: float) -> str:
    return f"{value:.3f} m" if value >= 0.5 else f"{1e3 * value:.2f} mm"


def _mean(runs: list[Run], name: str, text: Callable[[float], str], spread: bool = True) -> str:
    found = values(runs, name)
    if not found:
        return "–"
    error = f" ± {text(standard_error(found))}" if spread and len(found) > 1 else ""
    missing = f" ({len(found)} of {len(runs)})" if len(found) < len(runs) else ""
    return text(float(np.mean(found))) + error + missing


def _worst(runs: list[Run], name: str) -> str:
    found = values(runs, name)
    return _metres(max(found)) if found else "–"


def _lost(runs: list[Run]) -> str:
    found = values(runs, "lost")
    return f"{np.mean(found):.1f} ({max(found):.0f}) of {max(values(runs, 'frames')):.0f}" if found else "–"


def verdict_of(sequence: RealSequence, runs: list[Run], switch: str, all_runs: list[Run]) -> str:
    """Which limits hold, in how many of the starts."""
    limits = sequence.limits
    if switch == "self-calibration" and limits.uncalibrated_ate_m is not None:
        limits = Limits(ate_m=limits.uncalibrated_ate_m)
    elif switch != "default":
        return ""
    said: list[str] = []
    for name, holds in _checks(sequence, limits, all_runs):
        count = sum(holds(r) for r in runs)
        said.append(f"{'yes' if count == len(runs) else '**NO**'} {name} {count}/{len(runs)}")
    if limits.median_ate_m is not None:
        found = [r["ate_m"] if r.get("ate_m") is not None else np.inf for r in runs]
        middle = float(np.median(found))
        said.append(f"{'yes' if middle <= limits.median_ate_m else '**NO**'} median {_metres(middle)}")
    if limits.lost_share is not None:
        share = sum(values(runs, "lost")) / max(sum(values(runs, "frames")), 1.0)
        said.append(f"{'yes' if share <= limits.lost_share else '**NO**'} lost {100 * share:.1f} %")
    return ", ".join(said)


def _checks(sequence: RealSequence, limits: Limits, runs: list[Run]) -> list[tuple[str, Callable[[Run], bool]]]:
    """Name and test of what must hold of each start."""

    def at_most(name: str, most: float) -> Callable[[Run], bool]:
        return lambda r: r.get(name) is not None and abs(r[name]) <= most

    checks: list[tuple[str, Callable[[Run], bool]]] = [("runs", lambda r: not r["error"])]
    if limits.ate_m is not None:
        checks.append((f"≤ {_metres(limits.ate_m)}", at_most("ate_m", limits.ate_m)))
    if limits.lost is not None:
        checks.append((f"lost ≤ {limits.lost}", at_most("lost", limits.lost)))
    if limits.angle_error_deg is not None:
        checks.append(
            (f"angle within {limits.angle_error_deg} deg", at_most("angle_error_deg", limits.angle_error_deg))
        )
    if limits.loops:
        checks.append((f"loops ≥ {limits.loops}", lambda r: r.get("loops", 0) >= limits.loops))
    if limits.like is not None:
        other, factor = limits.like
        theirs = {r["begin_s"]: r.get("ate_m") for r in _of(runs, other, "default")}
        checks.append((
            f"≤ {factor} × {other}",
            lambda r: None not in (r.get("ate_m"), m := theirs.get(r["begin_s"])) and r["ate_m"] <= factor * (m or 0.0),
        ))  # fmt: skip
    if limits.moves_more:
        checks.append(
            ("better than standing still", lambda r: r.get("ate_m") is not None and r["ate_m"] < r["still_m"])
        )
    return [*checks, ("no step", lambda r: r.get("steps", 0) <= limits.steps)]


def error_of(run: Run) -> float | None:
    """The error by which runs are compared: ATE, else that of the angle; without a pose that of a camera at rest."""
    if run.get("ate_m") is not None:
        return float(run["ate_m"])
    if run.get("angle_error_deg") is not None:
        return abs(float(run["angle_error_deg"]))
    return run.get("still_m")


def comparison(default: list[Run], other: list[Run]) -> str:
    """Mean paired difference of errors and of lost frames; bold where the other is clearly better."""
    theirs = {r["begin_s"]: r for r in other if not r.get("absent")}
    pairs = [(r, theirs[r["begin_s"]]) for r in default if r["begin_s"] in theirs]
    said: list[str] = []
    both = [(a, b) for r, t in pairs if (a := error_of(r)) is not None and (b := error_of(t)) is not None]
    if both:
        said.append(_errors_paired(np.array(both)))
    lost = [(r["lost"], t["lost"]) for r, t in pairs if "lost" in r and "lost" in t]
    if any(a != b for a, b in lost):
        said.append(_lost_paired(np.array(lost, float), max(values(default, "frames"))))
    return ", ".join(said)


def _errors_paired(pairs: F64) -> str:
    """(N, 2) errors of the first and the second."""
    mean, difference, error = float(pairs[:, 0].mean()), *_difference(pairs)
    better = difference > CLEARLY * mean and difference > SIGMAS * error
    text = f"error {100 * difference / max(mean, 1e-12):+.0f} ± {100 * error / max(mean, 1e-12):.0f} %"
    return f"**{text}: {BETTER}**" if better else text


def _lost_paired(pairs: F64, frames: float) -> str:
    """(N, 2) lost frames of the first and the second."""
    difference, error = _difference(pairs)
    better = difference > CLEARLY_LOST * frames and difference > SIGMAS * error
    text = f"lost {difference:+.1f} ± {error:.1f} frames"
    return f"**{text}: {BETTER}**" if better else text


def _difference(pairs: F64) -> tuple[float, float]:
    """Mean and standard error of the paired differences."""
    found = (pairs[:, 0] - pairs[:, 1]).tolist()
    return float(np.mean(found)), standard_error(found)


def _against(
    sequences: Sequence[RealSequence], codes: Sequence[str], labels: Sequence[str], runs: list[Run]
) -> list[str]:
    """Paired differences of two versions, per sequence and switch."""
    lines = [
        f"## {labels[0]} against {labels[1]}: new − old, as a share of new",
        "",
        "| sequence | off | paired |",
        "|---|---|---|",
    ]
    for sequence in sequences:
        for switch in dict.fromkeys(r["switch"] for r in runs if r["sequence"] == sequence.name):
            new, old = (_of([r for r in runs if r["code"] == key], sequence.name, switch) for key in codes)
            if new and old:
                said = comparison(new, old).replace(BETTER, "WORSE THAN BEFORE")
                lines.append(f"| {sequence.name} | {switch} | {said} |")
    return lines
