"""How far surfaces lie apart, in the report: under the true poses little, beside them more."""

import numpy as np
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.datatypes import Array, Placement, Scan
from retropole.report.subject import Subject, as_subject
from retropole.report.surface_distances import distances_of_surfaces, measured_distances
from retropole.simulation import SimulatedPair, simulate_pair
from tests.results import result_of


def subject_of(pair: SimulatedPair, T: Array) -> Subject:
    document = result_of("ok", [], T, np.eye(6) * 1e-6)
    return as_subject(document, [Placement(Scan(pair.target, None), Scan(pair.source, None))])


def test_a_pose_that_is_off_shows_in_the_surfaces() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(100))
    T = pair.T_target_source
    at_truth = {each.kind: each for each in measured_distances(subject_of(pair, T))}
    off = se3.from_rt(se3.exp_so3(np.array([0.002, 0, 0])), np.array([0, 0, 0.02])) @ T
    beside = {each.kind: each for each in measured_distances(subject_of(pair, off))}
    assert at_truth["walls"].median_m < 0.006
    assert beside["ground"].median_m > 0.015
    page = distances_of_surfaces(subject_of(pair, T))
    assert "target–source" in page
    assert f"{1000 * at_truth['walls'].median_m:.1f}" in page


def test_nothing_is_reported_where_there_is_no_pose_or_no_cloud() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(100))
    assert distances_of_surfaces(as_subject(result_of("ok", [], np.eye(4)))) == ""
    subject = subject_of(pair, np.eye(4))
    lidars = [replace(each, T_site_lidar=None) for each in subject.site.lidars]
    refused = Subject(replace(subject.site, lidars=lidars), subject.pair, subject.scans)
    assert distances_of_surfaces(refused) == ""
