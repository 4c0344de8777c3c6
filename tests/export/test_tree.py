"""The frames of a site: one tree in every format, exact, and the same when it is read back."""

from __future__ import annotations

import ast
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import ReadError, Refusal, UsageError
from retropole.base.se3 import joint_of, relative
from retropole.export import TREE_FORMATS, read_transform, read_tree
from retropole.export.recording import write_transforms
from retropole.export.tree import Tree, found_in_site, tree_of
from retropole.result import LEVEL_FILE, SITE_RESULT_FILE, encode
from retropole.result.level import LevelDoc, LidarLevelDoc
from retropole.result.site import SiteDoc
from tests.export import sites

READABLE = {"json": ".json", "yaml": ".yaml", "urdf": ".urdf", "launch": ".py"}
KINDS: dict[str, Callable[[], SiteDoc]] = {
    "free": sites.free,
    "enu": sites.surveyed,
    "plan": sites.on_plan,
    "utm": sites.in_utm,
}


def poses(document: SiteDoc) -> dict[str, Array]:
    return {lidar.name: np.array(lidar.T_site_lidar) for lidar in document.lidars}


def through(edges: list[tuple[str, str, Array]], root: str, leaf: str) -> Array:
    """Multiply down a tree, as any of its readers does."""
    above = {child: (parent, T) for parent, child, T in edges}
    T = np.eye(4)
    while leaf != root:
        leaf, step = above[leaf]
        T = step @ T
    return T


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fmt", READABLE)
def test_what_is_written_reads_back_for_any_named_edge(kind: str, fmt: str, tmp_path: Path) -> None:
    document = KINDS[kind]()
    tree = tree_of(document)
    path = tmp_path / f"site{READABLE[fmt]}"
    path.write_text(TREE_FORMATS[fmt].write(tree))
    for edge in tree.edges:
        back = read_transform(path, parent=edge.parent, child=edge.child)
        np.testing.assert_allclose(back.T_parent_child, edge.T_parent_child, rtol=0, atol=1e-9)
    with pytest.raises(ReadError, match=f"{len(tree.edges)} transforms fit"):
        read_transform(path)


def test_a_free_site_hangs_on_its_own_frame() -> None:
    tree = tree_of(sites.free())
    assert {edge.parent for edge in tree.edges} == {"site"}
    assert [edge.child for edge in tree.edges] == ["mast-a", "mast-b", "gate"]
    # The pose of the LiDAR whose frame it is has no error, and none is stated.
    assert [edge.covariance is None for edge in tree.edges] == [True, False, False]


@pytest.mark.parametrize("kind", ["plan", "utm"])
def test_large_coordinates_stand_in_one_transform_alone(kind: str) -> None:
    tree = tree_of(KINDS[kind]())
    first, *rest = tree.edges
    assert (first.parent, first.child) == ("map", "site")
    assert np.abs(first.T_parent_child[:3, 3]).max() > 5e6
    for edge in rest:
        assert np.abs(edge.T_parent_child).max() < 100
        # In float32 a LiDAR stays within a hundredth of a millimetre.
        short = edge.T_parent_child.astype(np.float32)
        assert np.abs(short - edge.T_parent_child).max() < 1e-5


def test_a_plan_keeps_every_digit() -> None:
    document = sites.on_plan()
    tree = tree_of(document)
    np.testing.assert_array_equal(tree.edges[0].T_parent_child[:3, 3], [4e5, 5.7e6, 100.25])
    np.testing.assert_array_equal(tree.edges[0].T_parent_child[:3, :3], np.eye(3))


def test_the_grid_is_reported_and_its_coordinates_are_exact_in_json() -> None:
    document = sites.in_utm()
    tree = tree_of(document)
    written = json.loads(TREE_FORMATS["json"].write(tree))
    assert any("30 m on the ground are" in note for note in written["notes"])
    assert written["frame"]["epsg"] == sites.UTM
    edges = [(each.parent, each.child, each.T_parent_child) for each in tree.edges]
    for lidar in written["lidars"]:
        exact = np.array(lidar["T_frame_lidar"])
        by_tree = through(edges, "map", lidar["name"])
        off = np.linalg.norm(exact[:3, 3] - by_tree[:3, 3])
        # The tree keeps lengths on the ground, those of the grid are scaled.
        length = np.linalg.norm(by_tree[:3, 3] - edges[0][2][:3, 3])
        scale = written["frame"]["scale"] * written["frame"]["height_factor"]
        assert off == pytest.approx(abs(scale - 1) * length, abs=2e-5)


