"""Site files from the names of folders and files."""

from pathlib import Path

import pytest

from retropole.api.site_draft import draft_site
from retropole.api.site_file import SiteFile, decode_site_file
from retropole.base.errors import ReadError, UsageError
from tests.api.site_files import write_recordings


def drafted(folder: Path) -> SiteFile:
    return decode_site_file(draft_site(folder, folder / "site.toml").text.encode())


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


@pytest.mark.parametrize(
    ("form", "placements"),
    [
        ("{lidar}/{placement}.pcd", ["1", "2"]),
        ("{placement}/{lidar}.pcd", ["1", "2"]),
        ("{lidar}_{placement}.pcd", ["1", "2"]),
        ("{lidar}/placement-{placement}.pcd", ["placement-1", "placement-2"]),
        ("p{placement}/{lidar}.pcd", ["p1", "p2"]),
        ("{lidar}_p{placement}.pcd", ["p1", "p2"]),
    ],
)
def test_names_say_which_recording_is_whose(
    tmp_path: Path, form: str, placements: list[str]
) -> None:
    write_recordings(tmp_path, form)
    site = drafted(tmp_path)
    assert site.placements == placements
    recordings = {lidar.name: lidar.recordings for lidar in site.lidar}
    assert set(recordings) == {"mast-a", "mast-b", "gate"}
    for name, paths in recordings.items():
        for n, path in enumerate(paths):
            expected = form.format(lidar=name, placement=n + 1)
            assert path == ("" if (name, n) == ("gate", 1) else expected)
    notes = draft_site(tmp_path, tmp_path / "site.toml").notes
    assert notes == (f"gate has no recording of placement {placements[1]}",)


@pytest.mark.parametrize("stamp", ["2026-11-23-06-{}", "20261123T06{}", "2026_11_23_06-{}-07"])
@pytest.mark.parametrize("form", ["{stamp}-{lidar}.pcd", "{lidar}_{stamp}.pcd"])
def test_times_in_names_are_placements(tmp_path: Path, stamp: str, form: str) -> None:
    """What is recorded about the same time stands together, also where a recording is missing."""
    for lidar, minutes in (
        ("lidarA", ("01", "11", "31")),
        ("lidarB", ("02", "12")),
        ("gate", ("30",)),
    ):
        touch(tmp_path, *(form.format(lidar=lidar, stamp=stamp.format(m)) for m in minutes))
    site = drafted(tmp_path)
    assert site.placements == ["1", "2", "3"]
    given = {lidar.name: [bool(path) for path in lidar.recordings] for lidar in site.lidar}
    assert given == {
        "gate": [False, False, True],
        "lidarA": [True, True, True],
        "lidarB": [True, True, False],
    }


def test_a_time_that_is_none_is_told(tmp_path: Path) -> None:
    touch(tmp_path, "a-2026-02-31-06-01.pcd", "b-2026-02-31-06-01.pcd")
    with pytest.raises(UsageError, match="is no time"):
        drafted(tmp_path)


def test_files_without_numbers_are_one_placement(tmp_path: Path) -> None:
    touch(tmp_path, "front.pcd", "rear.bag", "notes.txt", ".hidden.pcd", "site.toml")
    site = drafted(tmp_path)
    assert site.placements == ["1"]
    assert [lidar.recordings for lidar in site.lidar] == [["front.pcd"], ["rear.bag"]]
    assert draft_site(tmp_path, tmp_path / "site.toml").notes == (
        f"{tmp_path}: left out notes.txt",
    )


def test_a_folder_of_frames_and_a_bag_of_ros_2_are_recordings(tmp_path: Path) -> None:
    touch(tmp_path, "a/1/000.pcd", "a/1/001.pcd", "a/2/metadata.yaml", "b/1.pcd", "b/2.mcap")
    site = drafted(tmp_path)
    assert [lidar.recordings for lidar in site.lidar] == [["a/1", "a/2"], ["b/1.pcd", "b/2.mcap"]]


