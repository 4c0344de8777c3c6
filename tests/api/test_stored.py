"""The recordings of a stored result: found where they lie, read and searched as its run did."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.api.stored import find_recordings, scans_of
from retropole.base.datatypes import Placement, PointCloud
from retropole.base.errors import ReadError, UsageError
from retropole.io import ARRAY_SOURCE, read_cloud, sha256_of, write_pcd
from retropole.pipeline import Options, calibrate
from retropole.report import render_report
from retropole.result import InputDoc, PolesDoc, ResultDoc, RunConfig, result_document
from retropole.simulation import simulate_pair

FILES = (Path("front.pcd"), Path("rear.pcd"))


class Stored(NamedTuple):
    """A folder with two recordings, and the result of calibrating them by these relative paths."""

    folder: Path
    result: ResultDoc
    placements: tuple[Placement, ...]


def input_document(folder: Path, path: Path, cloud: PointCloud) -> InputDoc:
    return InputDoc(str(path), sha256_of(folder / path), len(cloud), cloud.dropped, "auto", None)


def stored_run(folder: Path) -> Stored:
    pair = simulate_pair(
        "harbor", np.random.default_rng(1), sensor_target="VLP-16", sensor_source="VLP-16"
    )
    for path, cloud in zip(FILES, (pair.target, pair.source), strict=True):
        write_pcd(folder / path, cloud)
    target, source = (read_cloud(folder / path) for path in FILES)
    answer = calibrate(target, source, options=Options(scene=False))
    inputs = [input_document(folder, *each) for each in zip(FILES, (target, source), strict=True)]
    config = RunConfig(refine=False)
    result = result_document(answer, inputs=inputs, config=config, seconds=dict(answer.seconds))
    return Stored(folder, result, answer.placements)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    return stored_run(tmp_path_factory.mktemp("run"))


def find_inputs(result: ResultDoc, beside: Path, given: Sequence[Path] = ()) -> list[Path | None]:
    return [each.path for each in find_recordings(result, beside, given)]


def test_page_of_the_stored_result_is_that_of_the_run(stored: Stored) -> None:
    found = scans_of(stored.result, stored.folder)
    assert found.notes == ()
    page = render_report(stored.result, found.scans)
    assert page == render_report(stored.result, stored.placements)


def test_recordings_are_found_from_here_next_to_the_result_and_by_name(
    stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_inputs(stored.result, stored.folder) == [stored.folder / path for path in FILES]
    monkeypatch.chdir(stored.folder)
    assert find_inputs(stored.result, tmp_path) == list(FILES)
    elsewhere = [replace(item, path=f"/none/{item.path}") for item in stored.result.inputs]
    found = find_inputs(replace(stored.result, inputs=elsewhere), stored.folder)
    assert found == [stored.folder / path for path in FILES]


def test_what_is_given_is_taken_and_what_differs_is_reported(stored: Stored) -> None:
    swapped = [stored.folder / path for path in reversed(FILES)]
    found = scans_of(stored.result, stored.folder, swapped)
    assert len(found.notes) == 2
    for note, path in zip(found.notes, swapped, strict=True):
        assert f"{path} is not the file that the run read" in note
    # The poles found in a wrong cloud are not held against the result's.
    target = found.scans[0][0]
    assert target is not None
    assert target.detection is None
    assert "rms from the surface" not in render_report(stored.result, found.scans)


def test_detection_is_kept_where_its_poles_are_those_of_the_result(stored: Stored) -> None:
    poles = PolesDoc(stored.result.poles.target, stored.result.poles.source[:-1])
    (target,), (source,) = scans_of(replace(stored.result, poles=poles), stored.folder).scans
    assert target is not None
    assert target.detection is not None
    assert source is not None
    assert source.detection is None
    assert len(source.cloud) > 0


def test_several_placements_are_read_pair_by_pair(stored: Stored) -> None:
    inputs = stored.result.inputs
    crossed = replace(stored.result, inputs=[*inputs, inputs[1], inputs[0]])
    target, source = scans_of(crossed, stored.folder).scans
    counts = [[each and len(each.cloud) for each in row] for row in (target, source)]
    assert counts[0] == counts[1][::-1]
    assert target[1] is not None
    assert target[1].detection is not None


def test_frames_of_the_run_are_read(stored: Stored, tmp_path: Path) -> None:
    for path in FILES:
        folder = tmp_path / path.stem
        folder.mkdir()
        for k in range(3):
            cloud = read_cloud(stored.folder / path)
            write_pcd(folder / f"{k}.pcd", cloud.select(np.arange(len(cloud)) % 3 <= k))
    inputs = [replace(item, path=Path(item.path).stem) for item in stored.result.inputs]
    config = RunConfig(refine=False, frames=(1, 2, None))
    frames = replace(stored.result, inputs=inputs, config=config)
    (target,), _ = scans_of(frames, tmp_path).scans
    assert target is not None
    assert len(target.cloud) == len(read_cloud(tmp_path / "front" / "1.pcd"))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_result_without_a_target_and_a_source_is_an_error(stored: Stored, count: int) -> None:
    inputs = (2 * stored.result.inputs)[:count]
    with pytest.raises(ReadError, match=f"names {count} inputs"):
        scans_of(replace(stored.result, inputs=inputs), stored.folder)


def test_a_wrong_number_of_recordings_is_an_error(stored: Stored) -> None:
    with pytest.raises(UsageError, match="1 clouds are given, the result has 2"):
        scans_of(stored.result, stored.folder, [stored.folder / FILES[0]])


def test_a_recording_that_is_gone_is_named(stored: Stored, tmp_path: Path) -> None:
    inputs = [replace(item, path="gone.pcd") for item in stored.result.inputs]
    with pytest.raises(ReadError, match=r"^gone.pcd: not found .*TARGET and SOURCE"):
        scans_of(replace(stored.result, inputs=inputs), tmp_path)


@pytest.mark.parametrize("path", [ARRAY_SOURCE, ""])
def test_an_array_is_not_looked_for_among_the_files(stored: Stored, path: str) -> None:
    result = replace(
        stored.result, inputs=[replace(item, path=path) for item in stored.result.inputs]
    )
    with pytest.raises(ReadError, match=r"was an array.*TARGET and SOURCE"):
        scans_of(result, stored.folder)
    given = [stored.folder / file for file in FILES]
    assert find_inputs(result, stored.folder, given) == given


def test_topics_apply_to_bags_alone(stored: Stored) -> None:
    config = RunConfig(target_topic="/front")
    with pytest.raises(UsageError, match="has no topics"):
        scans_of(replace(stored.result, config=config), stored.folder)
