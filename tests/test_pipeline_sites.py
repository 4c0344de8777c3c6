"""Laws of a whole site: what changes how it is told, and not the site, changes no answer."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from retropole import pipeline as calibration
from retropole.adjustment.answer import SiteCalibration
from retropole.adjustment.datum import Datum
from retropole.adjustment.site import Adjusted, Recorded, adjust
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Reason, Refusal
from retropole.base.se3 import RelativePose
from retropole.base.uncertainty import predicted_error
from retropole.pipeline import calibrate_site
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import between, made, off, poses_of, reordered, with_lidar
from tests.numeric import numeric_jacobian
from tests.tiers import first_of

pytestmark = pytest.mark.full

PAIRS = ((0, 1), (0, 2), (1, 2))

NEAR = 2.0
"""χ² of what is drawn anew is 5.3 with 6 degrees of freedom on average: grids over the clouds lie
elsewhere where a cloud was turned, or has another place in the order; the returns are the same."""

THOUSANDTH, FIVE_SIGMA = 22.5, 39.6
"""χ² with 6 degrees of freedom is above these once in a thousand times, and as a normal number is
beyond five σ."""


def sigma_at(found: RelativePose) -> float:
    return predicted_error(found.covariance, (30.0,))[0].sigma_m


def moved(found: RelativePose, left: Array, right: Array) -> RelativePose:
    """The pose ``left T right``, with its covariance."""
    T = left @ found.T_i_j @ right

    def there(step: Array) -> Array:
        return se3.local(T, left @ se3.retract(found.T_i_j, step) @ right)

    J = numeric_jacobian(there, 6)
    return RelativePose(T, J @ found.covariance @ J.T)


def check_same(one: RelativePose, other: RelativePose) -> None:
    assert off(one, other.T_i_j) < NEAR
    assert sigma_at(other) == pytest.approx(sigma_at(one), rel=0.15)


def test_the_answer_is_near_the_truth_and_says_how_near(
    simulated: SimulatedSite, found: SiteCalibration
) -> None:
    assert found.status == "ok", found.reasons
    for i, j in PAIRS:
        true = se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]
        assert off(between(found, i, j), true) < THOUSANDTH
    assert found.groups == ((0, 1, 2),)
    assert [one.lidar for one in found.lidars] == [0, 1, 2]
    assert found.covariance is not None
    for one in found.lidars:
        own = slice(6 * one.lidar, 6 * one.lidar + 6)
        np.testing.assert_array_equal(one.covariance, found.covariance[own, own])
    assert len(found.loops) == 1
    assert len(found.without) == 2
    assert all(pair.standing == 1 and pair.patches > 100 for pair in found.pairs)
    np.testing.assert_array_equal(found.lidars[0].T_site_lidar, np.eye(4))


@pytest.mark.parametrize("lidar", first_of([0, 1]))
def test_a_lidar_may_have_any_frame(
    simulated: SimulatedSite, found: SiteCalibration, lidar: int
) -> None:
    """All its clouds moved, beam origin and all: its pose follows."""
    A = se3.random(np.random.default_rng(7), 5.0)
    site = simulated.as_site()
    clouds = [cloud for cloud in site.lidars[lidar].clouds if cloud is not None]
    site = with_lidar(site, lidar, clouds=tuple(cloud.transformed(A) for cloud in clouds))
    again = calibrate_site(site)
    frames = [A if i == lidar else np.eye(4) for i in range(3)]
    for i, j in PAIRS:
        back = moved(between(again, i, j), se3.inverse(frames[i]), frames[j])
        check_same(between(found, i, j), back)
    # What a page shows of it lies where its pose puts it.
    for scan, was in zip(again.scans[lidar], found.scans[lidar], strict=True):
        assert scan is not None
        assert was is not None
        for pole, before in zip(scan.poles, was.poles, strict=True):
            there = se3.apply(A, before.point[None])[0]
            np.testing.assert_allclose(pole.point, there, atol=1e-6)


@pytest.mark.parametrize(
    ("lidars", "placements"),
    first_of([((2, 0, 1), (0, 1)), ((0, 1, 2), (1, 0)), ((1, 0, 2), (1, 0))]),
)
def test_the_order_makes_no_difference(
    simulated: SimulatedSite,
    found: SiteCalibration,
    lidars: Sequence[int],
    placements: Sequence[int],
) -> None:
    again = calibrate_site(reordered(simulated.as_site(), lidars, placements))
    assert again.status == found.status
    assert again.datum == found.datum
    assert len(again.poles) == len(found.poles)
    number = {i: lidars.index(i) for i in range(3)}
    for i, j in PAIRS:
        check_same(between(found, i, j), between(again, number[i], number[j]))


def test_where_a_survey_counts_from_makes_no_difference(simulated_survey: SimulatedSite) -> None:
    site = simulated_survey.as_site()
    plain = calibrate_site(site)
    F = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, 0.7])), np.array([120.0, -80.0, 15.0]))

    def there(point: Array | None) -> Array | None:
        return None if point is None else se3.apply(F, point[None])[0]

    poles = tuple(
        structs.replace(each, foot=there(each.foot), top=there(each.top)) for each in site.poles
    )
    points = tuple(structs.replace(each, at=se3.apply(F, each.at[None])[0]) for each in site.points)
    again = calibrate_site(replace(site, poles=poles, points=points))
    assert again.status == plain.status == "ok"
    for one, other, true in zip(
        plain.lidars, again.lidars, simulated_survey.T_world_lidar, strict=True
    ):
        before = RelativePose(one.T_site_lidar, one.covariance)
        back = moved(RelativePose(other.T_site_lidar, other.covariance), se3.inverse(F), np.eye(4))
        assert off(before, back.T_i_j) < 0.01
        assert sigma_at(back) == pytest.approx(sigma_at(before), rel=0.01)
        assert off(before, true) < FIVE_SIGMA


def test_more_poles_and_lidars_make_no_pair_less_sure(
    simulated: SimulatedSite, found: SiteCalibration
) -> None:
    """What the third LiDAR and all loops add counts."""
    for i, j in ((0, 1), (1, 2)):
        alone = calibrate_site(
            replace(
                simulated.as_site(), lidars=tuple(simulated.as_site().lidars[k] for k in (i, j))
            )
        )
        assert sigma_at(between(found, i, j)) < 1.1 * sigma_at(between(alone, 0, 1))
        assert off(between(alone, 0, 1), between(found, i, j).T_i_j) < THOUSANDTH


def test_lidars_that_share_no_poles_are_refused_with_their_names(
    simulated: SimulatedSite,
) -> None:
    found = calibrate_site(with_lidar(simulated.as_site(), 2, clouds=(None, None)))
    assert found.status == "refused"
    (reason,) = found.reasons
    assert reason.code == "disconnected"
    assert "posts-1, posts-2; posts-3" in reason.message
    assert found.groups == ((0, 1), (2,))
    assert found.covariance is None
    assert not found.lidars
    # What was seen is told all the same.
    assert found.scans[0][0] is not None
    assert len(found.pairs) == 3


def test_a_recording_without_intensity_is_done_without(
    simulated: SimulatedSite, found: SiteCalibration
) -> None:
    site = simulated.as_site()
    first, second = site.lidars[1].clouds
    assert first is not None
    again = calibrate_site(with_lidar(site, 1, clouds=(replace(first, intensity=None), second)))
    assert again.status == "warn"
    assert [reason.code for reason in again.reasons] == ["recording_unusable"]
    assert again.reasons[0].values["lidar"] == "posts-2"
    for i, j in PAIRS:
        assert off(between(again, i, j), between(found, i, j).T_i_j) < THOUSANDTH


def test_a_ring_of_ambiguous_pairs_is_never_wrong() -> None:
    """Two poles that a half turn exchanges, between every two; the loop may decide."""
    simulated = made(kind="ring", placements=None)
    found = calibrate_site(simulated.as_site())
    if found.status == "refused":
        assert [reason.code for reason in found.reasons] == ["ambiguous_loop"]
        return
    for i, T in enumerate(poses_of(found)):
        true = se3.inverse(simulated.T_world_lidar[0]) @ simulated.T_world_lidar[i]
        apart = se3.difference(T, true)
        assert apart.rotation < np.radians(1.0)
        assert apart.translation < 0.15


def test_a_ring_that_is_cut_is_refused_with_its_lidars() -> None:
    simulated = made(kind="ring", placements=None, lidars=4)
    site = simulated.as_site()
    clouds = list(site.lidars[0].clouds)
    clouds[next(p for p, cloud in enumerate(clouds) if cloud is not None)] = None
    found = calibrate_site(with_lidar(site, 0, clouds=tuple(clouds)))
    assert found.status == "refused"
    assert found.reasons[0].code == "ambiguous_loop"
    assert "ring-2" in str(found.reasons[0].values["lidars"])


def test_a_survey_of_metres_is_too_weak(simulated_survey: SimulatedSite) -> None:
    site = simulated_survey.as_site()
    loose = tuple(structs.replace(each, sigma=3.0) for each in site.poles)
    found = calibrate_site(replace(site, poles=loose, points=()))
    assert found.status == "refused"
    assert found.reasons[0].code == "survey_too_weak"


def test_steps_are_named_and_timed(simulated: SimulatedSite, found: SiteCalibration) -> None:
    told: list[str] = []
    again = calibrate_site(simulated.as_site(), progress=told.append)
    assert told == list(again.seconds)
    assert list(found.seconds) == told


def test_what_does_not_fit_is_adjusted_again_from_where_it_ended(
    simulated: SimulatedSite, found: SiteCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under rough poses returns may lie beside their pole that do not under the adjusted ones."""
    starts: list[Array] = []

    def misfits_at_first(recorded: Recorded, datum: Datum) -> Adjusted:
        starts.append(datum.poses[1])
        adjusted = adjust(recorded, datum)
        if len(starts) > 1:
            return adjusted
        tests = tuple(replace(test, w=9.0, chi2=200.0) for test in adjusted.tests)
        return replace(adjusted, tests=tests)

    monkeypatch.setattr(calibration, "adjust", misfits_at_first)
    again = calibrate_site(simulated.as_site())
    assert again.status == found.status
    assert len(starts) == 2
    T = poses_of(again)[1]
    rough, better = (se3.difference(start, T).translation for start in starts)
    assert better < 0.003 < rough


