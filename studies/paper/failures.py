"""Sec. IV-C and V: the weaknesses that the paper names, as experiments; its method beside ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, Pole
from retropole.base.errors import Refusal
from retropole.base.quantities import counted
from retropole.base.sensors import Sensor
from retropole.checking.metrics import Errors, errors_of
from retropole.extraction.lines import clusters
from retropole.pipeline import Options, calibrate
from retropole.report.figures import GREEN, GREY, RED
from retropole.simulation import FIELD, SimulatedPair, simulate_pair
from retropole.simulation.pairs import Arrangement, Recorders, record
from retropole.simulation.raycast import Box, Material, Rectangle, Surface
from retropole.simulation.returns import TAPE_REACH, saturation, tape_strength
from retropole.surfaces.registration import as_surface, voxel_downsample
from retropole.surfaces.visibility import SCORING_VOXEL
from studies.paper.choosing import icp_of_any_reach
from studies.paper.exhibit import Exhibit
from studies.paper.starts import solve_starts
from studies.paper.thresholds import PAPER_TABLE_I

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WRONG_ROTATION, WRONG_TRANSLATION = float(np.radians(5.0)), 0.5
"""An answer farther than either from the truth is wrong, rad and metres: it is of a wrong
hypothesis or of wrong poles, and the scene cannot refine it."""

POLE_LENGTH, POLE_RMS = 0.6, 0.1
"""A cluster of the paper's detector that is at least so long and at most so thick is a pole, metres
(chosen; the paper says only that others are dropped)."""

PAPER_LINK = 0.5
"""Longest step within a cluster of it, metres (chosen): rings 2° apart are 0.28 m apart at 8 m."""

POLE_POINTS = 6
"""Least returns of such a cluster."""

Outcome = Literal["success", "wrong", "refused"]


class Answer(NamedTuple):
    """The outcome of one recording, and the errors of the answer, if there is one."""

    outcome: Outcome
    errors: Errors | None


def paper_threshold(sensor: Sensor) -> float:
    """Threshold of the paper's Table I; ours for models of other scales."""
    named = (value for value, names in PAPER_TABLE_I.values() if sensor.name in names)
    return float(next(named, sensor.threshold))


def paper_poles(cloud: PointCloud, threshold: float) -> list[Pole]:
    """Find the two poles as the paper does: threshold, clusters, those of the shape of a pole.

    Of more than two, those with the most returns are taken: it has no other rule.

    Raises
    ------
    Refusal
        ``too_few_poles`` where there are not two.
    """
    assert cloud.intensity is not None
    bright = np.flatnonzero(cloud.intensity >= threshold)
    poles = []
    for group in clusters(cloud.xyz[bright], PAPER_LINK):
        index = bright[group]
        xyz = cloud.xyz[index]
        if len(index) < POLE_POINTS:
            continue
        centre = xyz.mean(axis=0)
        n = np.linalg.svd(xyz - centre, full_matrices=False)[2][0]
        along = (xyz - centre) @ n
        rms = float(np.sqrt(np.mean(np.sum((xyz - centre) ** 2, axis=1) - along**2)))
        length = float(np.ptp(along))
        if length >= POLE_LENGTH and rms <= POLE_RMS:
            poles.append(Pole(centre, n, xyz, length, rms, 0, index))
    if len(poles) < 2:
        raise Refusal(
            "too_few_poles",
            counted(len(poles), "pole was found", "poles were found"),
            {"poles": len(poles)},
        )
    return sorted(poles, key=lambda pole: -len(pole.xyz))[:2]


def by_paper(pair: SimulatedPair) -> Array:
    """Pose (4, 4) by the paper's method: its poles, its least squares, the least e_r of its ICP.

    Four of the eight ends are hypotheses, as in its Table III: those that fit best.

    Raises
    ------
    Refusal
        Where there are not two poles, or they are parallel.
    """
    target, source = (
        paper_poles(cloud, paper_threshold(sensor))
        for cloud, sensor in zip((pair.target, pair.source), pair.sensors, strict=True)
    )
    ends = solve_starts(target, source)[:4]
    surfaces = [
        as_surface(voxel_downsample(cloud.xyz, SCORING_VOXEL))
        for cloud in (pair.target, pair.source)
    ]
    moved = [icp_of_any_reach(surfaces[0], surfaces[1], end.T_target_source).e_r for end in ends]
    return ends[int(np.argmin(moved))].T_target_source


def by_ours(pair: SimulatedPair) -> Array:
    """Pose (4, 4) of `calibrate`, told which sensors recorded.

    Raises
    ------
    Refusal
        Where it refuses.
    """
    answer = calibrate(pair.target, pair.source, options=Options(sensors=pair.sensors))
    if answer.T_target_source is None:
        raise Refusal(answer.reasons[0].code, answer.reasons[0].message, {})
    return answer.T_target_source


