"""Names of poles, pairs, hypotheses and inputs."""

from __future__ import annotations

from msgspec.structs import replace

from retropole.report.names import hypothesis_name, input_names, pair_name, pole_name
from retropole.result import RunConfig
from tests.report.made_up import made_up


def test_hypotheses_have_letters_and_no_two_the_same() -> None:
    names = [hypothesis_name(k) for k in range(60)]
    assert names[:3] == ["a", "b", "c"]
    assert len(set(names)) == 60


def test_poles_and_pairs_say_which_lidar() -> None:
    assert (pole_name("target", 0), pole_name("source", 12)) == ("T0", "S12")
    assert pair_name((0, 1)) == "T0–S1"


def test_inputs_are_named_by_file_and_topic() -> None:
    result = made_up(count=500).result
    assert input_names(result) == ["front.pcd", "rear.pcd"]
    config = RunConfig(target_topic="/a", source_topic="/b")
    named = input_names(replace(result, config=config, inputs=2 * result.inputs))
    assert named == ["front.pcd /a", "rear.pcd /b", "front.pcd /a", "rear.pcd /b"]