def test_a_refusal_says_what_was_left_out_before_it(
    simulated: SimulatedSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    def one_left_out(recorded: Recorded, first: Adjusted) -> tuple[Adjusted, list[Reason]]:
        return first, [Reason("pole_moved", "pole 1 of placement 1 was left out", {})]

    def contradicted(*_: object) -> list[Reason]:
        raise Refusal("scene_contradicts", "nothing stands where it should", {})

    monkeypatch.setattr(calibration, "without_blunders", one_left_out)
    monkeypatch.setattr(calibration, "confirm_links", contradicted)
    found = calibrate_site(simulated.as_site())
    assert found.status == "refused"
    assert [reason.code for reason in found.reasons] == ["scene_contradicts", "pole_moved"]
    assert not found.lidars


def test_poles_stand_where_they_are_adjusted(
    simulated: SimulatedSite, found: SiteCalibration
) -> None:
    """The axes are as far from the true ones as their σ say, in the frame of the first LiDAR."""
    T = simulated.T_world_lidar[0]
    distances, turns = [], []
    for pole in found.poles:
        at, direction = se3.apply(T, pole.point[None])[0], T[:3, :3] @ pole.direction
        away = [
            np.linalg.norm(np.cross(at - c.centre, c.axis)) for c in simulated.poles[pole.placement]
        ]
        axis = simulated.poles[pole.placement][int(np.argmin(away))].axis
        assert pole.sigma is not None
        assert pole.direction_sigma is not None
        distances.append(min(away) / pole.sigma)
        turns.append(np.linalg.norm(np.cross(direction, axis)) / pole.direction_sigma)
    assert 0.2 < np.median(distances) < 2.5
    assert 0.1 < np.median(turns) < 2.5
    assert max(distances + turns) < 4.0


def test_a_refusal_says_that_the_returns_deny_the_radius(
    simulated: SimulatedSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which may be why nothing fits."""

    def refuse(recorded: Recorded, first: Adjusted) -> tuple[Adjusted, list[Reason]]:
        raise Refusal("site_inconsistent", "nothing fits", {})

    monkeypatch.setattr(calibration, "without_blunders", refuse)
    site = simulated.as_site()
    found = calibrate_site(replace(site, radius=2.0 * site.radius))
    assert [reason.code for reason in found.reasons] == ["site_inconsistent", "radius_differs"]
    sound = calibrate_site(site)
    assert [reason.code for reason in sound.reasons] == ["site_inconsistent"]
