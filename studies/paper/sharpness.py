"""Table IV beyond its medians: other kernels, raw clouds, every corridor, and the figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.checking.metrics import EVALUATION_VOXEL, KERNEL_WIDTH, e_rt, rqe
from retropole.report.figures import BLUE, ORANGE
from retropole.simulation import SimulatedPair
from retropole.surfaces.registration import voxel_downsample
from studies.paper.exhibit import Cell, Exhibit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PosesOrCodes = dict[str, Array | str]
"""The pose of each method, or the code of its refusal."""

PAPER_TABLE_IV = {"planes": 0.0824, "poles": 0.0822, "ICP": 0.0461, "wrong hypothesis": 0.0497}
"""Argument of the entropy's logarithm, by method."""

METHODS = ("planes", "poles", "poles and scene", "ICP", "GICP", "wrong hypothesis", "truth")
"""In the order of the tables."""

SHARPNESS_METHODS = (*PAPER_TABLE_IV, "truth")
"""Of which every corridor is listed."""

RELATIONS = (
    ("planes", "poles"),
    ("poles", "wrong hypothesis"),
    ("wrong hypothesis", "ICP"),
    ("planes", "wrong hypothesis"),
    ("planes", "ICP"),
    ("poles", "ICP"),
)
"""Pairs of which the paper finds the first the sharper; the first three make its whole order."""

KERNEL_WIDTHS = (0.02, 0.05, 0.1, 0.2)
"""σ of the kernels that are tried, metres: from the noise of a LiDAR to the size of boxes."""

SHARPNESS_POINTS = 10_000
"""Points of both clouds together that the entropy is taken of; the time grows with the square."""

SHARPNESS_TOLERANCE = 1e-4
"""Largest relative error of the sum: a hundredth of the differences that are looked at."""

SHOWN_RANGE, SHOWN_POINTS = 12.0, 9_000
"""Figures show so much around the target, metres, and so many points of each cloud."""

CAMERA_DISTANCE = 3.0
"""Of the camera of the lower pictures from the middle, in half widths of the upper ones."""

EYE = np.radians([30.0, 15.0])
"""Elevation and azimuth from which the lower pictures look, rad."""


@dataclass(frozen=True, eq=False)
class Corridor:
    """A simulated corridor and what every method made of it."""

    seed: int
    pair: SimulatedPair
    found: PosesOrCodes

    def poses(self) -> dict[str, Array]:
        """Give the poses (4, 4) of `SHARPNESS_METHODS`, of those that answered."""
        found = ((name, self.found.get(name, "")) for name in SHARPNESS_METHODS)
        return {name: T for name, T in found if not isinstance(T, str)}


def sums_of(pair: SimulatedPair, poses: Mapping[str, Array], thinned: bool) -> dict[str, Array]:
    """Sum of the entropy by kernel (K,), 1/m³, of each pose, on the same points for all.

    Parameters
    ----------
    pair
        Whose clouds are aligned.
    poses
        (4, 4) each, target from source.
    thinned
        Whether to take one point per cube of `EVALUATION_VOXEL`, or the clouds as recorded.
    """
    clouds = [pair.target.xyz, pair.source.xyz]
    if thinned:
        clouds = [voxel_downsample(xyz, EVALUATION_VOXEL) for xyz in clouds]
    rng, total = np.random.default_rng(0), sum(map(len, clouds))
    keep = np.sort(rng.permutation(total)[:SHARPNESS_POINTS])
    target = clouds[0][keep[keep < len(clouds[0])]]
    source = clouds[1][keep[keep >= len(clouds[0])] - len(clouds[0])]
    sums = {}
    for name, T in poses.items():
        together = np.concatenate([target, se3.apply(T, source)])
        each = (rqe(together, sigma, tolerance=SHARPNESS_TOLERANCE) for sigma in KERNEL_WIDTHS)
        sums[name] = np.array([entropy.sum for entropy in each])
    return sums


