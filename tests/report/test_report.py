"""The report is one file that opens offline, says all the result says, and runs nothing of it."""

from __future__ import annotations

import ast
import base64
import copy
import json
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retropole import se3
from retropole.datatypes import Detection, Placement, PointCloud, Pole, RejectedCluster
from retropole.export import export_lines
from retropole.report import render_report, write_report
from retropole.report.advice import ADVICE
from retropole.report.crosssections import across, fit_circle
from retropole.report.points import COORDINATE_STEPS, MAX_SHOWN_RANGE, pack_cloud
from retropole.report.render import MAX_PAGE_POINTS_TOGETHER, embed_json
from retropole.report.sections import FRAMES, centimetres
from tests.paths import PACKAGE

T_TRUE = se3.from_rt(
    Rotation.from_euler("xyz", [3.0, -2.0, 38.0], degrees=True).as_matrix(),
    np.array([-0.6, 1.9, 0.25]),
)
POLES = (  # foot on the ground and direction, target frame
    (np.array([4.2, 1.1, -1.4]), np.array([0.18, 0.10, 1.0])),
    (np.array([4.6, -1.5, -1.4]), np.array([-0.12, -0.22, 1.0])),
)


def scene(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ground, boxes and walls as one LiDAR 1.4 m up would crowd them, and their intensity."""
    n = count // 5
    r, a = 2.0 + 26 * rng.random(2 * n) ** 1.8, 2 * np.pi * rng.random(2 * n)
    ground = np.c_[r * np.cos(a), r * np.sin(a), -1.4 + 0.01 * rng.standard_normal(2 * n)]
    wall = np.c_[np.full(n, 11.0), rng.uniform(-9, 14, n), rng.uniform(-1.4, 2.2, n)]
    side = np.c_[rng.uniform(-7, 11, n), np.full(n, -9.0), rng.uniform(-1.4, 1.8, n)]
    box = rng.uniform(-1, 1, (count - 4 * n, 3)) * [1.1, 0.8, 0.7]
    face = rng.integers(0, 3, len(box))
    box[np.arange(len(box)), face] = (
        np.where(rng.random(len(box)) < 0.5, -1, 1) * np.array([1.1, 0.8, 0.7])[face]
    )
    box += np.where(rng.random(len(box))[:, None] < 0.5, [6.5, 5.0, -0.7], [1.0, -5.5, -0.7])
    xyz = np.r_[ground, wall, side, box]
    return xyz, np.r_[rng.uniform(5, 30, 2 * n), rng.uniform(20, 90, len(xyz) - 2 * n)]


def observed(T_target_lidar: np.ndarray, seed: int, count: int) -> tuple[PointCloud, Detection]:
    """One LiDAR's cloud of the scene, with two poles and a bright plate found in it."""
    rng = np.random.default_rng(seed)
    xyz, intensity = scene(rng, count)
    T_lidar_target = se3.inverse(T_target_lidar)
    parts = [xyz]
    poles, start = [], len(xyz)
    for foot, leaning in POLES:
        n = leaning / np.linalg.norm(leaning)
        s = np.sort(rng.uniform(0.1, 1.7, 60))
        points = foot + s[:, None] * n + 0.006 * rng.standard_normal((60, 3))
        parts.append(points)
        seen = se3.apply(T_lidar_target, points)
        index = np.arange(start, start + 60)
        start += 60
        direction = T_lidar_target[:3, :3] @ n
        poles.append(Pole(seen.mean(axis=0), direction, seen, 1.6, 0.0061, 9, index))
    plate = np.array([10.9, 3.0, 0.4]) + rng.uniform(-1, 1, (40, 3)) * [0.01, 0.4, 0.3]
    index = np.arange(start, start + 40)
    rejected = RejectedCluster(
        index,
        se3.apply(T_lidar_target, plate).mean(axis=0),
        "too_wide",
        "0.81 m wide, a pole of radius 0.02 m is at most 0.12 m",
    )
    xyz = se3.apply(T_lidar_target, np.r_[xyz, *parts[1:], plate])
    intensity = np.r_[intensity, np.full(len(xyz) - len(intensity), 250.0)]
    cloud = PointCloud(xyz, intensity)
    return cloud, Detection(tuple(poles), (rejected,), 200.0, "auto", 160)


def pole_document(pole: Pole) -> dict[str, Any]:
    return {
        "point_m": pole.point.tolist(),
        "direction": pole.direction.tolist(),
        "length_m": pole.length,
        "points": len(pole.xyz),
        "rings": pole.rings,
        "rms_m": pole.rms,
    }


def half_turns() -> list[np.ndarray]:
    """Identity and the half turns about the common perpendicular and the bisectors."""
    (p, a), (q, b) = ((f + 0.8 * n, n / np.linalg.norm(n)) for f, n in POLES)
    axes = [np.cross(a, b), a + b, a - b]
    turns = [np.eye(4)]
    for axis in axes:
        R = Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
        middle = (p + q) / 2
        turns.append(se3.from_rt(R, middle - R @ middle))
    return turns


def made_up(
    status: str = "ok", count: int = 4000
) -> tuple[dict[str, Any], PointCloud, PointCloud, tuple[Detection, Detection]]:
    """A result document as a run writes it, and its clouds."""
    target, found_target = observed(np.eye(4), 1, count)
    source, found_source = observed(T_TRUE, 2, count)
    figures = [(0.81, 0.02, 0.79, 0.021, 0.031), (0.44, 0.16, 0.28, 0.61, 0.92)]
    figures += [(0.41, 0.22, 0.19, 1.32, 4.10), (0.28, 0.31, -0.03, 1.71, 7.45)]
    hypotheses = [
        {
            "pairs": [[0, 0], [1, 1]] if k in (0, 3) else [[0, 1], [1, 0]],
            "T_target_source": (turn @ T_TRUE).tolist(),
            "pole_rms_m": 0.0142 + 0.0001 * k,
            "exact": True,
            "icp_rotation_rad": e_r,
            "icp_translation_m": e_t,
            "overlap": overlap,
            "free_space": against,
            "score": score,
            "chosen": k == 0 and status != "refused",
        }
        for k, (turn, (overlap, against, score, e_r, e_t)) in enumerate(
            zip(half_turns(), figures, strict=True)
        )
    ]
    covariance = np.diag(np.square([6e-4, 5e-4, 4e-4, 2e-3, 3e-3, 6e-3]))
    reasons = {
        "ok": [],
        "warn": [
            {
                "code": "small_margin",
                "message": "the chosen hypothesis leads by 0.061 only (comfortable: 0.08)",
                "values": {"margin": 0.061},
            }
        ],
        "refused": [
            {
                "code": "ambiguous",
                "message": "the scene does not tell 2 hypotheses apart (scores 0.441 and 0.436, "
                "0.04 between them is needed)",
                "values": {"margin": 0.005},
            }
        ],
    }[status]
    answered = status != "refused"
    pose = {
        "T_target_source": T_TRUE.tolist(),
        "covariance": covariance.tolist(),
        "rms_m": 0.0142,
    }
    result = {
        "schema": "retropole/result/1",
        "status": status,
        "reasons": reasons,
        "T_target_source": T_TRUE.tolist() if answered else None,
        "covariance": covariance.tolist() if answered else None,
        "covariance_order": ["phi_x", "phi_y", "phi_z", "delta_x", "delta_y", "delta_z"],
        "covariance_frame": "target axes: R_true = Exp(phi) R, t_true = t + delta; rad and m",
        "predicted_error": [
            {"range_m": r, "sigma_m": float(np.hypot(0.007, 7e-4 * r))} for r in (1.0, 10, 30, 60)
        ]
        if answered
        else None,
        "weakest": {
            "direction": [0.0, 0.0, 1.0],
            "sigma_m": 0.006,
            "words": "height along the poles: 0.6 cm",
            "condition": 11.0,
        }
        if answered
        else None,
        "stages": {
            "poles": pose if answered else None,
            "refined": {**pose, "rms_m": 0.0098} if status == "ok" else None,
        },
        "hypotheses": hypotheses,
        "margin": 0.51 if answered else 0.005,
        "poles": {
            "target": [pole_document(p) for p in found_target.poles],
            "source": [pole_document(p) for p in found_source.poles],
        },
        "inputs": [
            {
                "path": f"/data/yard/{name}.pcd",
                "sha256": 8 * f"{k}f3a9c1e",
                "points": len(cloud),
                "dropped": 17 * k,
                "sensor": "VLP-16" if k else "auto",
                "threshold": 200.0,
            }
            for k, (name, cloud) in enumerate((("front", target), ("rear", source)))
        ],
        "config": {"radius_m": 0.02, "poles": None, "refine": True, "seed": 0},
        "version": "0.1.0",
        "created": "2025-05-05T12:00:00+00:00",
        "seconds": {"read": 0.21, "extract": 0.09, "match": 0.004, "disambiguate": 0.44},
    }
    return result, target, source, (found_target, found_source)


class Page(HTMLParser):
    """Tags with their attributes, and the text outside of scripts and styles."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.data = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, "every element is closed where it was opened"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script" and self.tags[-1][1].get("id") == "data":
            self.data += data
        elif not {"script", "style"} & set(self.open):
            self.text += data


def page_of(status: str = "ok", **changes: Any) -> Page:
    result, target, source, detections = made_up(status, 500)
    return Page(render_report({**result, **changes}, target, source, detections))


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
def test_page_is_well_formed_and_names_each_reason(status: str) -> None:
    result, *_ = made_up(status, 500)
    page = page_of(status)
    assert page.open == []
    for reason in result["reasons"]:
        assert reason["code"] in page.text
        assert reason["message"] in page.text
        assert "What to do:" in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_every_button_and_field_has_a_name() -> None:
    html = render_report(*made_up(count=500))
    for tag, attributes in Page(html).tags:
        if tag == "button":
            assert attributes.get("type") == "button"
    for body in re.findall(r"<button[^>]*>(.*?)</button>", html.split("<script")[0], re.S):
        assert re.sub("<[^>]*>", "", body).strip()
    assert len(re.findall(r"<(?:input|select)\b", html.split("<script")[0])) == len(
        re.findall(r"<label[^>]*>[^<]*<(?:input|select)\b", html.split("<script")[0])
    )


def test_page_asks_for_nothing_from_anywhere() -> None:
    html = render_report(*made_up(count=500))
    for tag, attributes in Page(html).tags:
        for name in ("src", "href", "action", "srcset", "data", "poster"):
            if tag != "a":
                assert str(attributes.get(name) or "data:").startswith("data:")
    style = html.split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    # The one address in the page is the name of XHTML, by which three.js makes a canvas.
    assert set(re.findall(r"https?://[^\s\"'`)]+", html)) <= {"http://www.w3.org/1999/xhtml"}
    (policy,) = (a for tag, a in Page(html).tags if tag == "meta" and "http-equiv" in a)
    assert policy["http-equiv"] == "Content-Security-Policy"
    assert str(policy["content"]).startswith("default-src 'none';")


HOSTILE = "</script><script>window.injected=1</script>\u2028<!--'\"&"


def test_text_of_the_run_stays_text() -> None:
    result, target, source, _ = made_up("refused", 500)
    for item in result["inputs"]:
        item["path"] = f"/data/{HOSTILE.replace('/', '')}.pcd"
        item["sensor"] = HOSTILE
    result["reasons"][0]["message"] = HOSTILE
    result["reasons"][0]["code"] = HOSTILE
    result["config"][HOSTILE] = HOSTILE
    result["seconds"][HOSTILE] = 1.0
    result["status"] = HOSTILE
    result["version"] = result["created"] = HOSTILE
    page = Page(render_report(result, target, source))
    assert [tag for tag, _ in page.tags].count("script") == 4
    assert page.open == []
    assert page.text.count("window.injected=1") >= 9
    assert json.loads(page.data)["status"] == HOSTILE


def test_embedded_json_says_the_same_and_no_markup() -> None:
    value = {"a": [HOSTILE, 1.5, None, {"b": (float("nan"), float("-inf"), 2)}]}
    text = embed_json(value)
    assert not set("<>&") & set(text)
    assert json.loads(text) == {"a": [HOSTILE, 1.5, None, {"b": [None, None, 2]}]}


@pytest.mark.parametrize(
    "changes",
    [
        {"hypotheses": [], "margin": None},
        {"stages": {"poles": None, "refined": None}, "covariance": None, "predicted_error": None},
        {"poles": {"target": [], "source": []}, "hypotheses": []},
        {"inputs": [], "config": {}, "seconds": {}},
    ],
)
@pytest.mark.parametrize("status", ["ok", "refused"])
def test_what_may_be_missing_may_be_missing(status: str, changes: dict[str, Any]) -> None:
    result, target, source, _ = made_up(status, 500)
    for detections in (None, (None, None)):
        assert Page(render_report({**result, **changes}, target, source, detections)).open == []


def test_hypotheses_without_icp_figures() -> None:
    result, *rest = made_up(count=500)
    for hypothesis in result["hypotheses"]:
        hypothesis.update(icp_rotation_rad=None, icp_translation_m=None, free_space=None)
    assert "–" in Page(render_report(result, *rest)).text


def test_refused_page_gives_no_transform_to_copy() -> None:
    html = render_report(*made_up("refused", 500))
    assert "data-export" not in html.split("<script")[0]
    assert "Refused: no transform" in html
    assert "too_wide" in html
    assert all(pose["id"] != "result" for pose in json.loads(Page(html).data)["poses"])


def test_result_is_not_changed() -> None:
    result, *rest = made_up(count=500)
    before = copy.deepcopy(result)
    render_report(result, *rest)
    assert result == before


def test_thinned_clouds_are_said_to_be_thinned() -> None:
    result, target, source, detections = made_up(count=2000)
    page = Page(render_report(result, target, source, detections, max_points=700))
    assert "target: showing 700 of 2,160 points" in page.text
    assert "source: showing 700 of 2,160 points" in page.text
    whole = Page(render_report(result, target, source, detections))
    assert "target: showing 2,160 of 2,160 points" in whole.text


def test_page_stays_small() -> None:
    rng = np.random.default_rng(5)
    cloud = PointCloud(rng.uniform(-80, 80, (100_000, 3)), rng.uniform(0, 255, 100_000))
    result, *_ = made_up(count=500)
    page = render_report(result, cloud, cloud)
    assert "target: showing 100,000 of 100,000 points" in Page(page).text
    assert len(page.encode()) < 3e6


def test_page_of_many_placements_stays_small() -> None:
    rng = np.random.default_rng(5)
    cloud = PointCloud(rng.uniform(-80, 80, (60_000, 3)), rng.uniform(0, 255, 60_000))
    result, *_ = made_up(count=500)
    page = render_report(result, cloud, cloud, more=9 * [Placement(cloud, cloud)])
    assert f"showing {MAX_PAGE_POINTS_TOGETHER // 20:,} of 60,000 points" in Page(page).text
    assert len(page.encode()) < 8e6


def unpacked(packed: dict[str, Any]) -> np.ndarray:
    steps = np.frombuffer(base64.b64decode(packed["xyz"]), "<u2").reshape(-1, 3)
    return np.array(packed["low"]) + np.array(packed["size"]) * steps / COORDINATE_STEPS


def test_unpacked_points_are_the_clouds_points() -> None:
    _, target, _, (found, _) = made_up(count=900)
    packed = pack_cloud(target, found, max_points=10_000)
    points = unpacked(packed)
    assert len(points) == len(target) == packed["counts"][2]
    size = np.ptp(target.xyz, axis=0)
    nearest = np.abs(points[:, None] - target.xyz).sum(axis=2).argmin(axis=1)
    assert len(set(nearest.tolist())) > 0.99 * len(points)
    assert np.all(np.abs(points - target.xyz[nearest]) <= size / COORDINATE_STEPS)


def test_points_on_poles_and_rejected_clusters_come_first_and_stay() -> None:
    _, target, _, (found, _) = made_up(count=3000)
    packed = pack_cloud(target, found, max_points=300)
    assert packed["counts"] == [120, 40, 300]
    on_poles = np.concatenate([pole.xyz for pole in found.poles])
    assert np.allclose(unpacked(packed)[:120], on_poles, atol=2e-3)
    assert pack_cloud(target, found, max_points=130)["counts"] == [120, 10, 130]


def test_stray_points_do_not_coarsen_the_others() -> None:
    xyz = np.r_[
        np.random.default_rng(0).uniform(-5, 5, (50, 3)),
        [[1e9, 0, 0], [0, -2 * MAX_SHOWN_RANGE, 0]],
    ]
    packed = pack_cloud(PointCloud(xyz), max_points=100)
    assert packed["far"] == 2
    assert packed["counts"][2] == 50
    assert max(packed["size"]) < 10.1


@pytest.mark.parametrize("count", [0, 1])
def test_clouds_of_hardly_any_points(count: int) -> None:
    result, *_ = made_up("refused", 500)
    cloud = PointCloud(np.full((count, 3), 2.0), np.zeros(count))
    assert Page(render_report(result, cloud, cloud)).open == []


def test_lines_to_copy_are_those_of_export() -> None:
    html = render_report(*made_up(count=500))
    written = dict(re.findall(r'data-export="(\w+)">(.*?)</pre>', html, re.S))
    expected = export_lines(T_TRUE, *FRAMES)
    assert set(written) == set(expected)
    for key, text in expected.items():
        assert unescape(written[key]) == text.strip()
    matrix = [line.split() for line in unescape(written["cloudcompare"]).splitlines()[:4]]
    assert np.allclose(np.array(matrix, dtype=float), T_TRUE, atol=1e-12)


def codes_in_source() -> set[str]:
    """Every code that a Refusal or a Reason of the package is made with."""
    codes = set()
    package = PACKAGE
    for path in package.rglob("*.py"):
        if path.parent.name in ("rivals", "paper") or path.name == "check.py":  # not of calibrate
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in ("Refusal", "Reason")
                and node.args
                and isinstance(node.args[0], ast.Constant)
            ):
                codes.add(str(node.args[0].value))
    return codes


def test_every_reason_has_a_title_and_advice() -> None:
    assert len(codes_in_source()) > 15
    assert codes_in_source() <= set(ADVICE)
    for code, advice in ADVICE.items():
        reason = {"code": code, "message": "because of 7", "values": {}}
        text = page_of("warn", reasons=[reason]).text
        for said in (code, "because of 7", advice.title, advice.help):
            assert said in text


def test_says_how_sure_and_in_which_direction() -> None:
    text = page_of().text
    assert "height along the poles: 0.6 cm" in text
    assert "A point 60 m away" in text
    assert "± 4.3 cm" in text
    assert [centimetres(v) for v in (0.0009, 0.0234, None)] == ["± 0.09 cm", "± 2.3 cm", "–"]


def test_several_placements_are_told_and_packed() -> None:
    result, target, source, detections = made_up(count=500)
    result["placements"] = [
        {
            "poles_target": 2,
            "poles_source": 2,
            "left_out_rotation_rad": angle,
            "left_out_translation_m": metres,
        }
        for angle, metres in ((0.001, 0.004), (0.002, 0.0123), (None, None))
    ]
    result["inputs"] = 3 * result["inputs"]
    more = [Placement(target, source, detections), Placement(target, source)]
    page = Page(render_report(result, target, source, detections, more=more))
    for said in ("Placements", "0.057", "12.3", "placement 3", "source 3", "(and 2 more)"):
        assert said in page.text
    packed = json.loads(page.data)["placements"]
    assert [len(p["poles"][0]) for p in packed] == [2, 2, 0]
    assert [len(p["rejected"][1]) for p in packed] == [1, 1, 0]
    assert packed[0]["poles"] == packed[1]["poles"]


def test_topics_tell_two_lidars_of_one_bag_apart() -> None:
    result, *rest = made_up(count=500)
    for item in result["inputs"]:
        item["path"] = "/data/drive.bag"
    result["config"].update(target_topic="/front", source_topic="/rear")
    text = Page(render_report(result, *rest)).text
    assert "drive.bag /front" in text
    assert "drive.bag /rear" in text


def test_notes_stand_before_the_verdict_as_text() -> None:
    result, *rest = made_up(count=500)
    page = Page(render_report(result, *rest, notes=[HOSTILE]))
    assert page.open == []
    assert page.text.index("window.injected") < page.text.index("Calibrated")


def test_circle_of_known_radius_is_found_from_one_side() -> None:
    rng = np.random.default_rng(2)
    angle = rng.uniform(-1.2, 1.2, 200)
    radius = 0.02 + 0.002 * rng.standard_normal(200)
    flat = np.c_[radius * np.cos(angle), radius * np.sin(angle)] + [3.0, -1.0]
    found = fit_circle(flat, 0.02, flat.mean(axis=0) - [0.01, 0.0])
    assert np.allclose(found, [3.0, -1.0], atol=1e-3)


def test_across_a_pole_is_at_right_angles_to_it() -> None:
    _, _, _, (found, _) = made_up(count=500)
    pole = found.poles[0]
    centre, axes = across(pole.xyz)
    assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    assert np.abs(axes @ pole.direction).max() < 0.02
    assert np.allclose(centre, pole.point)


def test_cross_sections_only_where_there_is_an_answer() -> None:
    assert render_report(*made_up(count=500)).count("rms from the surface") == 4
    assert "rms from the surface" not in render_report(*made_up("refused", 500))


def luminance(colour: str) -> float:
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", [0, 1, 2], ids=["light", "dark by system", "dark by button"])
def test_colours_are_told_apart(theme: int) -> None:
    """WCAG 2: 4.5 to 1 for text, 3 to 1 for what is drawn."""
    style = (Path(render_report.__code__.co_filename).parent / "assets/style.css").read_text()
    block = [b for b in re.findall(r"{([^{}]*)}", style) if "--ground" in b][theme]
    colour = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", block))
    for front, back, least in (
        ("text", "ground", 4.5), ("text", "card", 4.5), ("soft", "card", 4.5),
        ("soft", "ground", 4.5), ("text", "press", 4.5), ("text", "warn-soft", 4.5),
        ("accent", "card", 4.5), ("accent", "ground", 4.5),
        ("ok", "card", 4.5), ("ok", "ok-soft", 4.5), ("warn", "card", 4.5),
        ("warn", "warn-soft", 4.5), ("refused", "card", 4.5), ("refused", "refused-soft", 4.5),
        ("target", "view", 3.0), ("source", "view", 3.0), ("soft", "view", 4.5),
    ):  # fmt: skip
        a, b = sorted((luminance(colour[front]), luminance(colour[back])))
        assert (b + 0.05) / (a + 0.05) >= least, (front, back)


def test_ellipsoid_is_the_covariance_of_the_translation() -> None:
    result, *rest = made_up(count=500)
    rng = np.random.default_rng(3)
    root = 1e-3 * rng.standard_normal((6, 6))
    result["covariance"] = (root @ root.T).tolist()
    ellipsoid = json.loads(Page(render_report(result, *rest)).data)["ellipsoid"]
    axes = np.array(ellipsoid["axes"]) / ellipsoid["factor"]
    assert np.allclose(axes.T @ axes, (root @ root.T)[3:, 3:], atol=1e-12)
    assert np.allclose(ellipsoid["centre"], T_TRUE[:3, 3])


def test_write_report_writes_the_page(tmp_path: Path) -> None:
    arguments = made_up(count=500)
    write_report(tmp_path / "new" / "report.html", *arguments)
    written = (tmp_path / "new" / "report.html").read_text(encoding="utf-8")
    assert written == render_report(*arguments)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["report.html"]