@pytest.mark.parametrize("kind", ["free", "enu", "plan"])
def test_between_any_two_frames_the_covariance_is_that_of_both_together(kind: str) -> None:
    document = KINDS[kind]()
    found = {(each.parent, each.child): each for each in found_in_site(document)}
    names = ["site", *poses(document), *(["map"] if kind == "plan" else [])]
    assert set(found) == {(a, b) for a in names for b in names if a != b}
    joint = np.array(document.joint_covariance)
    T = poses(document)
    pair = found["mast-b", "gate"]
    expected = relative(T["mast-b"], T["gate"], joint_of(joint, 1, 2))
    np.testing.assert_allclose(pair.pose(), expected.T_i_j, rtol=0, atol=1e-12)
    assert pair.covariance is not None
    np.testing.assert_allclose(pair.covariance, expected.covariance, rtol=0, atol=1e-15)
    own = found["site", "gate"].covariance
    assert own is not None
    np.testing.assert_allclose(own, joint[12:, 12:], rtol=0, atol=1e-18)
    back = found["gate", "mast-b"].pose()
    np.testing.assert_allclose(back @ pair.pose(), np.eye(4), rtol=0, atol=1e-12)


def test_a_result_is_read_for_two_named_frames(tmp_path: Path) -> None:
    path = tmp_path / "site-result.json"
    document = sites.surveyed()
    path.write_bytes(encode(document))
    back = read_transform(tmp_path, parent="mast-a", child="gate")
    T = poses(document)
    np.testing.assert_allclose(back.T_parent_child, se3.inverse(T["mast-a"]) @ T["gate"])
    assert back.covariance is not None
    with pytest.raises(ReadError, match="name both frames"):
        read_transform(path)
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(UsageError, match="give one of them"):
        read_tree(tmp_path)
    assert read_tree(tmp_path / "result.json") is None


def test_a_refused_site_has_no_tree() -> None:
    with pytest.raises(Refusal, match="the site was refused"):
        tree_of(sites.refused())


@pytest.mark.parametrize("name", ["map", "site"])
def test_a_lidar_cannot_take_the_name_of_another_frame(name: str) -> None:
    document = sites.free()
    lidars = [msgspec.structs.replace(document.lidars[0], name=name), *document.lidars[1:]]
    with pytest.raises(UsageError, match="the name of a frame of the site"):
        tree_of(msgspec.structs.replace(document, lidars=lidars))


def hostile() -> Tree:
    document = sites.free()
    name = '--> ]] "q" -- # \n </robot> & \u202e end--'
    lidars = [msgspec.structs.replace(document.lidars[0], name="a--b ->&<"), *document.lidars[1:]]
    frame = msgspec.structs.replace(document.frame, name=name)
    return tree_of(
        msgspec.structs.replace(document, name=name, datum=name, frame=frame, lidars=lidars)
    )


@pytest.mark.parametrize("fmt", READABLE)
def test_names_that_mean_something_to_a_format_stay_names(fmt: str, tmp_path: Path) -> None:
    path = tmp_path / f"site{READABLE[fmt]}"
    path.write_text(TREE_FORMATS[fmt].write(hostile()))
    back = read_transform(path, parent="site", child="a--b ->&<")
    np.testing.assert_allclose(back.T_parent_child, np.eye(4), rtol=0, atol=1e-12)


def test_urdf_parser_reads_one_robot() -> None:
    parser = pytest.importorskip("urdf_parser_py.urdf", reason="urdf-parser-py is not installed")
    robot = parser.URDF.from_xml_string(
        TREE_FORMATS["urdf"].write(tree_of(sites.on_plan())).encode()
    )
    assert robot.get_root() == "map"
    assert [joint.type for joint in robot.joints] == ["fixed"] * (sites.LIDARS + 1)
    assert robot.get_chain("map", "gate", joints=False) == ["map", "site", "gate"]
    assert robot.joint_map["site_joint"].origin.xyz == [4e5, 5.7e6, 100.25]


def test_the_launch_file_has_a_publisher_for_each_transform() -> None:
    tree = tree_of(sites.on_plan())
    calls = [
        node
        for node in ast.walk(ast.parse(TREE_FORMATS["launch"].write(tree)))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Node"
    ]
    assert len(calls) == len(tree.edges)