def test_two_stand_before_ten(tmp_path: Path) -> None:
    touch(tmp_path, *(f"{name}/{k}.pcd" for name in ("l2", "l10") for k in (1, 2, 10, 11)))
    site = drafted(tmp_path)
    assert site.placements == ["1", "2", "10", "11"]
    assert [lidar.name for lidar in site.lidar] == ["l2", "l10"]


def test_paths_count_from_the_file(tmp_path: Path) -> None:
    write_recordings(tmp_path / "day" / "recordings")
    path = tmp_path / "sites" / "quay.toml"
    site = decode_site_file(draft_site(tmp_path / "day" / "recordings", path).text.encode())
    assert site.lidar[0].recordings[0] == "../day/recordings/gate/1.pcd"


def test_odd_names_are_quoted(tmp_path: Path) -> None:
    touch(tmp_path, 'a "b"\\c/1.pcd', "grün 😀/1.pcd")
    names = {lidar.name for lidar in drafted(tmp_path).lidar}
    assert names == {'a "b"\\c', "grün 😀"}


def test_one_name_with_numbers_is_of_as_many_lidars(tmp_path: Path) -> None:
    for k in (1, 2, 10):
        (tmp_path / f"lidar_{k}.pcd").write_bytes(b"")
    draft = draft_site(tmp_path, tmp_path / "site.toml")
    assert draft.summary == "3 LiDARs: lidar_1, lidar_2, lidar_10; 1 placement: 1"
    # A second name makes the numbers those of placements again.
    (tmp_path / "mast_1.pcd").write_bytes(b"")
    assert "2 LiDARs: lidar, mast; 3 placements" in draft_site(tmp_path, tmp_path / "s").summary


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ((), "has no recordings"),
        (("a.pcd", "b/1.pcd"), r"has recordings \(a.pcd\) and folders \(b\)"),
        (("north/east.pcd", "south/east.pcd"), "north, south hold east, and neither look like"),
        (("1/2.pcd", "2/2.pcd"), "1, 2 hold 2, and both look like numbers of placements"),
        (("a_1.pcd", "b.pcd"), "a_1.pcd may be LIDAR_PLACEMENT, b.pcd is not"),
        (("a/1.pcd", "a/1.ply", "b/1.pcd"), "are both a in placement 1"),
        (("a/1.pcd", "a/2.pcd"), "recordings of one LiDAR, a, in 2 placements: 1, 2"),
        (("a\n/1.pcd", "b/1.pcd"), "its file names cannot be turned into a site file: lidar, name"),
        (
            ("x" * 70 + "/1.pcd", "b/1.pcd"),
            "its file names cannot be turned into a site file: lidar 2",
        ),
    ],
)
def test_names_that_do_not_say_it_are_told(
    tmp_path: Path, names: tuple[str, ...], said: str
) -> None:
    touch(tmp_path, *names)
    with pytest.raises(UsageError, match=said):
        draft_site(tmp_path, tmp_path / "site.toml")


def test_a_folder_that_is_none_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="cannot be read"):
        draft_site(tmp_path / "none", tmp_path / "site.toml")
    touch(tmp_path, "file")
    with pytest.raises(ReadError, match="cannot be read"):
        draft_site(tmp_path / "file", tmp_path / "site.toml")


def test_every_comment_can_be_taken_away(tmp_path: Path) -> None:
    write_recordings(tmp_path)
    text = draft_site(tmp_path, tmp_path / "site.toml").text
    # As a user who has surveyed does it: the frame of a LiDAR goes, what was surveyed comes.
    survey = text[text.index("# A pole") :]
    lines = [line.removeprefix("# ") for line in survey.splitlines()]
    said = [line for line in lines if "=" in line or line.startswith("[[")]
    head = text[: text.index("# A pole")].replace('lidar = "gate"', 'frame = "local"', 1)
    head = (
        head.replace("# [need]", "[need]").replace("# within", "within").replace("# at_m", "at_m")
    )
    head = head.replace("# radius_sigma", "radius_sigma").replace("# max_points", "max_points")
    site = decode_site_file((head + "\n".join(said)).encode())
    assert site.need is not None
    assert site.surveyed_pole[0].top_m == [0.0, 0.3, 2.0]
    assert site.control_point[0].seen[0].sigma_m == 0.01