METHODS: dict[str, Callable[[SimulatedPair], Array]] = {"the paper's": by_paper, "ours": by_ours}


def judge(method: Callable[[SimulatedPair], Array], pair: SimulatedPair) -> Answer:
    """Run a method on a pair and hold its answer against the truth."""
    try:
        T = method(pair)
    except Refusal:
        return Answer("refused", None)
    errors = errors_of(T, pair.T_target_source)
    wrong = errors.rotation > WRONG_ROTATION or errors.translation > WRONG_TRANSLATION
    return Answer("wrong" if wrong else "success", errors)


@dataclass(frozen=True)
class Trouble:
    """One way in which recordings get worse.

    Attributes
    ----------
    weakness
        Of Sec. IV-C or V.
    name
        What is done.
    change
        Records a pair again with it; equal generators give equal recordings.
    """

    weakness: str
    name: str
    change: Callable[[SimulatedPair, np.random.Generator], SimulatedPair]


BASE = replace(FIELD, intensity_falloff=False, ring_bias=0.0, ring_elevation=0.0, movers=0)
"""The noise of the field without what is tried one by one, and with nobody before the poles."""

TAPE, POST = Material(0.9, retro=True), Material(0.4)
"""Of what is put into the scene."""


def with_strips(count: int) -> Callable[[SimulatedPair, np.random.Generator], SimulatedPair]:
    """Put posts beside the poles, taped on one side: slim, as long as poles, and seen by few."""

    def change(pair: SimulatedPair, rng: np.random.Generator) -> SimulatedPair:
        things: list[Surface] = []
        for _ in range(count):
            things += _taped_post(pair, rng)
        at = Arrangement(
            [*pair.surroundings, *things],
            pair.poles,
            (pair.T_world_target, pair.T_world_source),
            pair.clear,
        )
        return record(at, Recorders(pair.sensors, pair.devices, pair.noise, 1), rng)

    return change


def _taped_post(pair: SimulatedPair, rng: np.random.Generator) -> list[Surface]:
    """Draw a post of 12 cm, 1.8 m high, with a strip of tape on the side facing one LiDAR."""
    lidars = [pose[:2, 3] for pose in (pair.T_world_target, pair.T_world_source)]
    things = [*lidars, *(pole.centre[:2] for pole in pair.poles)]
    best = np.zeros(2)
    for _ in range(50):
        best = rng.uniform(-1, 1, 2) * np.minimum(pair.clear, 5.0)
        if min(float(np.linalg.norm(best - thing)) for thing in things) > 1.0:
            break
    toward = lidars[rng.integers(2)] - best
    toward = np.r_[toward / np.linalg.norm(toward), 0.0]
    across, up = np.array([-toward[1], toward[0], 0.0]), np.array([0.0, 0.0, 1.0])
    centre = np.r_[best, 0.9]
    post = Box(centre, np.stack([toward, across, up], axis=1), np.array([0.06, 0.06, 0.9]), POST)
    strip = Rectangle(centre + 0.065 * toward, across, up, (0.025, 0.85), TAPE)
    return [post, strip]


def with_rings(
    bias: float, elevation: float, every: int
) -> Callable[[SimulatedPair, np.random.Generator], SimulatedPair]:
    """Give every n-th ring of both LiDARs errors of range, metres, and elevation, rad (1 σ)."""

    def change(pair: SimulatedPair, rng: np.random.Generator) -> SimulatedPair:
        devices = []
        for device in pair.devices:
            bad = rng.permutation(len(device.ring_range)) % every == 0
            ranges, elevations = rng.normal(size=(2, len(bad))) * bad
            devices.append(
                replace(
                    device,
                    ring_range=device.ring_range + bias * ranges,
                    ring_elevation=device.ring_elevation + elevation * elevations,
                )
            )
        return record_again(replace(pair, devices=(devices[0], devices[1])), rng)

    return change


def with_fading_tape(reach: float) -> Callable[[SimulatedPair, np.random.Generator], SimulatedPair]:
    """Let intensity fall with range and incidence; tape saturates the LiDARs to some range, m."""

    def change(pair: SimulatedPair, rng: np.random.Generator) -> SimulatedPair:
        noise = replace(pair.noise, intensity_falloff=True)
        again = record_again(pair, rng, noise=noise)
        clouds = []
        for cloud, labels, sensor, T_world in zip(
            (again.target, again.source),
            again.labels,
            again.sensors,
            (again.T_world_target, again.T_world_source),
            strict=True,
        ):
            assert cloud.intensity is not None
            intensity = cloud.intensity.copy()
            for k, pole in enumerate(again.poles):
                on = np.flatnonzero(labels == len(again.surroundings) + k)
                xyz = se3.apply(T_world, cloud.xyz[on])
                away = T_world[:3, 3] - xyz
                ranges = np.linalg.norm(away, axis=1)
                out = xyz - pole.centre
                out -= np.outer(out @ pole.axis, pole.axis)
                cosine = np.sum(away * out, axis=1) / (ranges * np.linalg.norm(out, axis=1))
                loss = 1 - noise.intensity_noise * np.abs(rng.normal(size=len(on)))
                strength = tape_strength(cosine) * loss * (reach / ranges) ** 2
                # At the edge of a beam the simulator's own is less.
                least = np.round(saturation(sensor) * np.clip(strength, 0.0, 1.0))
                intensity[on] = np.minimum(intensity[on], least)
            clouds.append(replace(cloud, intensity=intensity))
        return replace(again, target=clouds[0], source=clouds[1])

    return change


