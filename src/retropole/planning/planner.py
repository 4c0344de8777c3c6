"""From bare recordings to the positions of the poles: the planner on one page.

`rehearse` is the calibration before anyone drives out: poles are inserted into the recordings, and
the whole method is run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.distance import cdist

from ..adjustment.answer import SiteCalibration
from ..alignment.network import Network
from ..base.bounded import Status
from ..base.datatypes import DEFAULT_RADIUS, MAX_RADIUS, BoolArray, Calibration, PointCloud
from ..base.description import Site, SiteLidar
from ..base.errors import Refusal
from ..base.quantities import counted
from ..base.uncertainty import predicted_error
from ..base.uncertainty.purpose import DEFAULT_AT, Need
from ..pipeline import Options, calibrate, calibrate_site
from ..result.pole_plan import MOST_PLACEMENTS, MOST_POLES
from ..simulation.raycast import Cylinder
from ..simulation.recorded import in_sensor_frame, range_noise, with_poles
from .choice import UNCONSTRAINED, Design, choose, errors_of, rules_of, unknown_precision
from .place import FAR, Area, Candidates, Station, Surroundings, candidate_poles, survey
from .prediction import (
    Prediction,
    Surfaces,
    divergences_of,
    model_of,
    network_of,
    predict,
    prior_of,
    refined,
    roots_of,
    scene_information,
    surfaces_of,
)

Rehearsal = Calibration | SiteCalibration
"""The answer for two LiDARs, or for a site."""


def recordings_with(
    stations: Sequence[Station],
    poles: Sequence[Cylinder],
    rng: np.random.Generator,
    *,
    again: bool = False,
) -> list[PointCloud]:
    """Insert poles, in the frame of the scene, into the recording of each LiDAR.

    The scene was recorded once. If it is recorded `again`, for another placement, its
    ranges get other noise: with identical numbers, it would be refused as one recording given
    twice.
    """
    made = []
    for each, width in zip(stations, divergences_of(stations), strict=True):
        own = in_sensor_frame(poles, each.T)
        biases = np.zeros(int(each.beams.rings.max(initial=0)) + 2)
        cloud, _ = with_poles(each.cloud, each.beams, own, width, each.sensor, rng, biases)
        if again:
            ranges = np.linalg.norm(cloud.xyz, axis=1, keepdims=True)
            noise = range_noise(each.sensor) * rng.normal(size=ranges.shape)
            cloud = replace(cloud, xyz=cloud.xyz * (1.0 + noise / ranges))
        made.append(cloud)
    return made


def rehearse(
    stations: Sequence[Station],
    placements: Sequence[Sequence[Cylinder]],
    radius: float,
    need: Need | None = None,
) -> Rehearsal:
    """Calibrate with the poles of all placements, as if they had been set up."""
    rng = np.random.default_rng(0)
    clouds = [
        recordings_with(stations, poles, rng, again=p > 0) for p, poles in enumerate(placements)
    ]
    by_lidar = list(zip(*clouds, strict=True))
    if len(stations) == 2:
        sensors = stations[0].sensor, stations[1].sensor
        return calibrate(*by_lidar, options=Options(radius=radius, sensors=sensors, need=need))
    lidars = tuple(
        SiteLidar(each.name, own, sensor=each.sensor)
        for each, own in zip(stations, by_lidar, strict=True)
    )
    names = tuple(str(p + 1) for p in range(len(placements)))
    return calibrate_site(Site("rehearsal", lidars, names, radius=radius, need=need))


LENGTH = 2.0
"""Of the poles by default, metres."""

WORTH = 0.15
"""One pole or placement more is worthwhile if it reduces the error by this part,
or improves the verdict."""

VERDICTS: tuple[Status, ...] = ("refused", "warn", "ok")
"""From the worst to the best."""


@dataclass(frozen=True, eq=False)
class More:
    """The gain from one pole, or one placement, more.

    Attributes
    ----------
    what
        ``pole`` or ``placement``.
    chosen
        The numbers of the poles of all placements with it.
    error, alone
        Largest error of all LiDARs at the range with it, metres; and by the poles alone.
    gain
        Part of the error that is removed.
    status
        The verdict of its rehearsal; None if that of the plan is ok, and none was made.
    is_better
        Whether that verdict is better than the plan's; None if it is equal.
    """

    what: Literal["pole", "placement"]
    chosen: Sequence[Sequence[int]]
    error: float
    alone: float
    gain: float
    status: Status | None = None
    is_better: bool | None = None

    @property
    def is_worth_it(self) -> bool:
        """Whether the verdict is better with it, or, with an equal verdict, the error by
        `WORTH`."""
        return self.gain >= WORTH if self.is_better is None else self.is_better


@dataclass(frozen=True, eq=False)
class Planned:
    """Planned positions of the poles.

    Attributes
    ----------
    stations
        The LiDARs, their poses refined, in the frame of the scene.
    place
        Its ground.
    candidates, seen
        All possible poles, and (C, L) which LiDAR sees which.
    design
        Information of each; see `choice`.
    chosen
        For each placement the numbers of its poles.
    reach
        Range at which the error was minimised, metres.
    predicted, alone
        The error that a calibration will state; and that from the poles alone.
    more
        The gain from one pole and one placement more, if a plan may have as many.
    rehearsal
        The calibration with poles put into the recordings.
    """

    stations: tuple[Station, ...]
    place: Surroundings
    candidates: Candidates
    seen: BoolArray
    design: Design
    chosen: tuple[tuple[int, ...], ...]
    reach: float
    predicted: Prediction
    alone: Prediction
    more: tuple[More, ...]
    rehearsal: Rehearsal

    @property
    def numbers(self) -> list[int]:
        """Numbers of all poles, placement by placement."""
        return [k for each in self.chosen for k in each]


def plan(
    stations: Sequence[Station],
    *,
    poles: int = 2,
    placements: int = 1,
    length: float = LENGTH,
    radius: float = DEFAULT_RADIUS,
    reach: float = DEFAULT_AT,
    need: Need | None = None,
    allowed: Sequence[Area] = (),
    forbidden: Sequence[Area] = (),
    progress: Callable[[str], None] = lambda step: None,
) -> Planned:
    """Plan the positions of the poles.

    Parameters
    ----------
    stations
        The LiDARs, in the frame of the scene; the first is the reference.
    poles, placements
        How many poles at once, and how often they are moved.
    length, radius
        Of the poles, metres.
    reach
        Range at which the error is minimised, metres.
    need
        The required accuracy.
    allowed, forbidden
        Where poles are allowed, and where not.
    progress
        Called with the name of each step as it starts.

    Raises
    ------
    Refusal
        ``no_ground`` if there is no room for a pole, ``nowhere_seen`` if no two LiDARs
        see one, and ``not_linked`` if the poles do not constrain every LiDAR.
    """
    progress("surfaces")
    surfaces = surfaces_of(stations)
    stations = refined(stations, surfaces)
    progress("ground")
    place = survey(stations, allowed, forbidden)
    progress("possible positions of poles")
    widths = divergences_of(stations)
    candidates, seen = candidate_poles(place, stations, widths, length, radius)
    if len(candidates) < poles:
        raise _too_few(stations, place, len(candidates), poles, length, radius)
    progress("information from each")
    network = network_of(
        stations, candidates, seen, np.arange(len(candidates)), surfaces.bands, quickly=True
    )
    design = design_of(stations, surfaces, candidates, seen, network, reach)
    progress("the best set")
    chosen = choose(design, poles, placements)
    if chosen is None:
        raise Refusal(
            "nowhere_seen",
            f"{counted(len(candidates), 'pole')} could be set up, but no {poles} of them "
            "together, 1 m from each other and at 15° to each other: request fewer, or allow "
            "more ground",
            {"seen": len(candidates)},
        )
    _check_linked(stations, design, chosen)
    progress("predict")

    def predict_for(numbers: Sequence[Sequence[int]]) -> tuple[Prediction, Prediction]:
        at = np.array([k for each in numbers for k in each])
        placement_of = np.repeat(np.arange(len(numbers)), [len(each) for each in numbers])
        return predict(stations, surfaces, candidates.select(at), seen[at], placement_of)

    predicted, alone = predict_for(chosen)
    now = worst_at(predicted, reach)
    more = []
    for what, other in _more(design, chosen):
        error, by_poles = (worst_at(each, reach) for each in predict_for(other))
        more.append(More(what, other, error, by_poles, 1.0 - error / now))
    progress("rehearse")

    def run(numbers: Sequence[Sequence[int]]) -> Rehearsal:
        poles_of = [[candidates.pole(k) for k in each] for each in numbers]
        return rehearse(stations, poles_of, radius, need)

    rehearsal = run(chosen)
    _check_poses(rehearsal)
    if rehearsal.status != "ok":
        # If the surroundings cannot decide, one pole more may.
        for k, each in enumerate(more):
            progress(f"rehearse with one {each.what} more")
            status = run(each.chosen).status
            lead = VERDICTS.index(status) - VERDICTS.index(rehearsal.status)
            more[k] = replace(each, status=status, is_better=None if lead == 0 else lead > 0)
    return Planned(
        tuple(stations),
        place,
        candidates,
        seen,
        design,
        tuple(tuple(each) for each in chosen),
        reach,
        predicted,
        alone,
        tuple(more),
        rehearsal,
    )


def _too_few(
    stations: Sequence[Station],
    place: Surroundings,
    found: int,
    poles: int,
    length: float,
    radius: float,
) -> Refusal:
    """Report that too few poles would be seen, with advice: thicker poles if all are far.

    A pole must be seen by two LiDARs: the second nearest limits.
    """
    middle = place.feet + np.array([0.0, 0.0, length / 2])
    lidars = np.stack([each.at for each in stations])
    away = float(np.sort(cdist(middle, lidars), axis=1)[:, 1].min())
    reach = FAR * radius
    advice = "use thicker or longer poles, or rotate the LiDARs so that they see the same ground"
    if reach < away < FAR * MAX_RADIUS:
        advice = (
            f"of {2e3 * radius:.0f} mm they are seen up to {reach:.1f} m away, and the nearest "
            f"such place is {away:.1f} m from one of two LiDARs; use poles of "
            f"{np.ceil(2e3 * away / FAR):.0f} mm or thicker (--radius is half of that, in metres)"
        )
    return Refusal(
        "nowhere_seen",
        f"on {len(place.feet)} places of free ground {counted(found, 'pole')} of {length:g} m "
        f"would be seen well by two LiDARs, {poles} are to be set up: {advice}",
        {"places": len(place.feet), "seen": found, "reach_m": reach, "nearest_m": away},
    )


def design_of(
    stations: Sequence[Station],
    surfaces: Surfaces,
    candidates: Candidates,
    seen: BoolArray,
    network: Network,
    reach: float,
) -> Design:
    """Compute the quantities from which the poles are chosen."""
    unknowns = replace(network.unknowns, axes=0)
    known = model_of(stations, candidates.radius).sigmas(unknowns.groups())
    alone = np.zeros((unknowns.kept, unknowns.kept))
    errors = np.arange(unknowns.poses, unknowns.kept)
    alone[errors, errors] = prior_of(unknowns, known)
    informations = alone + scene_information(stations, surfaces, unknowns), alone
    rules = rules_of(candidates, seen, [each.at for each in stations])
    before = np.r_[unknown_precision(unknowns), np.diag(alone)[unknowns.poses :]]
    roots = roots_of(network, len(candidates), before)
    return Design(roots, informations, unknowns, reach, rules, candidates.foot[:, :2])


def _check_linked(
    stations: Sequence[Station], design: Design, chosen: Sequence[Sequence[int]]
) -> None:
    errors = errors_of(design, chosen)[1]
    unlinked = [
        s.name for s, error in zip(stations[1:], errors, strict=True) if error > UNCONSTRAINED
    ]
    if unlinked:
        raise Refusal(
            "not_linked",
            f"these poles would not link {', '.join(unlinked)} to {stations[0].name}: request "
            "another placement, or allow ground that these LiDARs and others see",
            {"names": ", ".join(unlinked)},
        )


def _check_poses(rehearsal: Rehearsal) -> None:
    """Refuse poses that the surroundings contradict: no pole moved here."""
    for reason in rehearsal.reasons:
        if rehearsal.status == "refused" and reason.code == "scene_contradicts":
            said = reason.message.partition(": did a pole move")[0]
            raise Refusal(
                "pose_contradicted",
                f"with poles put into the recordings, {said}: correct the rough poses, they must "
                "be accurate to 10° and 1 m",
                reason.values,
            )


def _more(
    design: Design, begun: Sequence[Sequence[int]]
) -> Iterator[tuple[Literal["pole", "placement"], list[list[int]]]]:
    """Choose with one pole more in each placement, and with one placement more."""
    poles, placements = len(begun[0]), len(begun)
    requested: list[tuple[Literal["pole", "placement"], int, int]] = []
    if poles < MOST_POLES:
        requested.append(("pole", poles + 1, placements))
    if placements < MOST_PLACEMENTS:
        requested.append(("placement", poles, placements + 1))
    for what, count, times in requested:
        chosen = choose(design, count, times, begun)
        if chosen is not None:
            yield what, chosen


def worst_at(prediction: Prediction, reach: float) -> float:
    """Largest error of all LiDARs at a range, 1 σ, metres."""
    return max(predicted_error(each, (reach,))[0].sigma_m for each in prediction.covariance)