def sharpness_exhibits(corridors: Sequence[Corridor]) -> tuple[Exhibit, Exhibit]:
    """List every corridor, and count in how many each relation of the paper's order holds."""
    by_kind: dict[str, list[dict[str, Array]]] = {"thinned": [], "raw": []}
    rows: list[tuple[Cell, ...]] = []
    usual = KERNEL_WIDTHS.index(KERNEL_WIDTH)
    for corridor in corridors:
        poses = corridor.poses()
        for kind, kept in by_kind.items():
            kept.append(sums_of(corridor.pair, poses, kind == "thinned"))
        thinned, raw = (kept[-1] for kept in by_kind.values())
        for name in SHARPNESS_METHODS:
            if name not in poses:
                code = corridor.found.get(name, "no pose")
                rows.append((corridor.seed, name, None, None, None, str(code)))
                continue
            error = e_rt(poses[name], corridor.pair.T_target_source)
            sums = float(thinned[name][usual]), float(raw[name][usual])
            rows.append((corridor.seed, name, *sums, error, "answered"))
    header = tuple(f"{first} > {second}" for first, second in RELATIONS)
    counted: tuple[tuple[Cell, ...], ...] = tuple(
        (kind, sigma, *_counts(kept, k))
        for kind, kept in by_kind.items()
        for k, sigma in enumerate(KERNEL_WIDTHS)
    )
    note = (
        f"Corridors of seeds 0 to {len(corridors) - 1}; the entropy is taken of "
        f"{SHARPNESS_POINTS} points, the same for all methods, of both clouds as recorded (raw) or "
        f"downsampled to {EVALUATION_VOXEL} m (thinned)."
    )
    return (
        Exhibit(
            "table4_order",
            "Table IV: in how many corridors each relation of the paper's order holds",
            ("clouds", "kernel m", *header, "whole order"),
            counted,
            f"{note} Each count is out of the corridors in which both methods answered, that of "
            "the whole order out of those in which all four did.",
        ),
        Exhibit(
            "table4_corridors",
            "Table IV: every corridor",
            ("seed", "method", "thinned, sum 1/m³", "raw, sum 1/m³", "e_rt m", "answer"),
            tuple(rows),
            f"{note} Kernel {KERNEL_WIDTH} m.",
        ),
    )


def _counts(corridors: Sequence[Mapping[str, Array]], kernel: int) -> list[str]:
    """Count each relation, and all of the order at once, as "held of compared"."""
    written = []
    for chain in (*[[relation] for relation in RELATIONS], list(RELATIONS[:3])):
        names = {name for relation in chain for name in relation}
        both = [sums for sums in corridors if names <= set(sums)]
        held = sum(all(sums[a][kernel] > sums[b][kernel] for a, b in chain) for sums in both)
        written.append(f"{held} of {len(both)}")
    return written


def draw_views(figure: Figure, corridor: Corridor, paper: Mapping[str, float]) -> None:
    """Draw both clouds under the paper's methods, from above and in perspective."""
    pair, poses = corridor.pair, corridor.poses()
    target = pair.target.xyz[np.abs(pair.target.xyz).max(axis=1) < SHOWN_RANGE]
    middle = (target.min(axis=0) + target.max(axis=0)) / 2
    half = 0.6 * float(np.ptp(target[:, :2], axis=0).max())
    for k, (name, value) in enumerate(paper.items()):
        source = se3.apply(poses[name], pair.source.xyz)
        source = source[np.abs(source[:, :2] - middle[:2]).max(axis=1) < half]
        above = figure.add_subplot(2, len(paper), k + 1)
        oblique = figure.add_subplot(2, len(paper), len(paper) + k + 1)
        for cloud, color in ((target, BLUE), (source, ORANGE)):
            xyz = cloud[:: 1 + len(cloud) // SHOWN_POINTS] - middle
            style: Any = {"s": 1.2, "c": color, "linewidths": 0, "rasterized": True}
            above.scatter(xyz[:, 0], xyz[:, 1], **style)
            across, up = _perspective(xyz, CAMERA_DISTANCE * half).T
            oblique.scatter(across, up, **style)
        error = e_rt(poses[name], pair.T_target_source)
        above.set_title(f"{name}: e_rt {error:.2f} m\n(paper: entropy's sum {value})", fontsize=10)
        above.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
        above.tick_params(labelsize=7)
        edge = 1.05 / CAMERA_DISTANCE
        oblique.set(
            xlim=(-edge, edge), ylim=(-0.6 * edge, 0.6 * edge), aspect="equal", xticks=[], yticks=[]
        )


def _perspective(xyz: Array, distance: float) -> Array:
    """Project points (N, 3) about the origin into the picture (N, 2) of a camera in `EYE`."""
    (ce, ca), (se, sa) = np.cos(EYE), np.sin(EYE)
    right, up = np.array([-sa, ca, 0.0]), np.array([-se * ca, -se * sa, ce])
    depth = distance - xyz @ np.array([ce * ca, ce * sa, se])
    return np.asarray(xyz @ np.stack([right, up], axis=1) / depth[:, None])
