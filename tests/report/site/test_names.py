"""Placements and poles are told by their numbers, from 1, as everywhere on paper."""

from __future__ import annotations

from retropole.report.site.names import placement_name, pole_labels
from tests.report.site.made_up import document_of, made_up_site


def test_a_placement_has_its_number_and_its_name_once() -> None:
    names = ["morning", "2", ""]
    assert [placement_name(names, j) for j in range(3)] == ["1: morning", "2", "3"]


def test_poles_are_counted_in_each_placement() -> None:
    document = document_of(made_up_site(lidars=3, placements=2, count=10))
    assert pole_labels(document) == ["1.1", "1.2", "2.1", "2.2"]
