"""``retropole check`` as a user runs it."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.result import encode
from retropole.simulation import simulate_pair, write_pair
from tests.cli.commands import retropole_here
from tests.export.sites import free
from tests.tiers import first_of

SMALL_ROTATION = np.r_[0.0, 0, np.radians(0.3), 0, 0, 0]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    first, rng = np.random.default_rng(1), np.random.default_rng(17)
    street = simulate_pair("street", first, sensor_target="VLP-16", sensor_source="VLP-16")
    write_pair(street, folder / "first")
    write_pair(record_again(street, rng, poles=False), folder / "same")
    write_pair(record_again(street, rng, moved=SMALL_ROTATION, poles=False), folder / "moved")
    done = retropole_here(
        "calibrate", "first/lidar0.pcd", "first/lidar1.pcd", "--out", "r", "-q", cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return folder


def run(site: Path, result: str, recording: str, *words: str) -> tuple[int, str]:
    files = f"{recording}/lidar0.pcd", f"{recording}/lidar1.pcd"
    done = retropole_here("check", result, *files, *words, cwd=site)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout


@pytest.mark.full
def test_exit_codes_and_words(site: Path) -> None:
    code, text = run(site, "r", "same")
    assert code == 0, text
    assert text.startswith("verdict: same within 0.30° and 30 mm\n")
    assert "scene check under the stored pose: " in text
    code, text = run(site, "r/result.json", "moved")
    assert code == 4, text
    assert "about the target's +z (yaw)" in text
    assert "found by the scene alone" in text
    assert "recordings_of_result" not in text
    code, text = run(site, "r", "first")
    assert code == 0, text
    assert "recordings_of_result: RESULT was computed from these recordings" in text
    assert run(site, "r", "missing") == (2, "")
    assert run(site, "missing", "same") == (2, "")
    assert run(site, "r", "same", "--sigma-deg", "1")[0] == 2
    assert run(site, "r", "same", "-q") == (0, "")


@pytest.mark.parametrize(("recording", "status"), first_of([("same", "same"), ("moved", "moved")]))
@pytest.mark.full
def test_json_is_one_line(site: Path, recording: str, status: str) -> None:
    _, text = run(site, "r", recording, "--json")
    assert text.count("\n") == 1
    answer = json.loads(text)
    assert answer["status"] == status
    assert answer["used"] == "scene"
    assert answer["confirmation"]["agreeing"] > 100
    assert answer["confirmation"]["contradicted"] < 0.05
    assert 0 <= answer["p_value"] <= 1
    assert answer["sigma_deg"] > 0
    assert answer["sigma_m"] > 0
    assert answer["moved_deg"] == pytest.approx(0.3 if status == "moved" else 0.0, abs=0.05)
    within = (None, None) if status == "moved" else (pytest.approx(0.3), 0.03)
    assert (answer["tolerance_deg"], answer["tolerance_m"]) == within
    assert answer["power"] > 0.95


@pytest.mark.full
def test_a_tolerance_that_was_requested_is_held_to(site: Path) -> None:
    weak = ("r.json", "same", "--sigma-deg", "0.02", "--sigma-m", "0.02")
    words = ("--to", "json", "--out", "r.json")
    assert retropole_here("export", "r", *words, cwd=site).returncode == 0
    code, text = run(site, *weak, "--json")
    answer = json.loads(text)
    assert (code, answer["status"]) == (0, "same")
    assert "wider_tolerance" in [reason["code"] for reason in answer["reasons"]]
    told = answer["tolerance_m"]
    assert 0.03 < told < 0.1
    assert answer["power"] < 0.95
    code, text = run(site, *weak)
    assert text.startswith("verdict: same within 0.30° and ")
    assert "wider_tolerance: the same within 0.30° and " in text
    code, text = run(site, *weak, "--tolerance-m", "0.03", "--json")
    answer = json.loads(text)
    assert (code, answer["status"], answer["tolerance_m"]) == (3, "cannot_tell", told)
    assert "too_weak" in [reason["code"] for reason in answer["reasons"]]
    code, text = run(site, *weak, "--tolerance-m", "0.09", "--json")
    answer = json.loads(text)
    assert (code, answer["status"], answer["tolerance_m"]) == (0, "same", 0.09)


@pytest.mark.full
def test_a_transform_without_covariance_needs_its_sigmas(site: Path) -> None:
    words = ("--parent", "front", "--child", "rear", "--out", "r.urdf")
    assert retropole_here("export", "r", "--to", "urdf", *words, cwd=site).returncode == 0
    code, text = run(site, "r.urdf", "same", "--json")
    assert code == 3
    answer = json.loads(text)
    assert answer["status"] == "cannot_tell"
    assert answer["moved_deg"] is None
    assert answer["confirmation"] is None
    assert [reason["code"] for reason in answer["reasons"]] == ["stored_no_covariance"]
    assert run(site, "r.urdf", "same", "--sigma-deg", "0.01", "--sigma-m", "0.002", "-q")[0] == 0
    assert run(site, "r.urdf", "same", "--sigma-deg", "1", "--sigma-m", "0.1", "-q")[0] == 3


@pytest.mark.full
def test_an_inverted_export_is_inverted_again(site: Path) -> None:
    words = ("--to", "json", "--invert", "--out", "inverted.json")
    assert retropole_here("export", "r", *words, cwd=site).returncode == 0
    assert run(site, "inverted.json", "same", "-q")[0] == 0


@pytest.mark.full
def test_a_refused_result_cannot_tell(site: Path) -> None:
    files = "same/lidar0.pcd", "same/lidar1.pcd"
    assert retropole_here("calibrate", *files, "--out", "refused", "-q", cwd=site).returncode == 3
    code, text = run(site, "refused", "same", "--json")
    assert code == 3
    assert json.loads(text)["reasons"][0]["code"].startswith("stored_")


@pytest.mark.full
def test_the_stored_run_reports_its_options_and_warnings(site: Path) -> None:
    result = json.loads((site / "r" / "result.json").read_text())
    # A topic is of bags: it is left alone where the new recordings are files.
    result["config"]["target_topic"] = "/front"
    result["reasons"] = [{"code": "small_margin", "message": "leads by 0.05", "values": {}}]
    (site / "told.json").write_text(json.dumps(result))
    code, text = run(site, "told.json", "same")
    assert code == 0, text
    assert "stored_small_margin: leads by 0.05" in text
    result["config"]["sensor_source"] = "nonsense"
    (site / "wrong.json").write_text(json.dumps(result))
    assert run(site, "wrong.json", "same") == (2, "")
    for words in (("--topic", "/front"), ("--angles", "a.csv"), ("--intensity", "range")):
        assert run(site, "r", "same", *words) == (2, "")
    assert run(site, "r", "same", "--intensity", "Intensity", "-q") == (0, "")


@pytest.mark.full
def test_of_a_result_without_both_kinds_of_error_nothing_cancels(site: Path) -> None:
    result = json.loads((site / "r" / "result.json").read_text())
    assert result.pop("uncertainty") is not None
    (site / "old.json").write_text(json.dumps(result))
    new, old = (json.loads(run(site, name, "same", "--json")[1]) for name in ("r", "old.json"))
    assert new["moved_m"] == pytest.approx(old["moved_m"])
    # What both calibrations share cancels; most of what is left is random.
    assert 0.5 * old["sigma_m"] < new["sigma_m"] < 0.98 * old["sigma_m"]
    assert new["chi2"] > old["chi2"]
    # What is said of the stored pose by hand comes from elsewhere, and counts whole.
    words = ("--sigma-deg", "0.02", "--sigma-m", "0.003", "--json")
    given = json.loads(run(site, "r", "same", *words)[1])
    assert given["sigma_m"] > 0.003


@pytest.mark.full
def test_help_has_worked_examples(site: Path) -> None:
    done = retropole_here("check", "--help", cwd=site)
    assert done.returncode == 0
    assert "retropole check " in done.stdout.split("Examples:")[1]


@pytest.mark.full
def test_of_a_site_two_lidars_are_named(site: Path, tmp_path: Path) -> None:
    document = free()
    lidars = [msgspec.structs.replace(lidar, sensor="auto") for lidar in document.lidars]
    of_site = msgspec.structs.replace(document, lidars=lidars)
    (tmp_path / "site-result.json").write_bytes(encode(of_site))
    code, _ = run(site, str(tmp_path), "same")
    assert code == 2
    files = "same/lidar0.pcd", "same/lidar1.pcd"
    done = retropole_here("check", tmp_path, *files, cwd=site)
    assert "name two of its LiDARs" in done.stderr
    assert "it has mast-a, mast-b, gate" in done.stderr
    assert run(site, str(tmp_path), "same", "--parent", "mast-a")[0] == 2
    # Another place than that of the made-up site.
    words = ("--parent", "mast-a", "--child", "gate", "--json")
    code, text = run(site, str(tmp_path), "same", *words)
    assert code in (3, 4)
    assert json.loads(text)["status"] in ("cannot_tell", "moved")
    done = retropole_here("evaluate", *files, "--transform", tmp_path, *words, cwd=site)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["confirmation"]["contradicted"] > 0.05
