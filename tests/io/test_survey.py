"""Surveys as data loggers and total stations export them, and what is refused as ambiguous.

The layouts are those of these programs, byte for byte; the places are made up, in metres.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io.survey import SurveyPoint, read_survey
from tests.io.files import required

# Emlid Flow, "CSV". What Easting, Origin and Base easting mean of its columns say
# https://community.emlid.com/t/correct-interpretation-of-origin-column-of-csv-export/42225 and
# https://community.emlid.com/t/survey-csv-file-explained/34769.
EMLID = (
    b"Name,Code,Code description,Easting,Northing,Elevation,Description,Longitude,Latitude,"
    b"Ellipsoidal height,Origin,Tilt angle,Easting RMS,Northing RMS,Elevation RMS,Lateral RMS,"
    b"Antenna height,Antenna height units,Solution status,Correction type,Averaging start,"
    b"Averaging end,Samples,PDOP,GDOP,Base easting,Base northing,Base elevation,Base longitude,"
    b"Base latitude,Base ellipsoidal height,Baseline,Mount point,CS name\n"
    b'P1f,,,500012.341,5538630.512,119.871,"foot, north",9.00017152,50.00052561,167.203,Global,1.7,'
    b"0.009,0.008,0.015,0.012,2.134,m,FIX,RTK,2026-05-20 10:27:09.4 UTC+02:00,"
    b"2026-05-20 10:27:14.4 UTC+02:00,26,1.2,1.4,499120.305,5538012.412,131.548,8.98773195,"
    b"49.99496692,178.880,1085.021,,ETRS89 / UTM zone 32N + DHHN2016 height\n"
    b"base point,,,,,,,8.98773195,49.99496692,178.880,Global,,,,,,,,SINGLE,,,,,,,,,,,,,,,\n"
)

# Trimble Access, "CSV Grid points N-E" and "E-N" have no names: name, northing, easting, elevation,
# code, and name, easting, northing, elevation, code,
# https://help.fieldsystems.trimble.com/trimble-access/latest/en/job-import-file-formats.htm.
TRIMBLE = b"P1f,5538630.512,500012.341,119.871,POLE\r\nP1t,5538630.498,500012.352,121.866,POLE\r\n"

# Leica LS10 to FlexLine, "ASCII": names of columns, the separator is the user's choice,
# https://www.easymanua.ls/leica/ls10/manual?p=90.
LEICA = (
    b"PtID East North Height Code Info1-8\r\n"
    b"P1f 500012.3410 5538630.5120 119.8710 POLE\r\n"
    b"P1t 500012.3520 5538630.4980 121.8660\r\n"
)

# Sedrix Tachymeter CSV: lines about the survey before the names of the columns,
# https://manual.sedrix.com/en/sedrix/5.4.x/sdc-tachymeter-csv.
SEDRIX = (
    b"Station;Punktgruppe 1;;;;;;;\nMeasurement time;2018-04-29T18:34:00+02:00;;;;;;;\n"
    b"Dry temperature [\xc2\xb0C];14;;;;;;;\nCoordinate system; CH1903+ ;;;;;;;\n"
    b"Messpunkt;Measurement time;E;Unit;N;Unit;H;Unit;Durchg\xc3\xa4nge\n"
    b"P1f;2018-04-29T18:34:00+02:00;500012.341;m;5538630.512;m;119.871;m;1\n"
)

FOOT = [500012.341, 5538630.512, 119.871]


def read(folder: Path, data: bytes, **how: Any) -> SurveyPoint:
    path = folder / "points.csv"
    path.write_bytes(data)
    return read_survey(path, ["P1f"], **how)["P1f"]


@pytest.mark.parametrize(
    ("data", "columns", "sigma"),
    [
        (EMLID, None, [0.009, 0.008, 0.015]),
        (TRIMBLE, "id, n, e, h, code", None),
        (LEICA, None, None),
        (LEICA.replace(b" ", b"\t"), None, None),
        (SEDRIX, None, None),
        (b"NAME,NORTHING,EASTING,ELLIPSOID HEIGHT,HRMS,VRMS\nP1f,5538630.512,500012.341,119.871,"
         b"0.004,0.007\n", None, [0.004, 0.004, 0.007]),
        ("Punktnummer;Rechtswert;Hochwert;Höhe [m];σ [mm]\nP1f;500012,341;5538630,512;119,871;5\n"
         .encode("utf-16"), None, [0.005] * 3),
        (b"# 20 May\n\nN (m),E (m),Z (m),sigma_n,sigma_e,sigma_z,id\n"
         b"5538630.512,500012.341,119.871,.002,.001,3e-3,P1f\n", None, [0.001, 0.002, 0.003]),
        (b"#id,e,n,h\nP1f,500012.341,5538630.512,119.871\n", None, None),
    ],
)  # fmt: skip
def test_names_say_what_columns_are(
    tmp_path: Path, data: bytes, columns: str | None, sigma: list[float] | None
) -> None:
    point = read(tmp_path, data, columns=columns, is_map=True)
    np.testing.assert_allclose(point.at, FOOT, rtol=0, atol=1e-9)
    if sigma is None:
        assert point.sigma is None
    else:
        np.testing.assert_allclose(required(point.sigma), sigma)


def test_of_a_plan_x_and_y_are_its_axes_of_a_map_they_are_not_known(tmp_path: Path) -> None:
    plan = b"id;x;y;z\nP1f;3.25;-1.5;0.125\n"
    point = read(tmp_path, plan)
    np.testing.assert_array_equal(point.at, [3.25, -1.5, 0.125])
    with pytest.raises(ReadError, match="in some countries x is east, in others north"):
        read(tmp_path, plan, is_map=True)
    both = b"id,Y,X,Easting,Northing,H\nP1f,1,2,500012.341,5538630.512,119.871\n"
    named = read(tmp_path, both, is_map=True)
    np.testing.assert_allclose(named.at, FOOT)


@pytest.mark.parametrize(
    ("data", "columns", "words"),
    [
        (TRIMBLE, None, 'no line has the names of columns.*"id, e, n, h" or "id, n, e, h"'),
        (LEICA, "id, n, e, h", "line 1: names the columns; leave columns out"),
        (TRIMBLE, "id, n, e", "has no column h"),
        (EMLID.replace(b"P1f", b"P2f"), None, "has no point P1f, expected one of its P2f, base"),
        (EMLID + EMLID.splitlines(keepends=True)[1], None, "lines 2 and 4 have a point P1f"),
        (EMLID.replace(b"P1f", b"P2f").replace(b"base point", b"P1f"), None,
         "line 3: column Easting: '', expected a number"),
        (LEICA.replace(b"119.8710", b"119.87.10"), None, "line 2: column Height: '119.87.10'"),
        (LEICA.replace(b"119.8710", b"nan"), None, "line 2: column Height: 'nan'"),
        (b"id,e,n,h\nP1f,500012,341,5538630,512,119,871\n", None, "line 2: 7 values, expected 4"),
        (b"id;e;n;h\nP1f;500.012,341;5.538.630,512;119,8\n", None, "decimal points and commas"),
        (b"id;e;n;h\nP1f;5,538,630;500012;119\n", None, "column e: '5,538,630', expected a number"),
        (b"id,e [ft],n [ft],h [ft]\nP1f,1,2,3\n", None, r"column e \[ft\]: expected metres"),
        (b"id,e,n,h,E\nP1f,1,2,3,4\n", None, "has two columns E"),
        (b"Name,Latitude,Longitude,Height\nP1f,50.1,9.2,120\n", None, "line 1: names latitude and"),
        (b"", None, "is empty"),
        (b"\xff\xfe", None, "no line has the names of columns"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(
    tmp_path: Path, data: bytes, columns: str | None, words: str
) -> None:
    with pytest.raises(ReadError, match=words) as refused:
        read(tmp_path, data, columns=columns)
    assert "points.csv" in str(refused.value)


def test_only_the_points_that_are_used_must_be_whole(tmp_path: Path) -> None:
    assert read(tmp_path, EMLID).sigma is not None
    with pytest.raises(ReadError, match="cannot be read"):
        read_survey(tmp_path / "none.csv", ["P1f"])