def test_the_recording_holds_the_whole_tree_for_late_listeners() -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'retropole[ros]'")
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_typestore

    tree = tree_of(sites.on_plan())
    reader = make_reader(io.BytesIO(write_transforms(tree.edges)))
    ((_, channel, message),) = reader.iter_messages()
    assert channel.topic == "/tf_static"
    assert "durability: 1" in channel.metadata["offered_qos_profiles"]
    store = get_typestore(Stores.ROS2_HUMBLE)
    content: Any = store.deserialize_cdr(message.data, "tf2_msgs/msg/TFMessage")
    for stamped, edge in zip(content.transforms, tree.edges, strict=True):
        assert (stamped.header.frame_id, stamped.child_frame_id) == (edge.parent, edge.child)
        t, q = stamped.transform.translation, stamped.transform.rotation
        T = se3.from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z]))
        np.testing.assert_allclose(T, edge.T_parent_child, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("transforms", "reason"),
    [
        (None, "not a list of objects"),
        ({}, "not a list of objects"),
        ([1], "not a list of objects"),
        ([{}], "expected one of the keys"),
        ([{"T_parent_child": [[1]], "parent": "a", "child": "b"}], "no rigid transform"),
        ([{"T_parent_child": np.eye(4).tolist(), "parent": 1, "child": "b"}], "not a name"),
        ([], "0 transforms fit"),
    ],
)
def test_a_tree_that_is_not_sound_is_refused(transforms: Any, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "tree.json"
    path.write_text(json.dumps({"schema": "retropole/tree/1", "transforms": transforms}))
    with pytest.raises(ReadError, match=reason):
        read_transform(path, parent="a", child="b")


def test_a_frame_that_no_map_can_hold_is_refused() -> None:
    document = sites.on_plan()
    frame = msgspec.structs.replace(document.frame, offset=np.array([1e12, 0.0, 0.0]))
    with pytest.raises(ReadError, match="beyond"):
        tree_of(msgspec.structs.replace(document, frame=frame))
    frame = msgspec.structs.replace(sites.in_utm().frame, epsg=1)
    with pytest.raises(UsageError, match="in no database"):
        tree_of(msgspec.structs.replace(document, frame=frame))


def test_a_level_adds_the_ground_and_the_vehicle(tmp_path: Path) -> None:
    document = sites.free()
    T_ground, T_base = (
        se3.from_rt(se3.rotation_from_rpy(np.array([0.1, -0.2, yaw])), np.array([1.0, 2.0, -yaw]))
        for yaw in (0.5, -2.0)
    )
    lidars = [
        LidarLevelDoc(
            name=name,
            T_ground_lidar=T_ground @ pose,
            covariance=np.eye(6),
            roll_rad=0.0,
            pitch_rad=0.0,
            height_m=2.0,
            roll_pitch_height=np.eye(3),
            T_base_footprint_lidar=T_base @ pose,
        )
        for name, pose in poses(document).items()
    ]
    level = LevelDoc(
        result="site-result.json",
        frame="site",
        T_ground_frame=T_ground,
        lidars=lidars,
        disc_radius_m=10.0,
        disc_middle_m=[0.0, 0.0, 0.0],
        about_foot=True,
        area_m2=100.0,
        bend_m=0.0,
        bend_sigma_m=0.01,
        roughness_m=0.01,
        ceiling_m=None,
        other_levels=[],
        inputs=[],
        version="1",
        created="2026-01-01T00:00:00Z",
    )
    (tmp_path / SITE_RESULT_FILE).write_bytes(encode(document))
    (tmp_path / LEVEL_FILE).write_bytes(encode(level))
    tree = read_tree(tmp_path)
    assert tree is not None
    assert len(tree.lidar_edges) == len(document.lidars)
    edges = [(edge.parent, edge.child, edge.T_parent_child) for edge in tree.edges]
    np.testing.assert_allclose(through(edges, "site", "ground"), se3.inverse(T_ground), atol=1e-9)
    np.testing.assert_allclose(
        through(edges, "site", "base_footprint"), se3.inverse(T_base), atol=1e-9
    )
    moved = msgspec.structs.replace(level, T_ground_frame=np.eye(4))
    (tmp_path / LEVEL_FILE).write_bytes(encode(moved))
    with pytest.raises(UsageError, match="another result"):
        read_tree(tmp_path)
