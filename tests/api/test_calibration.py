"""`calibrate` answers the same, whatever its clouds come as."""

import json
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import retropole as rp
from retropole.api.options import run_config, with_keywords
from retropole.base import se3
from retropole.result import ResultDoc, encode
from retropole.simulation import place_again
from tests.api.clouds import POLES_ALONE, calibrated, cloud_of, pair, table_of, tables


def assert_same_answer(a: rp.CalibrationResult, b: rp.CalibrationResult) -> None:
    """The same but for where the clouds come from, and when."""
    assert answer_of(a.document) == answer_of(b.document)


def answer_of(document: ResultDoc) -> Any:
    names = ("status", "reasons", "T_target_source", "covariance", "hypotheses", "poles", "stages")
    return [json.loads(encode(document))[name] for name in names]


def test_finds_the_truth() -> None:
    result = rp.calibrate(tables().target, tables().source)
    assert result.status in ("ok", "warn")
    assert result.T_target_source is not None
    apart = se3.difference(result.T_target_source, pair().T_target_source)
    assert np.degrees(apart.rotation) < 0.5
    assert apart.translation < 0.05


@pytest.mark.full
def test_paths_arrays_and_clouds_give_the_same_answer(tmp_path: Path) -> None:
    target, source = tables().target, tables().source
    np.save(tmp_path / "target.npy", target)
    np.save(tmp_path / "source.npy", source)
    expected = calibrated()
    paths = tmp_path / "target.npy", tmp_path / "source.npy"
    for of_target, of_source in (
        paths,
        (str(paths[0]), str(paths[1])),
        (cloud_of(target), cloud_of(source)),
        (rp.read_cloud(paths[0]), source),
        ([target], [source]),
    ):
        assert_same_answer(rp.calibrate(of_target, of_source, options=POLES_ALONE), expected)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.full
def test_points_that_are_not_returns_change_nothing(kind: type[np.floating]) -> None:
    rng = np.random.default_rng(0)

    def with_nonsense(table: NDArray[np.float64]) -> NDArray[np.floating]:
        wrong = np.array([[np.nan, 1, 1, 9], [1, np.inf, 1, 255], [0, 0, 0, 255]])
        rows = rng.integers(0, len(table), 60)
        return np.insert(table, rows, np.resize(wrong, (60, 4)), axis=0).astype(kind)

    clean = [table.astype(kind) for table in (tables().target, tables().source)]
    expected = rp.calibrate(*clean, options=POLES_ALONE)
    dirty = [with_nonsense(table) for table in (tables().target, tables().source)]
    arrays = rp.calibrate(*dirty, options=POLES_ALONE)
    clouds = rp.calibrate(*(cloud_of(table) for table in dirty), options=POLES_ALONE)
    for result in (arrays, clouds):
        assert_same_answer(result, expected)
        assert [each.dropped for each in result.document.inputs] == [60, 60]
        assert [each.points for each in result.document.inputs] == [len(table) for table in clean]


def test_arrays_are_neither_changed_nor_kept() -> None:
    target, source = tables().target.copy(), tables().source.copy()
    result = rp.calibrate(target, source, options=POLES_ALONE)
    np.testing.assert_array_equal(target, tables().target)
    assert result.placements is not None
    for scan in (result.placements[0].target, result.placements[0].source):
        assert not np.shares_memory(scan.cloud.xyz, target)
        assert not np.shares_memory(scan.cloud.intensity, target)


def test_options_reach_the_run_and_its_document() -> None:
    result = rp.calibrate(
        tables().target,
        tables().source,
        radius=0.03,
        sensor=("VLP-16", "auto"),
        threshold=(None, 180.0),
        poles=2,
        need=0.001,
        at=10.0,
        up=True,
        options=rp.RunConfig(radius_sigma_m=0.001, refine=False, prior_sigma_deg=20.0),
    )
    config = result.document.config
    assert (config.need_m, config.at_m) == (0.001, 10.0)
    assert result.fitness is not None
    assert (result.fitness.within_m, result.fitness.at_m) == (0.001, 10.0)
    assert "within 0.1 cm at 10 m: no" in repr(result)
    assert "not_fit_for_purpose" in [reason.code for reason in result.reasons]
    assert (config.radius_m, config.radius_sigma_m, config.poles) == (0.03, 0.001, 2)
    assert (config.up, config.prior_sigma_deg, config.refine) == (True, 20.0, False)
    assert (config.sensor_target, config.sensor_source) == ("VLP-16", "auto")
    target, source = result.document.inputs
    assert (target.sensor, source.sensor, source.threshold) == ("VLP-16", "auto", 180.0)
    assert result.document.stages.refined is None


