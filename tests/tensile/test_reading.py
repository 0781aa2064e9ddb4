"""Files of testing machines: all ways to write a test give the same curve, and what is missing is asked for."""

from __future__ import annotations

import numpy as np
import pytest
from made_pulls import pull, silicone, write

from cqrun.errors import DataError, UsageError
from cqrun.tensile.columns import column_of
from cqrun.tensile.curve import EVERY, Given
from cqrun.tensile.reading import read_curves

STRAIN = np.linspace(0.0, 1.5, 31)
STRESS = silicone(STRAIN)
AREA, LENGTH = 18e-6, 33e-3
TENSILE = ["Standard;ASTM D412"]


def only_curve(path, given=None):
    (curve,) = read_curves(path, given or Given())
    return curve


def check(curve):
    assert curve.mode == "uniaxial"
    assert curve.stretch == pytest.approx(1.0 + STRAIN, abs=1e-6)
    assert curve.stress == pytest.approx(STRESS, abs=1.0)


WAYS = {
    "a fraction in MPa": (
        {"Engineering strain (mm/mm)": STRAIN, "Engineering stress (MPa)": STRESS * 1e-6},
        {"header": TENSILE},
    ),
    "percent in kPa, commas, no semicolons": (
        {"Tensile strain (%)": STRAIN * 100, "Tensile stress [kPa]": STRESS * 1e-3},
        {"separator": ","},
    ),
    "decimal commas": ({"Dehnung in %": STRAIN * 100, "Spannung in N/mm\u00b2": STRESS * 1e-6}, {
        "header": ["Zugversuch;DIN 53504"], "comma": True, "encoding": "cp1252",
    }),
    "tabs in UTF-16": ({"Strain [-]": STRAIN, "Stress [MPa]": STRESS * 1e-6}, {
        "header": ["Test type\ttensile"], "separator": "\t", "encoding": "utf-16",
    }),
    "blanks": ({"strain_%": STRAIN * 100, "stress_Pa": STRESS}, {"header": ["# tensile test"], "separator": " "}),
    "true strain and stress": ({"True Strain": np.log1p(STRAIN), "True Stress (MPa)": STRESS * (1 + STRAIN) * 1e-6}, {
        "header": TENSILE,
    }),
    "force and extension": ({"Crosshead (mm)": STRAIN * LENGTH * 1e3, "Load (N)": STRESS * AREA}, {
        "header": ["ISO 37", "Width: 6 mm", "Thickness = 3 mm", "Gauge length;33;mm"],
    }),
    "force in kN and area in cm2": (
        {"Standardweg / mm": STRAIN * LENGTH * 1e3, "Standardkraft / kN": STRESS * AREA / 1e3},
        {"header": ["Zugversuch", "Querschnitt (cm^2);0,18", "Specimen length (cm);3,3"], "comma": True},
    ),
    "stretch": ({"stretch": 1 + STRAIN, "nominal_stress_MPa": STRESS * 1e-6, "test": ["uniaxial"] * len(STRAIN)}, {
        "separator": ",",
    }),
    "optical strain beside the crosshead's": (
        {"Crosshead strain (%)": STRAIN * 130, "Video strain (%)": STRAIN * 100, "Stress (MPa)": STRESS * 1e-6},
        {"header": TENSILE},
    ),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_every_way_to_write_a_test_gives_the_same_curve(tmp_path, way):
    columns, options = WAYS[way]
    check(only_curve(write(tmp_path, columns, **options)))


def test_a_row_of_units_below_the_names_is_read(tmp_path):
    path = tmp_path / "units.csv"
    rows = [f"{k};{e};{s}" for k, (e, s) in enumerate(zip(100 * STRAIN, STRESS * 1e-6, strict=True))]
    path.write_text("\n".join(["Tensile test", "Time;Strain;Stress", "(s);(%);(MPa)", *rows]))
    curve = only_curve(path)
    check(curve)
    assert curve.time == pytest.approx(np.arange(31))


def test_how_the_strain_was_measured_is_known(tmp_path):
    columns = {"Strain (%)": 100 * STRAIN, "Stress (MPa)": STRESS}
    header = [*TENSILE, "Strain calculation;Derived from the machine crosshead displacement readings"]
    assert only_curve(write(tmp_path, columns, header=header)).strain_by == "crosshead"
    columns = {"Video extensometer strain (%)": 100 * STRAIN, "Stress (MPa)": STRESS}
    assert only_curve(write(tmp_path, columns, header=header)).strain_by == "optical"


def test_modes_in_a_column_are_separate_tests(tmp_path):
    modes = ["uniaxial"] * 10 + ["planar"] * 11 + ["equibiaxial"] * 10
    path = write(tmp_path, {"test": modes, "stretch": 1 + STRAIN, "stress_MPa": STRESS * 1e-6}, separator=",")
    assert [(c.mode, len(c.stretch)) for c in read_curves(path, Given())] == [
        ("uniaxial", 10), ("planar", 11), ("equibiaxial", 10),
    ]  # fmt: skip


def test_options_say_what_a_file_without_names_has(tmp_path):
    path = write(tmp_path, {"0": 100 * STRAIN, "1": STRESS * 1e-3})
    path.write_text("\n".join(path.read_text().splitlines()[1:]))
    given = Given(
        {"strain": "1", "stress": "2"}, {"strain": "%", "stress": "kPa"}, {EVERY: "planar", "pull.csv": "uniaxial"}
    )
    check(only_curve(path, given))


ASKED = {
    "columns that mean nothing": (
        {"Kanal A": STRAIN, "Kanal B": STRESS}, {"header": TENSILE}, "no column is recognised as stress or force",
    ),
    "no strain": ({"Index": STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE}, "recognised as strain"),
    "stress without a unit": (
        {"Strain (%)": STRAIN, "Stress": STRESS}, {"header": TENSILE},
        "has no unit: give it, such as --unit stress=MPa",
    ),
    "force without an area": ({"Strain (%)": STRAIN, "Force (N)": STRESS}, {"header": TENSILE}, "--area 18mm2"),
    "extension without a length": (
        {"Extension (mm)": STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE}, "--gauge 33mm",
    ),
    "no mode": ({"Strain (%)": STRAIN, "Stress (MPa)": STRESS}, {}, "--mode uniaxial"),
    "two strains": (
        {"Strain 1 (%)": STRAIN, "Strain 2 (%)": STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE},
        "columns 1 'Strain 1', 2 'Strain 2' may all be the engineering strain: choose with --column strain=1",
    ),
    "percent for a fraction": (
        {"Strain": 400 * STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE},
        "can only be percent: give --unit strain=%",
    ),
    "percent under the unit of a fraction": (
        {"Strain (mm/mm)": 400 * STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE},
        "reaches 6e+04 %: if it is in percent, give --unit strain=%",
    ),
    "perhaps percent": (
        {"Strain": 10 * STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE}, "may be percent or a fraction",
    ),
    "a strain called stretch": (
        {"stretch": 0.3 * STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE}, "a stretch is 1 at rest",
    ),
    "areas that contradict each other": (
        {"Strain (%)": STRAIN, "Force (N)": STRESS},
        {"header": [*TENSILE, "Width (mm);6", "Thickness (mm);3", "Area (mm2);20"]}, "give the right one with --area",
    ),
    "two materials in a column": (
        {"material": ["A"] * 15 + ["B"] * 16, "Strain (%)": STRAIN, "Stress (MPa)": STRESS}, {"header": TENSILE},
        "is this more than one material? Choose one with --only material=A",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ASKED)
def test_what_a_file_does_not_say_is_asked_for(tmp_path, case):
    columns, options, message = ASKED[case]
    with pytest.raises(DataError) as caught:
        read_curves(write(tmp_path, columns, **options), Given())
    assert message in str(caught.value)


def test_percent_is_told_by_a_second_column(tmp_path):
    columns = {"Strain": 100 * STRAIN, "True strain": 100 * np.log1p(STRAIN), "Stress (MPa)": STRESS * 1e-6}
    curve = only_curve(write(tmp_path, columns, header=TENSILE))
    check(curve)
    assert "the strain has no unit; it is percent, as another column confirms" in curve.remarks


DOWN = np.linspace(0.02, 0.5, 25)
PRESSED = -silicone(-DOWN)
"""The stress [Pa] of a compression test without its sign."""


@pytest.mark.parametrize(
    ("columns", "header", "why"),
    [
        ({"Strain (%)": 100 * DOWN, "Stress (Pa)": PRESSED}, ["Type of test;Compression"], "the header says"),
        (
            {"Compression strain (%)": 100 * DOWN, "Stress (Pa)": PRESSED}, [],
            "the name of column 1 'Compression strain' says",
        ),
        (
            {"Dehnung (%)": 100 * DOWN, "Druckspannung (Pa)": PRESSED}, ["Norm;ISO 527"],
            "the name of column 2 'Druckspannung' says",
        ),
        ({"test": ["compression"] * 25, "Strain (%)": 100 * DOWN, "Stress (Pa)": PRESSED}, [], "a column says"),
    ],
)  # fmt: skip
def test_compression_without_signs_is_known_by_clear_words(tmp_path, columns, header, why):
    path = write(tmp_path, columns, header=header)
    curve = only_curve(path)
    assert curve.stretch == pytest.approx(1.0 - DOWN)
    assert curve.stress == pytest.approx(silicone(-DOWN), rel=1e-6)
    assert f"this is a compression test, as {why}: its strain and stress count as negative" in curve.remarks
    assert only_curve(path, Given(compression=False)).stretch == pytest.approx(1.0 + DOWN)


@pytest.mark.parametrize("header", [[], TENSILE])
def test_compression_in_the_name_of_a_file_alone_is_asked_for(tmp_path, header):
    columns = {"Strain (%)": 100 * DOWN, "Stress (Pa)": PRESSED}
    path = write(tmp_path, columns, header=header, name="silicone_compression.csv")
    with pytest.raises(
        DataError, match=r"silicone_compression\.csv: the file's name says compression.*--compression if"
    ):
        read_curves(path, Given())
    assert only_curve(path, Given(compression=True)).stretch == pytest.approx(1.0 - DOWN)
    assert only_curve(path, Given(compression=False)).stretch == pytest.approx(1.0 + DOWN)
    signed = {"Strain (%)": -100 * DOWN, "Stress (Pa)": -PRESSED}
    assert only_curve(write(tmp_path, signed, name=path.name)).stretch == pytest.approx(1.0 - DOWN)


def test_tension_and_compression_in_a_column_are_two_tests(tmp_path):
    columns = {"test": ["tension"] * 31 + ["compression"] * 25, "Strain (%)": 100 * np.r_[STRAIN, DOWN],
               "Stress (Pa)": np.r_[STRESS, PRESSED]}  # fmt: skip
    pulled, pressed = read_curves(write(tmp_path, columns, name="compression_and_tension.csv"), Given())
    check(pulled)
    assert pressed.stress == pytest.approx(silicone(-DOWN), rel=1e-6)


def test_one_material_of_several_is_chosen(tmp_path):
    material = ["A"] * 31 + ["B"] * 5
    columns = {"material": material, "Strain (%)": np.r_[100 * STRAIN, np.ones(5)],
               "Stress (MPa)": np.r_[STRESS * 1e-6, np.ones(5)]}  # fmt: skip
    check(only_curve(write(tmp_path, columns, header=TENSILE), Given(only={"material": "A"})))


def test_a_second_table_in_a_file_is_refused(tmp_path):
    path = pull(tmp_path)
    path.write_text(path.read_text() + "Specimen 2\nStrain;Stress\n0.1;0.2\n0.2;0.3\n")
    with pytest.raises(DataError, match=r"pull.csv:65: another table begins after line 62: one file is one specimen"):
        read_curves(path, Given())


def test_commas_that_may_be_thousands_are_refused(tmp_path):
    path = tmp_path / "doubt.csv"
    path.write_text("Standard;ASTM D412\nStrain (%);Stress (kPa)\n1,125;2,250\n2,125;3,250\n3,500;4,125\n")
    with pytest.raises(DataError, match="decimal comma or a comma between thousands"):
        read_curves(path, Given())


def test_decimal_commas_between_commas_are_refused(tmp_path):
    path = tmp_path / "commas.csv"
    path.write_text("Strain (%),Stress (MPa)\n5,000,0,02860\n10,000,0,05471\n15,000,0,07877\n")
    with pytest.raises(DataError, match=r"commas\.csv:2: has 4 cells, but there are 2 names above: decimal commas"):
        read_curves(path, Given())


@pytest.mark.parametrize("sign", ["---", "#VALUE!", "inf", "broken"])
@pytest.mark.parametrize("place", [1, 15, 30])
@pytest.mark.parametrize("more", [0, 2])
def test_a_cell_that_is_no_number_is_missing_and_told(tmp_path, sign, place, more):
    """Wherever it is, and whatever other columns there are; no row is lost without a remark."""
    stress = [f"{x * 1e-6:.9g}" for x in STRESS]
    stress[place] = sign
    columns = {f"Other {k}": STRAIN for k in range(more)}
    columns |= {"Strain (%)": [f"{100 * x:.9g}" for x in STRAIN], "Stress (MPa)": stress}
    curve = only_curve(write(tmp_path, columns, header=TENSILE))
    if (sign, place, more) == ("broken", 30, 0):  # one word and one number may be what follows a table
        assert "1 line after the table not read (first: line 33: '150;broken')" in curve.remarks
        return
    assert len(curve.stress) == 31
    assert np.flatnonzero(np.isnan(curve.stress)).tolist() == [place]
    assert f"1 cell is no number and counts as missing (first: '{sign}' at pull.csv:{place + 3})" in curve.remarks


def test_the_first_row_belongs_to_the_table_although_its_stress_is_missing(tmp_path):
    stress = ["---", "NaN", *(f"{x * 1e-6:.9g}" for x in STRESS[2:])]
    curve = only_curve(write(tmp_path, {"Strain (%)": 100 * STRAIN, "Stress (MPa)": stress}, header=TENSILE))
    assert curve.stretch == pytest.approx(1.0 + STRAIN)
    assert np.isnan(curve.stress[:2]).all()


def test_a_column_of_words_is_no_stress(tmp_path):
    columns = {"Strain (%)": 100 * STRAIN, "Stress (MPa)": STRESS * 1e-6, "Other": ["a"] * 31}
    with pytest.raises(DataError, match=r"pull\.csv:3:\d+: column 3 'Other' is 'a', which is not a number"):
        read_curves(write(tmp_path, columns, header=TENSILE), Given({"stress": "3"}, {"stress": "MPa"}))


def test_decimal_commas_between_commas_are_told_although_rows_differ(tmp_path):
    path = tmp_path / "commas.csv"
    path.write_text("Strain (%),Stress (MPa)\n0,0\n2,5,0,0286\n5,0,05471\n7,5,0,07877\n")
    with pytest.raises(DataError, match=r"commas\.csv:3: has 4 cells, but there are 2 names above: decimal commas"):
        read_curves(path, Given())


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\0\0", b"only words\nin here\n"])
def test_a_file_without_a_table_is_refused(tmp_path, content):
    path = tmp_path / "none.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"none\.csv: (has no table|not a text file|.*PNG|.*picture|.*image)"):
        read_curves(path, Given())


def test_a_missing_file_and_a_wrong_option_are_refused(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_curves(tmp_path / "none.csv", Given())
    with pytest.raises(UsageError, match=r"--column strain=9: pull\.csv has no such column"):
        read_curves(pull(tmp_path), Given({"strain": "9"}))
    with pytest.raises(UsageError, match="the units of a stress are"):
        read_curves(pull(tmp_path), Given(units={"stress": "mm"}))


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("Time (s)", ("Time", "s", "time")),
        ("Kraft / N", ("Kraft", "N", "force")),
        ("Elongation (%)", ("Elongation", "%", "strain")),
        ("Elongation (mm)", ("Elongation", "mm", "extension")),
        ("True Strain", ("True Strain", "", "true_strain")),
        ("nominal_stress_MPa", ("nominal_stress", "MPa", "stress")),
        ("Strain rate (1/s)", ("Strain rate", "1/s", "")),
        ("Load cell temperature", ("Load cell temperature", "", "")),
    ],
)
def test_a_column_is_known_by_its_name_and_unit(header, expected):
    column = column_of(0, header)
    assert (column.name, column.unit, column.role) == expected