TROUBLES = (
    Trouble("none", "the same scenes without", record_again),
    Trouble("wrong poles", "1 post taped on one side", with_strips(1)),
    Trouble("wrong poles", "3 posts taped on one side", with_strips(3)),
    Trouble("inaccurate rings", "range of all rings, 20 mm", with_rings(0.02, 0.0, 1)),
    Trouble("inaccurate rings", "range of every 4th ring, 100 mm", with_rings(0.1, 0.0, 4)),
    Trouble(
        "inaccurate rings",
        "elevation of all rings, 0.1°",
        with_rings(0.0, float(np.radians(0.1)), 1),
    ),
    *(
        Trouble("falling intensity", f"tape saturates to {reach:g} m", with_fading_tape(reach))
        for reach in (TAPE_REACH, 6.0, 4.0)
    ),
)
"""What is tried, each on the same scenes."""


def failures(seeds: int) -> Exhibit:
    """Run both methods in corridors under each trouble, and count what becomes of them."""
    answers: dict[tuple[str, str], list[Answer]] = {}
    for seed in range(seeds):
        pair = simulate_pair("corridor", np.random.default_rng(seed), noise=BASE)
        for trouble in TROUBLES:
            # The same generator, so that rows differ by the trouble and not by the draw of noise.
            worse = trouble.change(pair, np.random.default_rng([seed, 1]))
            for name, method in METHODS.items():
                answers.setdefault((trouble.name, name), []).append(judge(method, worse))
    rows = []
    for trouble in TROUBLES:
        for name in METHODS:
            each = answers[trouble.name, name]
            right = [a.errors.e_rt for a in each if a.outcome == "success" and a.errors]
            counts = [sum(a.outcome == kind for a in each) for kind in ("success", "wrong")]
            middle = float(np.median(right)) if right else None
            rows.append(
                (trouble.weakness, trouble.name, name, *counts, seeds - sum(counts), middle)
            )
    return Exhibit(
        "weaknesses",
        "Sec. IV-C and V: the weaknesses that the paper names, in simulated corridors",
        ("weakness", "what is done", "method", "success", "wrong", "refused", "median e_rt m"),
        tuple(rows),
        f"The same {seeds} corridors (seeds from 0) in every row, with all errors of the field but "
        "those that are tried, and nobody in the way. Wrong: off by more than 5° or "
        "0.5 m; the median is over successes. The paper's method: thresholds of its "
        f"Table I, clusters of the shape of a pole ({POLE_LENGTH:g} m "
        f"long, {100 * POLE_RMS:g} cm rms thick; it names no figures), the two "
        "with the most returns, its least squares, and the hypothesis with the least e_r of an ICP "
        "of any reach, of the four best ends; it refuses only where it has no two poles. Ours: "
        "`calibrate`, told the sensors.",
        lambda figure: _draw(figure, answers),
        (10.0, 5.0),
    )


def _draw(figure: Figure, answers: dict[tuple[str, str], list[Answer]]) -> None:
    """Draw the share of each outcome, the paper's method and ours side by side."""
    left, right = figure.subplots(1, 2, sharey=True)
    names = [f"{t.weakness}: {t.name}" if t.weakness != "none" else t.name for t in TROUBLES]
    at = np.arange(len(names))[::-1]
    colors = {"success": GREEN, "refused": GREY, "wrong": RED}
    for axes, method in ((left, "the paper's"), (right, "ours")):
        start = np.zeros(len(names))
        for kind, color in colors.items():
            count = np.array(
                [sum(a.outcome == kind for a in answers[t.name, method]) for t in TROUBLES]
            )
            axes.barh(at, count, left=start, color=color, label=kind)
            for y, x, n in zip(at, start, count, strict=True):
                if n:
                    axes.text(x + n / 2, y, str(n), ha="center", va="center", fontsize=8)
            start += count
        axes.set_title(f"{method[0].upper()}{method[1:]}", fontsize=10)
        axes.set_xlabel("corridors")
        axes.set_yticks(at, names, fontsize=8)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
