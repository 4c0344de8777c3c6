"""Poles, checks, recordings and options are told as the result and the clouds have them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace as replaced

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.datatypes import Detection, Placement, RejectedCluster, Scan
from retropole.base.reasons import Code
from retropole.base.sensors import find_sensor
from retropole.extraction.acceptance_shape import MIN_POLE_RINGS
from retropole.extraction.lines import MIN_POLE_POINTS
from retropole.hypotheses.choice import hypothesis_name
from retropole.report import listings, recorded
from retropole.report.page import SHOWN, listed
from retropole.report.recorded import across, fit_circle, poles, run
from retropole.report.recorded import cross_sections as cross_sections_of
from retropole.report.recorded import missing_poles as missing_poles_of
from retropole.report.subject import (
    Subject,
    as_subject,
    pair_name,
    pole_labels,
    pole_name,
)
from retropole.result import PlacementDoc, ResultDoc, RunConfig
from retropole.result.site import SiteDoc, input_names
from retropole.simulation.devices import TYPICAL
from retropole.simulation.raycast import Cylinder
from retropole.simulation.scanning import scan
from retropole.simulation.scenes import TAPE
from tests.report.made_up import AS_SHOWN, HOSTILE, Page, made_up
from tests.report.site.made_up import NAMES, document_of, made_up_site

RESULT, PLACEMENTS = made_up(count=500)
REFUSED = document_of(made_up_site("refused", lidars=8, placements=2, count=10))
WARNED = document_of(made_up_site("warn", lidars=5, placements=4, count=10))


def pair(**fields: object) -> Subject:
    return as_subject(replace(RESULT, **fields), PLACEMENTS)


def headings(html: str) -> list[str]:
    return re.findall(r'<th scope="row">(.*?)</th>', html)


def test_poles_and_rejected_clusters_of_a_pair_are_listed() -> None:
    text = Page(poles(pair())).text
    for name in ("T0", "T1", "S0", "S1", "× 0", "+ 0"):
        assert name in text
    assert text.count("too_wide") == 2


def test_residuals_are_those_of_the_points_from_the_lines() -> None:
    ours, theirs = PLACEMENTS[0].target.poles[0], PLACEMENTS[0].source.poles[0]
    away = se3.apply(np.array(RESULT.T_target_source), theirs.xyz) - ours.point
    distances = np.linalg.norm(np.cross(away, ours.direction), axis=1)
    (row,) = re.findall(r'<tr><th scope="row">T0–S0</th>(.*?)</tr>', poles(pair()))
    figures = [float(cell) for cell in re.findall(r"<td>([\d.]+)</td>", row)]
    assert figures[2] == pytest.approx(1000 * np.sqrt(np.mean(distances**2)), abs=0.05)
    assert figures[3] == pytest.approx(1000 * distances.max(), abs=0.05)


def test_the_radius_is_reported_as_given_and_as_estimated() -> None:
    said = "Radius of the poles: 20.00 mm given, 20.31 ± 0.42 mm estimated (1 σ)."
    assert said in Page(poles(pair())).text
    assert "estimated" not in Page(poles(pair(radius=None))).text


def test_every_recording_of_a_site_says_what_was_found() -> None:
    html = poles(Subject(REFUSED))
    for said in ("not recorded", "too_few_poles", "0.8 m wide, at most 0.12 m", *NAMES):
        assert said in html
    # A refused one unfolds what has too little.
    assert "<details open>" in html
    answered = document_of(made_up_site("ok", lidars=8, placements=2, count=10))
    assert "<details open>" not in poles(Subject(answered))


def test_change_without_each_placement_is_reported_in_degrees_and_millimetres() -> None:
    changes = [PlacementDoc(2, 3, 0.001, 0.004), PlacementDoc(2, 2, None, None)]
    rows = listings.changes(pair(placements=changes)).rows
    assert [row[1:4] for row in rows] == [["2 + 3", "0.057", "4.0"], ["2 + 2", "–", "–"]]
    assert not listings.changes(pair(placements=changes[:1])).rows
    rows = listings.changes(Subject(WARNED)).rows
    assert [row[0] for row in rows] == ["1: morning", "2: noon", "3: after lunch", "4: evening"]
    assert rows[3][1:] == ["–", "–", "–"]


def test_hypotheses_without_icp_figures() -> None:
    def dashes(result: ResultDoc) -> int:
        return sum(row.count("–") for row in map(list, listings.hypotheses(result).rows))

    none = {"icp_rotation_rad": None, "icp_translation_m": None}
    without = [replace(each, **none) for each in RESULT.hypotheses]
    assert dashes(RESULT) == 0
    assert dashes(replace(RESULT, hypotheses=without)) == 8


def test_loops_are_closed_and_the_least_likely_comes_first() -> None:
    first = min(WARNED.loops, key=lambda each: each.probability or 0.0)
    names = [WARNED.lidars[k].name for k in first.lidars]
    assert listings.loops(WARNED).rows[0][0] == " → ".join([*names, names[0]])


def test_tests_go_by_w_and_the_rest_is_folded() -> None:
    html = listed(listings.tests(WARNED))
    named = headings(html)
    assert named[0] == "pole 2 of morning as mast-b sees it"
    assert len(named) == len(WARNED.tests)
    assert len(headings(html.split("<details>")[0])) == SHOWN
    assert "6.30 stands out" in html
    assert html.count("stands out") == 1
    assert "–" in html


def test_options_of_a_run_are_listed_where_they_are_no_defaults() -> None:
    config = RunConfig(up=True, prior_rpy_deg=(1.0, 2.0, 3.0), poles=3, frames=(None, 20, None))
    text = Page(run(pair(config=config))).text
    for said in ("upyes", "prior_rpy_deg1.0, 2.0, 3.0", "poles3", "frames:20"):
        assert said in text
    given = {"up", "prior_rpy_deg", "poles", "frames"}
    for field in msgspec.structs.fields(RunConfig):
        named = f'<th scope="row">{field.name}</th>' in run(pair(config=config))
        assert named is (field.name in given)
    assert "Every option is at its default." in Page(run(pair(config=RunConfig()))).text
    text = Page(run(Subject(REFUSED))).text
    for said in ("quay.toml", "2 cm at 30 m", "20 ± 0.5 mm"):
        assert said in text


@pytest.mark.parametrize("subject", [pair(inputs=2 * RESULT.inputs), Subject(REFUSED)])
def test_inputs_are_listed_with_their_hash_and_stay_text(subject: Subject) -> None:
    site: SiteDoc = subject.site
    text = Page(run(subject)).text
    for item in site.inputs:
        assert text.count(item.sha256) == sum(each.sha256 == item.sha256 for each in site.inputs)
    inputs = [replace(site.inputs[0], path=HOSTILE, notes=[HOSTILE])]
    page = Page(run(replaced(subject, site=replace(site, inputs=inputs))))
    assert page.open == []
    assert page.text.count(AS_SHOWN) == 2


def test_parts_have_names_that_no_two_share() -> None:
    names = [hypothesis_name(k) for k in range(60)]
    assert names[:3] == ["a", "b", "c"]
    assert len(set(names)) == 60
    assert (pole_name("target", 0), pole_name("source", 12)) == ("T0", "S12")
    assert pair_name((0, 1)) == "T0–S1"
    assert pole_labels(REFUSED) == []
    assert pole_labels(WARNED)[:4] == ["1.1", "1.2", "2.1", "2.2"]
    named = Subject(replace(WARNED, placements=["morning", "2", "", "x"]))
    assert named.placements == ["1: morning", "2", "3", "4: x"]


def test_inputs_are_named_by_file_and_topic() -> None:
    assert input_names(RESULT) == ["front.pcd", "rear.pcd"]
    config = RunConfig(target_topic="/a", source_topic="/b")
    named = input_names(replace(RESULT, config=config, inputs=2 * RESULT.inputs))
    assert named == ["front.pcd /a", "rear.pcd /b", "front.pcd /a", "rear.pcd /b"]


def cross_sections(result: ResultDoc, placement: Placement) -> str:
    return cross_sections_of(as_subject(result, [placement]))


def test_circle_of_known_radius_is_found_from_one_side() -> None:
    rng = np.random.default_rng(2)
    angle = rng.uniform(-1.2, 1.2, 200)
    radius = 0.02 + 0.002 * rng.standard_normal(200)
    flat = np.c_[radius * np.cos(angle), radius * np.sin(angle)] + [3.0, -1.0]
    centre, converged = fit_circle(flat, 0.02, flat.mean(axis=0) - [0.01, 0.0])
    assert converged
    assert np.allclose(centre, [3.0, -1.0], atol=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_converged_circle_is_where_its_weighted_residuals_balance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-1.5, 0.5, 80)
    radius = 0.02 + 0.005 * rng.standard_normal(80)
    flat = np.c_[radius * np.cos(angle), radius * np.sin(angle)]
    centre, converged = fit_circle(flat, 0.02, flat.mean(axis=0) - [0.008, 0.0])
    away = flat - centre
    distance = np.linalg.norm(away, axis=1)
    residual = distance - 0.02
    weight = 1 / np.sqrt(1 + (residual / recorded.RESIDUAL_SCALE) ** 2)
    force = np.abs(((weight * residual / distance)[:, None] * away).sum(axis=0)).max()
    assert converged
    assert force / len(flat) < 1e-5


def test_across_a_pole_is_at_right_angles_to_it() -> None:
    pole = made_up(count=500).placements[0].target.poles[0]
    centre, axes = across(pole.xyz)
    assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    assert np.abs(axes @ pole.direction).max() < 0.02
    assert np.allclose(centre, pole.point)


def test_cross_sections_only_where_there_is_an_answer() -> None:
    result, (placement,) = made_up(count=500)
    html = cross_sections(result, placement)
    assert Page(html).open == []
    assert html.count("<figure>") == 2
    unsearched = Placement(Scan(placement.target.cloud), placement.source)
    assert cross_sections(result, unsearched) == ""
    refused, (placement,) = made_up("refused", 500)
    assert cross_sections(refused, placement) == ""


def test_a_circle_that_did_not_converge_is_reported_to_be_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result, (placement,) = made_up(count=500)
    assert "did not converge" not in cross_sections(result, placement)
    monkeypatch.setattr(recorded, "fit_circle", lambda *given: (fit_circle(*given)[0], False))
    html = cross_sections(result, placement)
    assert Page(html).text.count("did not converge") == 2
    assert html.count('aria-label="T0–S0') == 1
    assert html.count("unconverged") == 2


def lacking(
    returns: int, away: float = 6.0, code: Code = "too_few_points"
) -> tuple[ResultDoc, Placement]:
    """A refused run whose source sees one pole, and a cluster where its second pole is."""
    result, (placement,) = made_up("refused", 500)
    source = placement.source
    assert source.detection is not None
    first, second = source.detection.poles
    rejected = RejectedCluster(second.index[:returns], second.point, code, "the reason")
    detection = replaced(source.detection, poles=(first,), rejected=(rejected,))
    # The beams start where the cluster is so far away as asked for.
    origin = second.point - away * np.array([1.0, 0.0, 0.0])
    scan = replaced(source, detection=detection, cloud=replaced(source.cloud, origin=origin))
    return result, replaced(placement, source=scan)


def missing_poles(result: ResultDoc, placements: Sequence[Placement]) -> str:
    return missing_poles_of(as_subject(result, placements))


def text_of(result: ResultDoc, *placements: Placement) -> str:
    return Page(missing_poles(result, placements)).text


def test_it_says_how_many_returns_are_missing_and_how_much_nearer_they_are() -> None:
    text = text_of(*lacking(4))
    assert "The source sees 1 of 2 poles" in text
    assert "Pole S0" in text
    assert "60 returns on 9 rings" in text
    assert "4 returns, 6 are needed: if it is your pole, place it 2.0 m nearer." in text
    assert "The target sees" not in text


def test_what_is_too_little_to_go_by_gives_no_number() -> None:
    text = text_of(*lacking(1))
    assert "1 return, 6 are needed: if it is your pole, place it much nearer." in text


def test_rings_are_counted_where_the_cloud_has_them() -> None:
    result, placement = lacking(8, 9.0, "too_few_rows")
    cloud = placement.source.cloud
    assert "the reason" in text_of(result, placement)
    rings = np.arange(len(cloud)) % 2
    with_rings = replaced(placement.source, cloud=replaced(cloud, ring=rings))
    text = text_of(result, replaced(placement, source=with_rings))
    assert "on 2 rings, 3 are needed: if it is your pole, place it 3.0 m nearer." in text


def test_other_reasons_come_with_their_advice() -> None:
    text = text_of(*lacking(8, code="part_of_a_surface"))
    assert "the reason. If it is your pole, a wall" in text


def test_a_cluster_that_stands_elsewhere_is_not_named() -> None:
    result, placement = lacking(4)
    detection = placement.source.detection
    assert detection is not None
    (cluster,) = detection.rejected
    elsewhere = replaced(cluster, centre=cluster.centre + np.array([9.0, 9.0, 0.0]))
    moved = replaced(placement.source, detection=replaced(detection, rejected=(elsewhere,)))
    text = text_of(result, replaced(placement, source=moved))
    assert "4 returns" not in text
    assert "None of the 1 rejected clusters fits that." in text
    assert "below the threshold of 200" in text
    nothing = replaced(placement.source, detection=replaced(detection, rejected=()))
    assert "Nothing else is as bright as tape." in text_of(
        result, replaced(placement, source=nothing)
    )


def test_without_a_pole_the_clusters_of_which_little_was_seen_come_first() -> None:
    result, placement = lacking(4)
    detection = placement.source.detection
    assert detection is not None
    (few,) = detection.rejected
    others = tuple(replaced(few, code="too_wide", reason=f"wide {k}") for k in range(5))
    blind = replaced(detection, poles=(), rejected=(*others, few))
    text = text_of(result, replaced(placement, source=replaced(placement.source, detection=blind)))
    assert "The source sees 0 of 2 poles" in text
    assert text.index("4 returns") < text.index("wide 0")
    assert "3 more bright clusters" in text


def test_nothing_is_reported_where_nothing_is_missing_or_nobody_looked() -> None:
    result, (placement,) = made_up("refused", 500)
    assert missing_poles(result, [placement]) == ""
    unseen = Placement(Scan(placement.target.cloud), Scan(placement.source.cloud))
    assert missing_poles(result, [unseen]) == ""
    answered, placements = made_up("ok", 500)
    assert missing_poles(answered, placements) == ""
    asked = replace(result, config=replace(result.config, poles=3))
    assert text_of(asked, placement).count("2 of 3 poles") == 2
    assert "in placement 2" in text_of(asked, placement, placement)


@pytest.mark.parametrize("name", ["VLP-16", "PandarQT"])
def test_so_much_nearer_a_pole_has_as_many_returns_and_rings_as_are_needed(name: str) -> None:
    """What the page promises, against rays that are cast on a pole from both distances."""
    rng, sensor = np.random.default_rng(4), find_sensor(name)

    def mean_seen(distance: float) -> tuple[float, float]:
        pole = Cylinder(
            np.array([distance, 0.0, 0.0]), np.array([0.0, 0.17, 0.98]), 0.02, 1.0, TAPE
        )
        seen = []
        for _ in range(30):
            turned = se3.from_rt(se3.exp_so3(np.r_[0.05 * rng.normal(size=2), 1.0]), np.zeros(3))
            cloud = scan([pole], sensor, turned, rng, TYPICAL).cloud
            assert cloud.ring is not None
            seen.append((len(cloud), len(np.unique(cloud.ring))))
        points, rings = np.mean(seen, axis=0)
        return float(points), float(rings)

    far = 16.0
    points, rings = mean_seen(far)
    assert points < MIN_POLE_POINTS
    assert mean_seen(far * points / MIN_POLE_POINTS)[0] >= MIN_POLE_POINTS
    if rings < MIN_POLE_RINGS:
        nearer = mean_seen(far * rings / MIN_POLE_RINGS)[1]
        assert nearer == pytest.approx(MIN_POLE_RINGS, rel=0.15)


def test_names_in_it_are_escaped() -> None:
    result, placement = lacking(8, code="too_wide")
    detection = placement.source.detection
    assert detection is not None
    (cluster,) = detection.rejected
    hostile: Detection = replaced(detection, rejected=(replaced(cluster, reason="<b>&"),))
    html = missing_poles(
        result, [replaced(placement, source=replaced(placement.source, detection=hostile))]
    )
    assert re.search("&lt;b&gt;&amp;", html)
