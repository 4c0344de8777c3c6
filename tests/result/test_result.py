"""The result document: what it promises other programs."""

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from retropole.base.datatypes import Calibration
from retropole.base.errors import ReadError
from retropole.pipeline import Options, calibrate
from retropole.result import InputDoc, ResultDoc, RunConfig, encode, result_document
from retropole.result.decoding import decode
from retropole.simulation import simulate_pair

INPUTS = [InputDoc(f"{name}.pcd", "0" * 64, 100, 3, "auto", 120.0) for name in ("a", "b")]


@pytest.fixture(scope="module")
def answer() -> Calibration:
    pair = simulate_pair("street", np.random.default_rng(3))
    return calibrate(pair.target, pair.source)


@pytest.fixture(scope="module")
def refusal() -> Calibration:
    pair = simulate_pair("street", np.random.default_rng(3))
    assert pair.source.intensity is not None
    dark = replace(pair.source, intensity=np.minimum(pair.source.intensity, 60.0))
    return calibrate(pair.target, dark, options=Options(thresholds=(None, 100.0)))


def document(calibration: Calibration) -> ResultDoc:
    return result_document(
        calibration,
        inputs=INPUTS,
        config=RunConfig(radius_m=0.03, frames=(0, None, 2)),
        seconds={"read": 1.0},
    )


@pytest.mark.full
def test_it_reads_back_as_it_was_written(answer: Calibration) -> None:
    written = document(answer)
    assert encode(decode(encode(written))) == encode(written)
    assert decode(encode(written)) == written
    assert decode(encode(written)) != msgspec.structs.replace(written, margin=0.123)
    np.testing.assert_array_equal(written.T_target_source, answer.T_target_source)


@pytest.mark.full
def test_names_that_others_rely_on(answer: Calibration) -> None:
    plain = json.loads(encode(document(answer)))
    assert plain["schema"] == "retropole/result/1"
    assert set(plain) >= {
        *("status", "reasons", "T_target_source", "covariance", "covariance_order"),
        *("covariance_frame", "predicted_error", "stages", "hypotheses", "margin", "poles"),
        *("inputs", "config", "version", "created", "seconds"),
    }
    assert [e["range_m"] for e in plain["predicted_error"]] == [1, 10, 30, 60]
    assert set(plain["stages"]) == {"poles", "refined"}
    for name in plain["stages"]:
        assert {"T_target_source", "covariance", "rms_m"} <= set(plain["stages"][name])
    assert {
        *("pairs", "T_target_source", "pole_rms_m", "icp_rotation_rad", "icp_translation_m"),
        *("overlap", "free_space", "score", "chosen"),
    } <= set(plain["hypotheses"][0])
    assert {"point_m", "direction", "length_m", "points", "rms_m"} <= set(
        plain["poles"]["target"][0]
    )
    assert {"path", "sha256", "points", "dropped", "sensor", "threshold"} <= set(plain["inputs"][0])


def test_numbers_are_sound(answer: Calibration) -> None:
    plain = json.loads(encode(document(answer)))
    T, covariance = np.array(plain["T_target_source"]), np.array(plain["covariance"])
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0
    np.testing.assert_allclose(covariance, covariance.T)
    chosen = [h["chosen"] for h in plain["hypotheses"]]
    assert chosen == [True] + [False] * (len(chosen) - 1)


def test_a_refusal_holds_no_transform(refusal: Calibration) -> None:
    plain = json.loads(encode(document(refusal)))
    assert plain["status"] == "refused"
    assert plain["reasons"]
    for name in ("T_target_source", "covariance", "predicted_error"):
        assert plain[name] is None
    assert plain["stages"] == {"poles": None, "refined": None}
    assert not any(h["chosen"] for h in plain["hypotheses"])
    assert b"NaN" not in encode(document(refusal))


def test_another_schema_is_refused(answer: Calibration) -> None:
    data = encode(document(answer)).replace(b"retropole/result/1", b"retropole/result/2")
    with pytest.raises(ReadError, match="schema"):
        decode(data)


@pytest.mark.parametrize("damage", [b"{}", b"[1]", b'{"schema": "other/1"}', b"nonsense"])
def test_other_documents_are_not_taken_for_results(damage: bytes) -> None:
    with pytest.raises(ReadError):
        decode(damage)