@pytest.mark.full
def test_a_hypothesis_that_is_taken_by_hand_is_recorded() -> None:
    by_scene = rp.calibrate(tables().target, tables().source, options=POLES_ALONE)
    by_hand = rp.calibrate(
        tables().target, tables().source, options=rp.RunConfig(refine=False, hypothesis="a")
    )
    assert by_hand.document.config.hypothesis == "a"
    assert [each.chosen for each in by_hand.document.hypotheses].index(True) == 0
    assert (by_hand.status, by_hand.reasons[0].code) == ("warn", "chosen_by_hand")
    np.testing.assert_array_equal(by_hand.required_transform(), by_scene.required_transform())
    with pytest.raises(rp.UsageError, match="no hypothesis 'y'"):
        rp.calibrate(
            tables().target,
            tables().source,
            options=rp.RunConfig(refine=False, hypothesis="y"),
        )


def test_steps_are_named_as_they_start() -> None:
    steps: list[str] = []
    result = rp.calibrate(
        tables().target, tables().source, options=POLES_ALONE, progress=steps.append
    )
    assert steps[:2] == ["read", "extract"]
    assert set(steps) == set(result.document.seconds)


@pytest.mark.full
def test_several_placements_give_one_answer() -> None:
    other = place_again(pair(), np.random.default_rng(3))
    targets = [tables().target, table_of(other.target)]
    sources = (tables().source, table_of(other.source))
    result = rp.calibrate(targets, sources, options=POLES_ALONE)
    assert len(result.document.inputs) == 4
    assert len(result.document.placements) == 2
    with pytest.raises(rp.UsageError, match="2 targets and 1 source are"):
        rp.calibrate(targets, [tables().source])
    with pytest.raises(rp.UsageError, match="0 targets"):
        rp.calibrate([], [])
    with pytest.raises(rp.UsageError, match=r"source of placement 2: .*\(5, 2\)"):
        rp.calibrate(targets, [tables().source, np.ones((5, 2))])


def test_without_intensity_it_is_refused_and_says_what_to_give() -> None:
    result = rp.calibrate(tables().target, tables().source[:, :3])
    assert result.status == "refused"
    assert result.T_target_source is None
    (reason,) = result.reasons
    assert reason.code == "no_intensity"
    assert "(N, 4)" in reason.message


