"""Result documents that were edited: every fault is an error that names its field."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import NewerError, ReadError, is_newer
from retropole.result import encode
from retropole.result.decoding import decode, decode_site
from tests.report.made_up import made_up

WHOLE = json.loads(encode(made_up("ok", 100).result))


def changed(way: str, value: Any) -> bytes:
    """Change one field of a whole document; ``a.0.b`` is the way to it."""
    document = json.loads(json.dumps(WHOLE))
    *before, last = [int(key) if key.isdigit() else key for key in way.split(".")]
    place = document
    for key in before:
        place = place[key]
    place[last] = value
    return json.dumps(document).encode()


def test_a_document_of_a_newer_version_says_to_update() -> None:
    for known in ("retropole/result/1", "retropole/site-result/1"):
        kind = known.rpartition("/")[0]
        assert all(is_newer(f"{kind}/{n}", known) for n in ("2", "10", "9" * 5000, "02"))
        assert not any(is_newer(f"{kind}/{n}", known) for n in ("1", "0", "01", "x", "", "-2", "²"))
        assert not is_newer(f"x{kind}/2", known)
    for read, schema in ((decode, "retropole/result"), (decode_site, "retropole/site-result")):
        for text in ({"schema": f"{schema}/2"}, {"schema": f"{schema}/3", "new": [1]}):
            with pytest.raises(NewerError, match=r"update this one") as caught:
                read(json.dumps(text).encode())
            assert f"{schema}/" in str(caught.value)
        with pytest.raises(ReadError, match="no result document") as said:
            read(json.dumps({"schema": f"{schema}/0"}).encode())
        assert not isinstance(said.value, NewerError)


def test_a_whole_document_is_read() -> None:
    assert encode(decode(encode(made_up("ok", 100).result))) == encode(made_up("ok", 100).result)


@pytest.mark.parametrize(
    ("way", "value", "field"),
    [
        ("T_target_source", np.diag([1.0, 1.0, -1.0, 1.0]).tolist(), "T_target_source"),
        ("T_target_source", None, "T_target_source"),
        ("T_target_source.0.3", 1e308, "T_target_source"),
        ("T_target_source.3", [0, 0, 0, 2], "T_target_source"),
        ("status", "perfect", "status"),
        ("status", "refused", "T_target_source"),
        ("covariance", (-1e-4 * np.eye(6)).tolist(), "covariance"),
        ("covariance", np.zeros((6, 6)).tolist(), "covariance"),
        ("covariance", np.eye(5).tolist(), "covariance"),
        ("covariance.0.0", "1", "covariance"),
        ("covariance_order", ["x", "y", "z", "phi_x", "phi_y", "phi_z"], "covariance_order"),
        ("uncertainty.systematic.2.2", -1.0, "uncertainty.systematic"),
        ("stages.poles.T_target_source.0.0", 3.0, "stages.poles.T_target_source"),
        ("hypotheses.0.pairs", [[0, 99]], "hypotheses[0].pairs"),
        ("hypotheses.1.chosen", True, "hypotheses"),
        ("poles.target.0.direction", [1.0, 0.0], "poles.target[0].direction"),
        ("poles.target.0.direction", [1.0, 0.0, True], "poles.target[0].direction"),
        ("weakest.direction", [[0.0, 0.0, 1.0]], "weakest.direction"),
        ("T_target_source.1", "0 1 0 0", "T_target_source"),
        ("stages.poles.covariance", np.zeros((6, 6)).tolist(), "stages.poles.covariance"),
        ("uncertainty.random.3", [1.0], "uncertainty.random"),
        ("radius.given_m", -0.02, "radius.given_m"),
        ("confirmation.contradicted", 2.0, "confirmation.contradicted"),
        ("predicted_error.0.sigma_m", -1, "predicted_error"),
        ("confirmation.agreeing", -1, "confirmation"),
        ("config.radius_m", 1e300, "config.radius_m"),
        ("reasons", [{"code": "No Code", "message": "", "values": {}}], "reasons[0].code"),
        ("reasons", [{"code": "a", "message": "", "values": {"b": 10**40}}], "reasons[0].values"),
        ("created", "x" * 20_000, "created"),
    ],
)
def test_a_fault_names_its_field(way: str, value: Any, field: str) -> None:
    with pytest.raises(ReadError) as caught:
        decode(changed(way, value))
    assert field in str(caught.value)


@pytest.mark.parametrize("data", [b"[" * 200_000, b'{"a":' * 100_000, b"\xff", b"", b"1e999"])
def test_what_is_no_document_is_an_error(data: bytes) -> None:
    with pytest.raises(ReadError):
        decode(data)


def test_a_code_of_another_version_is_taken() -> None:
    reasons = [{"code": "some_new_code", "message": "why", "values": {"n": 1}}]
    assert decode(changed("reasons", reasons)).reasons[0].code == "some_new_code"
