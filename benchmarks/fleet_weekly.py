"""The real command, run weekly: nine simulated weeks of sites that stand still, drift or step.

Each site is a pair of LiDARs, recorded and calibrated once by ``retropole calibrate``. A week later
and every week from then on it is recorded again, the files are written, and ``retropole fleet
check`` is run on a list of that site into its history: with the time of the recording in the list,
and of every other site as the time of the files. Each command is a process of its own. What it
says and its exit code are read from it.

Movements begin when the site is calibrated, steps between the third and the fourth check; all are
of the source, in a direction drawn at random. A lorry, 12 m long and 3.5 m high, stands for one
week, the fifth: beside the poles, 1.5 m behind the farthest from the target; or in view, 5 m in
front of the source, where it hides a part of what both LiDARs see. Of sites marked *by the scene*
the poles are taken away after the calibration.

Nothing was set on these sites. Where an arrangement is refused by the calibration another one is
drawn, and that is said.

    python benchmarks/fleet_weekly.py --first 8000
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from retropole.simulation import NOISE_MODELS, SimulatedPair, simulate_pair
from retropole.simulation.raycast import Box, Material
from retropole.simulation.writing import write_pair

# Tests import this module from the root of the clone.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.again import record_again

WEEKS = 9
STEP_WEEK, LORRY_WEEK = 4, 5
START = datetime(2026, 1, 5, 2, tzinfo=UTC)
LORRY = np.array([6.0, 1.25, 1.75])
"""Half of its sides, metres."""

MOST_DRAWS = 5
"""Arrangements that are drawn for one that the calibration answers."""


@dataclass(frozen=True)
class Case:
    """A site, and what becomes of it.

    `a_day` and `step` are lengths of its movement, metres; `lorry` is where it stands, if it does.
    """

    name: str
    scene: str
    a_day: float = 0.0
    step: float = 0.0
    lorry: str = ""
    poles: bool = True

    def moved(self, week: int) -> float:
        """How far the site has moved when it is recorded in a week, metres."""
        return self.a_day * 7.0 * week + self.step * (week >= STEP_WEEK)

    @property
    def onset(self) -> int:
        """First week whose recording shows a movement; beyond the last where there is none."""
        if self.step:
            return STEP_WEEK
        return 1 if self.a_day else WEEKS + 1


CASES = (
    Case("still", "street"),
    Case("still, by the scene", "harbor", poles=False),
    Case("5 mm a day", "street", a_day=0.005),
    Case("5 mm a day", "corridor", a_day=0.005),
    Case("1 mm a day", "harbor", a_day=0.001),
    Case("1 mm a day", "street", a_day=0.001),
    Case("step of 3 cm in week 4", "corridor", step=0.03),
    Case("step of 3 cm, by the scene", "street", step=0.03, poles=False),
    Case("step of 1 cm in week 4", "harbor", step=0.01),
    Case("lorry next to the poles in week 5", "harbor", lorry="poles"),
    Case("lorry in view in week 5", "street", lorry="view"),
)


@dataclass(frozen=True)
class Week:
    """What a run of the command said: its exit code, and its JSON line."""

    code: int
    said: dict[str, Any]

    @property
    def events(self) -> list[dict[str, Any]]:
        """What it says has changed."""
        return list(self.said.get("changed", []))


@dataclass(frozen=True)
class Outcome:
    """What came of a site, and 1 σ of the translation that its stored pose states, metres."""

    case: Case
    draws: int
    sigma: float
    weeks: tuple[Week, ...]

    @property
    def alarm(self) -> int | None:
        """Week of the first run that ends with 4."""
        return next((k for k, one in enumerate(self.weeks, start=1) if one.code == 4), None)

    @property
    def false(self) -> int:
        """Runs that end with 4 before the site has moved."""
        return sum(one.code == 4 for one in self.weeks[: self.case.onset - 1])


def command(*words: object) -> subprocess.CompletedProcess[str]:
    """Run ``retropole`` as a person does."""
    return subprocess.run(
        [sys.executable, "-m", "retropole", *map(str, words)],
        check=False,
        capture_output=True,
        text=True,
    )


def lorry(pair: SimulatedPair, where: str) -> Box:
    """Stand a lorry beside the poles or in view of the source; ground is at z = 0."""
    target, source = pair.T_world_target[:2, 3], pair.T_world_source[:2, 3]
    poles = np.array([pole.centre[:2] for pole in pair.poles])
    if where == "poles":
        far = poles[np.argmax(np.linalg.norm(poles - target, axis=1))]
        out = (far - target) / np.linalg.norm(far - target)
        at = far + (1.5 + LORRY[1]) * out
    else:
        # Away from the poles, which stay in view.
        out = source - poles.mean(axis=0)
        out /= np.linalg.norm(out)
        at = source + (5.0 + LORRY[1]) * out
    along = np.array([-out[1], out[0], 0.0])
    axes = np.column_stack([along, [*out, 0.0], [0.0, 0.0, 1.0]])
    if np.linalg.det(axes) < 0:
        axes[:, 1] *= -1
    return Box(np.array([*at, LORRY[2]]), axes, LORRY, Material(0.4))


def calibrated(case: Case, seed: int, folder: Path) -> tuple[SimulatedPair, int, float]:
    """Record and calibrate a site: the pair, how many were drawn, and 1 σ of its translation."""
    for draw in range(MOST_DRAWS):
        rng = np.random.default_rng([18, seed, draw])
        pair = simulate_pair(case.scene, rng, noise=NOISE_MODELS["field"])
        write_pair(pair, folder / "first")
        names = [sensor.name for sensor in pair.sensors]
        done = command(
            *("calibrate", folder / "first/lidar0.pcd", folder / "first/lidar1.pcd"),
            *("--sensor", names[0], "--sensor", names[1]),
            *("--out", folder / "stored", "-q"),
        )
        if done.returncode == 0:
            covariance = json.loads((folder / "stored/result.json").read_text())["covariance"]
            return pair, draw + 1, float(np.sqrt(np.trace(np.array(covariance)[3:, 3:]) / 3))
    raise RuntimeError(f"{MOST_DRAWS} draws of {case.scene!r} gave none that is calibrated")


def watched(case: Case, seed: int, folder: Path, weeks: int = WEEKS) -> Outcome:
    """Calibrate a site once, and run the command each week."""
    pair, draws, sigma = calibrated(case, seed, folder)
    rng = np.random.default_rng([19, seed])
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    rows = []
    for week in range(1, weeks + 1):
        here = pair
        if case.lorry and week == LORRY_WEEK:
            here = replace(pair, surfaces=(lorry(pair, case.lorry), *pair.surfaces))
        moved = np.r_[np.zeros(3), case.moved(week) * way]
        again = record_again(here, rng, moved=moved, poles=case.poles)
        new = folder / f"week-{week}"
        write_pair(again, new)
        rows.append(week_of(folder, new, START + timedelta(days=7 * week), listed=seed % 2 == 0))
    return Outcome(case, draws, sigma, tuple(rows))


def week_of(folder: Path, new: Path, time: datetime, *, listed: bool) -> Week:
    """Run the command on the recordings of a week, whose time is in the list or that of files."""
    target, source = new / "lidar0.pcd", new / "lidar1.pcd"
    columns = {"id": "site", "target": target, "source": source, "result": folder / "stored"}
    if listed:
        columns["time"] = time.isoformat()
    else:
        for path in (target, source):
            os.utime(path, (time.timestamp(), time.timestamp()))
    sites = new / "sites.csv"
    sites.write_text(",".join(columns) + "\n" + ",".join(map(str, columns.values())) + "\n")
    words = ("fleet", "check", sites, "--history", folder / "history", "--workers", 1, "--json")
    done = command(*words)
    return Week(done.returncode, json.loads(done.stdout) if done.stdout else {"error": done.stderr})


def said(week: Week) -> str:
    """Say shortly what a run said."""
    words = [str(event["kind"]) for event in week.events]
    words += ["not confirmed"] if week.said.get("not_confirmed") else []
    for one in week.said.get("not_told", []):
        words.append(f"{one['status']} ({', '.join(one['codes'])})")
    return " + ".join(words) or str(week.said.get("error", ""))[:60]


def row_of(outcome: Outcome) -> str:
    """Write a row of the table."""
    case, alarm = outcome.case, outcome.alarm
    codes = " ".join(str(one.code) for one in outcome.weeks)
    at = "" if alarm is None else f"{1000 * case.moved(alarm):.0f} mm"
    kinds: dict[str, int] = {}
    for k, one in enumerate(outcome.weeks, start=1):
        if said(one):
            kinds.setdefault(said(one), k)
    words = "; ".join(f"{week}: {what}" for what, week in kinds.items())
    return (
        f"| {case.name} | {case.scene} | {1000 * outcome.sigma:.1f} mm | {alarm or ''} | {at} |"
        f" {codes} | {words} | {outcome.false} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what came of each site."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=8000, help="first seed")
    parser.add_argument("--cases", type=int, nargs="*", help="numbers of some of them")
    parser.add_argument("--weeks", type=int, default=WEEKS, help="of runs of the command")
    asked = parser.parse_args(arguments)
    print(
        "| site | scene | 1 σ of the stored pose | week of the alarm | moved by then | exit codes |"
        " said, from which week | false alarms |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    outcomes = []
    for number, case in enumerate(CASES):
        if asked.cases and number not in asked.cases:
            continue
        with TemporaryDirectory() as folder:
            outcomes.append(watched(case, asked.first + number, Path(folder), asked.weeks))
        print(row_of(outcomes[-1]), flush=True)
    drawn = sum(one.draws - 1 for one in outcomes)
    print(f"\n{drawn} arrangements were refused by the calibration, and others drawn.")


if __name__ == "__main__":
    main()