@pytest.mark.full
def test_of_a_file_without_intensity_no_array_is_requested(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", tables().target[:, :3])
    (reason,) = rp.calibrate(tmp_path / "a.npy", tables().source).reasons
    assert reason.code == "no_intensity"
    assert "(N, 4)" not in reason.message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0, expected a number from 0.002 to 0.25 m"),
        ({"radius": 0.3}, "radius is 0.3, expected a number from 0.002 to 0.25 m"),
        ({"radius": 1e9}, r"radius is 1000000000\.0, expected a number from 0.002 to 0.25 m"),
        ({"radius": 20}, r"radius is 20: 20 m is not the radius of a pole; 20 mm\? give 0\.02"),
        ({"radius": "20"}, r"20 mm\? give 0\.02"),
        ({"radius": 2.0}, r"2 m is not the radius of a pole; 2 cm\? give 0\.02"),
        ({"radius": 150.0}, r"150 m is not the radius of a pole; 150 mm\? give 0\.15"),
        ({"radius": float("nan")}, "radius is nan"),
        ({"radius_sigma": -1.0}, "radius_sigma is -1.0, expected a number from 0 to 0.25 m"),
        ({"need": 0.0}, "need is 0.0, expected a number above 0, 10 m at most"),
        ({"need": 0.02, "at": float("inf")}, "at is inf"),
        ({"at": 30.0}, "at is the distance up to which"),
        ({"poles": -1}, "poles is -1, expected a number from 0 to 9007199254740992"),
        ({"prior_sigma_deg": 0.0}, "prior_sigma_deg is 0.0"),
        ({"prior_sigma_deg": float("inf")}, "prior_sigma_deg is inf"),
        ({"up": True, "prior_rpy_deg": (0.0, 0.0, 0.0)}, "exclude each other"),
        ({"sensor_target": "nonsense"}, "no sensor is named 'nonsense'"),
        (
            {"target_topic": "/front"},
            "target: a topic, frames, intensity and angles can be chosen in files",
        ),
        (
            {"frames": slice(0, 2)},
            "target: a topic, frames, intensity and angles can be chosen in files",
        ),
        ({"hypothesis": "first"}, "hypothesis is 'first', expected a letter from the list"),
        ({"hypothesis": 1}, "hypothesis is 1, expected a letter from the list"),
        ({"radius": "thick"}, "wrong type"),
        ({"sensor": ("XT32", "XT32", "XT32")}, "sensor: one value for both LiDARs"),
        ({"options": {"refine": False}}, "options is {'refine': False}, expected a RunConfig"),
        ({"poles": 2.5}, "wrong type"),
        ({"frames": 3}, "wrong type"),
        ({"prior_rpy_deg": (0.0, 1.0)}, "wrong type"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*through options, or as sensor:DeprecationWarning")
def test_options_that_make_no_sense(options: dict[str, object], message: str) -> None:
    with pytest.raises(rp.UsageError, match=message):
        rp.calibrate(tables().target, tables().source, **options)  # type: ignore[arg-type]


@pytest.mark.full
def test_numbers_of_numpy_are_as_good(tmp_path: Path) -> None:
    options = {"radius": 0.02, "poles": 2, "threshold": 150.0}
    expected = rp.calibrate(tables().target, tables().source, options=POLES_ALONE, **options)  # type: ignore[arg-type]
    result = rp.calibrate(
        tables().target,
        tables().source,
        options=rp.RunConfig(refine=np.bool_(False)),  # type: ignore[arg-type]
        radius=np.float64(0.02),
        poles=np.int64(2),  # type: ignore[arg-type]
        threshold=np.float32(150),  # type: ignore[arg-type]
    )
    assert_same_answer(result, expected)
    result.save(tmp_path)
    assert rp.load_result(tmp_path).document == result.document
    prior = rp.calibrate(
        tables().target,
        tables().source,
        options=rp.RunConfig(refine=False, prior_rpy_deg=(np.float64(0), 0.0, 0.0)),
    )
    prior.save(tmp_path)
    assert rp.load_result(tmp_path).document == prior.document


def test_keywords_come_before_options_and_are_few() -> None:
    others = rp.RunConfig(radius_m=0.03, poles=3, unit="cm", sensor_source="XT32")
    keywords = {"radius": 0.025, "sensor": ("VLP-16", None), "up": None, "unit": None}
    config = with_keywords(others, keywords, {})
    assert (config.radius_m, config.poles, config.unit, config.up) == (0.025, 3, "cm", False)
    assert (config.sensor_target, config.sensor_source) == ("VLP-16", "auto")
    assert with_keywords(others, {"sensor": "HAP"}, {}).sensor_source == "HAP"
    parameters = signature(rp.calibrate).parameters.values()
    assert sum(each.kind is each.KEYWORD_ONLY for each in parameters) == 12


def test_former_keywords_work_with_a_warning_and_others_do_not() -> None:
    former = {"sensor_target": "HAP", "refine": False, "unit_source": "mm"}
    with pytest.warns(DeprecationWarning, match="sensor_target, refine, unit_source: give them"):
        config = with_keywords(rp.RunConfig(), {"unit": "m"}, former)
    assert config == rp.RunConfig(sensor_target="HAP", refine=False, unit_source="mm")
    with pytest.raises(TypeError, match="unexpected keyword argument: radios"):
        rp.calibrate(tables().target, tables().source, radios=0.02)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(rp.ReadError, match=r"absent\.pcd"):
        rp.calibrate(tmp_path / "absent.pcd", tmp_path / "absent.pcd")


def test_a_sensor_that_does_not_see_so_much_is_doubted() -> None:
    given = tables().target, tables().source
    result = rp.calibrate(
        *given, options=POLES_ALONE, sensor=("Mid-360", "auto"), threshold=(120, None)
    )
    assert result.status == "warn"
    (reason,) = (each for each in result.reasons if each.code == "sensor_doubtful")
    assert "outside the field of view of the Mid-360 (-7.0° to 52.0°)" in reason.message
    assert reason.values["lidar"] == "target"


@pytest.mark.full
def test_arrays_of_any_unit() -> None:
    per_metre = np.array([1000.0, 1000.0, 1000.0, 1.0])
    given = per_metre * tables().target, tables().source
    result = rp.calibrate(*given, options=POLES_ALONE, unit=("mm", "m"))
    np.testing.assert_allclose(
        result.required_transform(), calibrated().required_transform(), atol=1e-3
    )
    assert result.document.config.unit == "mm"
    with pytest.raises(rp.UsageError, match="unit is 'km', expected m, cm, mm"):
        rp.calibrate(*given, unit="km")


def test_the_same_array_twice_is_refused() -> None:
    result = rp.calibrate(tables().target, tables().target.copy())
    assert [reason.code for reason in result.reasons] == ["same_recording"]
    assert result.T_target_source is None


def test_the_file_of_a_sensor_is_found_from_elsewhere_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = run_config({"sensor_target": "front.toml", "sensor_source": "VLP-16"})
    assert config.sensor_target == str(tmp_path / "front.toml")
    assert config.sensor_source == "VLP-16"


@pytest.mark.full
def test_a_stated_sway_widens_what_is_stated_and_is_reported() -> None:
    both = tables()
    still = rp.calibrate(both.target, both.source)
    swaying = rp.calibrate(both.target, both.source, options=rp.RunConfig(mast_sway_deg=0.1))
    assert still.T_target_source is not None
    assert swaying.T_target_source == pytest.approx(still.T_target_source, rel=1e-6, abs=1e-8)
    assert "sways" not in [note.code for note in still.notes]
    assert [note.code for note in swaying.notes].count("sways") == 2
    at = [[e.sigma_m for e in each.document.predicted_error or []][-1] for each in (still, swaying)]
    # At 60 m two masts that turn by 0.1° about any axes: 60 · 0.0017 · √(2 · 2 / 2) m.
    assert 0.147 < at[1] < 0.157
    assert at[0] < 0.08
    with pytest.raises(rp.UsageError, match="mast_sway_deg"):
        rp.calibrate(both.target, both.source, options=rp.RunConfig(mast_sway_deg=7.0))
