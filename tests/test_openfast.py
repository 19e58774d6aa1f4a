"""OpenFAST's .lin files, and multi-blade coordinates: laws, names, refusals."""

import pickle
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sklearn_hd.algorithms.periodic.multiblade import (
    Frame,
    coleman_matrix,
    from_multiblade,
    to_multiblade,
)
from sklearn_hd.datasets import load_wind_turbine
from sklearn_hd.systems import multiblade_model, read_openfast_lin, rotor_system

OMEGA = 0.7
FRAME = Frame([(1, 2, 3), (5, 6, 7)], {(1, 2, 3): (5, 6, 7)}, [(0, 1, 2)], [(1, 2, 3)])
SIZES = {"A": (8, 8), "B": (8, 4), "C": (4, 8), "D": (4, 4)}


def rotor(rng, n_harmonics=0):
    """Coefficients of a random rotor in multi-blade coordinates: a tower, three blades."""
    return tuple(rng.standard_normal((2 * n_harmonics + 1, *size)) for size in SIZES.values())


def at(coefficients, psi, step=1):
    """Matrices of a Fourier series at azimuths, its harmonics ``step`` apart."""
    K = len(coefficients[0]) // 2
    functions = [np.ones_like(psi)]
    for k in range(1, K + 1):
        functions += [np.cos(step * k * psi), np.sin(step * k * psi)]
    return tuple(np.tensordot(np.stack(functions, 1), M, axes=(1, 0)) for M in coefficients)


# ---- multi-blade coordinates ---------------------------------------------------------------------


def test_coleman_matrix_is_orthogonal_but_for_its_columns_sizes():
    t = coleman_matrix(np.linspace(0.0, 6.0, 7))
    size = np.broadcast_to(np.diag([3.0, 1.5, 1.5]), t.shape)
    np.testing.assert_allclose(t.transpose(0, 2, 1) @ t, size, atol=1e-14)


@pytest.mark.parametrize("order", [0, 1])
def test_derivatives_of_the_coleman_matrix(order):
    psi, h = np.linspace(0.0, 6.0, 7), 1e-6
    slope = (coleman_matrix(psi + h, order) - coleman_matrix(psi - h, order)) / (2 * h)
    np.testing.assert_allclose(slope, coleman_matrix(psi, order + 1), atol=1e-9)


@pytest.mark.parametrize("n_harmonics", [0, 1])
def test_there_and_back_is_the_identity(n_harmonics, rng):
    fixed = rotor(rng, n_harmonics)
    psi = np.linspace(0.0, 5.9, 23)
    turning = from_multiblade(fixed, OMEGA, FRAME)
    assert len(turning[0]) == 2 * (3 * n_harmonics + 2) + 1
    back = to_multiblade(at(turning, psi), psi, OMEGA, FRAME)
    for found, wanted in zip(back, at(fixed, psi, step=3), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_a_constant_rotor_moves_as_in_multiblade_coordinates(rng):
    """The responses of both forms are the same signals, seen from two frames."""
    fixed = rotor(rng)
    psi = np.linspace(0.0, 2.0, 20001)
    h = (psi[1] - psi[0]) / OMEGA
    F, _, P, _ = at(from_multiblade(fixed, OMEGA, FRAME), psi)
    A, C = fixed[0][0], fixed[2][0]
    t0 = coleman_matrix([0.0, psi[-1]])
    z = rng.standard_normal(8)
    x = z.copy()
    x[1:4], x[5:] = t0[0] @ z[1:4], t0[0] @ z[5:] + OMEGA * coleman_matrix([0.0], 1)[0] @ z[1:4]
    for k in range(0, len(psi) - 2, 2):  # Runge-Kutta, both by the same steps
        x = _step(x, (F[k], F[k + 1], F[k + 2]), 2 * h)
        z = _step(z, (A, A, A), 2 * h)
    measured, seen = P[-1] @ x, C @ z
    np.testing.assert_allclose(measured[0], seen[0], rtol=1e-8)
    np.testing.assert_allclose(measured[1:], t0[1] @ seen[1:], rtol=1e-8)


def _step(x, matrices, h):
    first, middle, last = matrices
    k1 = first @ x
    k2 = middle @ (x + h / 2 * k1)
    k3 = middle @ (x + h / 2 * k2)
    k4 = last @ (x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


# ---- files ---------------------------------------------------------------------------------------

STATES = [
    ("ED 1st tower fore-aft bending mode DOF (internal DOF index = DOF_TFA1), m", "F"),
    *(
        (f"ED 1st flap DOF of blade {b} (internal DOF index = DOF_BF({b},1)), m", "T")
        for b in (1, 2, 3)
    ),
]
RATES = [
    (text.replace("ED ", "ED First time derivative of ").replace(", m", ", m/s"), turns)
    for text, turns in STATES
]
PITCH = [(f"ED Blade {b} pitch command, rad", "T") for b in (1, 2, 3)]
MOMENTS = [(f"ED RootMyc{b}, (kN-m)", "T") for b in (1, 2, 3)]


def section(title, rows, order=""):
    lines = [f"Order of {title}:", "   Row/Column Operating Point  Rotating Frame?", "   -------"]
    for k, (text, turns) in enumerate(rows, 1):
        lines.append(f"  {k}  1.000E-01   {turns}   {order}   {text}")
    return [*lines, ""]


def lin_file(path, psi, rng=None, inputs=PITCH, outputs=MOMENTS, states=None, speed=OMEGA, order=2):
    """A .lin file of a random rotor, constant in multi-blade coordinates, at one azimuth."""
    states = STATES + RATES if states is None else states
    shapes = {
        "A": (len(states), len(states)),
        "B": (len(states), len(inputs)),
        "C": (len(outputs), len(states)),
        "D": (len(outputs), len(inputs)),
    }
    rng = rng or np.random.default_rng(0)
    fixed = tuple(rng.standard_normal((1, *shape)) for shape in shapes.values())
    frame = Frame(
        [(1, 2, 3), (5, 6, 7)],
        {(1, 2, 3): (5, 6, 7)},
        [(0, 1, 2)] if len(inputs) > 2 else [],
        [(0, 1, 2)] if len(outputs) > 2 else [],
    )
    matrices = at(from_multiblade(fixed, OMEGA, frame), np.array([psi]))
    lines = [
        "",
        "Linearized model: by hand",
        "Description from the FAST input file: three blades on a tower",
        "   Simulation time:   100.0 s",
        f"   Rotor Speed:   {speed} rad/s",
        f"   Azimuth:   {psi} rad",
        "   Wind Speed:   8.0 m/s",
        "",
        *section("continuous states", states, order),
        *section("continuous state derivatives", states, order),
        *section("inputs", inputs, "0"),
        *section("outputs", outputs, "0"),
        "Linearized state matrices:",
        "",
    ]
    for (name, shape), matrix in zip(shapes.items(), matrices, strict=True):
        if min(shape):
            lines.append(f"{name}: {shape[0]} x {shape[1]}")
            lines += ["  ".join(f"{value:.17e}" for value in row) for row in matrix[0]]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path, fixed


@pytest.fixture
def files(tmp_path):
    """Three azimuths of one rotor, and its matrices in multi-blade coordinates."""
    written = [lin_file(tmp_path / f"{k}.lin", psi) for k, psi in enumerate((0.1, 1.7, 4.0))]
    return [read_openfast_lin(path) for path, _ in written], [M[0] for M in written[0][1]]


def test_a_file_with_inputs_and_outputs_is_read(files):
    file = files[0][1]
    assert (file.azimuth, file.rotor_speed, file.wind_speed, file.simulation_time) == (
        1.7, OMEGA, 8.0, 100.0,
    )  # fmt: skip
    assert file.description == "three blades on a tower"
    assert list(file.states.index[:2]) == ["TFA1", "BF1_b1"]
    assert list(file.states.index[4:6]) == ["TFA1_dot", "BF1_b1_dot"]
    assert list(file.inputs.index) == [f"Blade {b} pitch command" for b in (1, 2, 3)]
    assert list(file.outputs.index) == ["RootMyc1", "RootMyc2", "RootMyc3"]
    assert file.states["rotating"].tolist() == 2 * [False, True, True, True]
    assert set(file.states["derivative_order"]) == {2}
    assert file.states["operating_point"].iloc[0] == 0.1
    assert file.B.shape == (8, 3)
    assert file.D.shape == (3, 3)


def test_multiblade_model_of_a_symmetric_rotor_is_exact(files):
    model = multiblade_model(files[0])
    for name, wanted in zip("ABCD", files[1], strict=True):
        np.testing.assert_allclose(getattr(model, name), wanted, atol=1e-12)
    assert model.state_labels[:4] == ["TFA1", "BF1_mean", "BF1_cos", "BF1_sin"]
    assert model.input_labels[1] == "Blade cos pitch command"
    assert model.output_labels[2] == "RootMyc_sin"


def test_rotor_system_passes_through_the_files(files):
    system = rotor_system(files[0])
    assert system.output_names == ("RootMyc1", "RootMyc2", "RootMyc3")
    for file in files[0]:
        psi = np.array([file.azimuth])
        for series, matrix in (
            (system.F, file.A), (system.G, file.B), (system.P, file.C), (system.Q, file.D),
        ):  # fmt: skip
            np.testing.assert_allclose(series(psi)[0], matrix, atol=1e-12)
    again = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(again.F(psi), system.F(psi))


def test_inputs_and_outputs_by_name(files):
    model = multiblade_model(files[0], inputs=["BF1_cos_dot"], outputs=["TFA1", "RootMyc_mean"])
    np.testing.assert_array_equal(model.B[:, 0], np.eye(8)[6])
    np.testing.assert_array_equal(model.C[0], np.eye(8)[0])
    np.testing.assert_array_equal(model.D, 0.0)
    system = rotor_system(files[0], inputs=["BF1_b2_dot"], outputs=["BF1_b3"])
    assert system.input_names == ("BF1_b2_dot",)
    np.testing.assert_allclose(system.G(np.array([0.3]))[0, :, 0], np.eye(8)[6])


def test_series_of_the_matrices_as_they_stand(tmp_path):
    """Two harmonics, five azimuths: the same system without any word of symmetry."""
    psi = (0.1, 1.4, 2.5, 3.9, 5.2)
    files = [
        read_openfast_lin(lin_file(tmp_path / f"{k}.lin", azimuth)[0])
        for k, azimuth in enumerate(psi)
    ]
    turning = rotor_system(files, coordinates="rotating", n_harmonics=2)
    wanted = rotor_system(files)
    np.testing.assert_allclose(turning.F.coefficients, wanted.F.coefficients, atol=1e-11)
    np.testing.assert_allclose(turning.Q.coefficients, wanted.Q.coefficients, atol=1e-11)


def test_names_that_repeat_themselves_stay_apart(tmp_path):
    outputs = [("ED Wind, (m/s)", "F"), ("AD Wind, (m/s)", "F"), ("AD Wind, (m/s)", "F")]
    path, _ = lin_file(tmp_path / "a.lin", 0.0, inputs=[], outputs=outputs[:2])
    assert list(read_openfast_lin(path).outputs.index) == ["ED Wind, (m/s)", "AD Wind, (m/s)"]
    text = path.read_text().replace("ED Wind", "AD Wind")
    path.write_text(text)
    assert list(read_openfast_lin(path).outputs.index) == [
        "AD Wind, (m/s) (1)", "AD Wind, (m/s) (2)",
    ]  # fmt: skip


def test_files_of_fast_8_have_no_derivative_order(tmp_path):
    path, _ = lin_file(tmp_path / "a.lin", 0.0, order="")
    file = read_openfast_lin(path)
    assert set(file.states["derivative_order"]) == {0}
    assert file.states.index[1] == "BF1_b1"


def test_orientations_of_three_numbers_are_read(tmp_path):
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    text = path.read_text().replace(
        "1.000E-01   T   0   ED RootMyc1", "1.000E-01, 2.000E-01, 3.0E-01   T   0   ED RootMyc1"
    )
    path.write_text(text)
    assert read_openfast_lin(path).outputs["operating_point"].iloc[0] == 0.1


def test_numbers_too_small_for_two_digits_of_exponent_are_read(tmp_path):
    """Fortran prints 1.5E-103 as 1.5-103."""
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    lines = path.read_text().splitlines()
    k = lines.index("A: 8 x 8") + 1
    lines[k] = "  ".join(["-1.500-103", *lines[k].split()[1:]])
    path.write_text("\n".join(lines))
    assert read_openfast_lin(path).A[0, 0] == -1.5e-103


@pytest.mark.parametrize("number", ["1.5E+01", "1.5D+01", "15", "15.", ".15e2", "+1.5d1"])
def test_numbers_of_c_and_of_fortran(tmp_path, number):
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    path.write_text(path.read_text().replace("8.0 m/s", f"{number} m/s"))
    assert read_openfast_lin(path).wind_speed == 15.0


@pytest.mark.parametrize(
    ("stated", "name", "value"),
    [
        ("Rotor Speed:   7 rpm", "rotor_speed", 7 * np.pi / 30),
        ("Rotor Speed:   7 RPM", "rotor_speed", 7 * np.pi / 30),
        ("Rotor Speed:   42.0 deg/s", "rotor_speed", 42 * np.pi / 180),
        ("Azimuth:   90 deg", "azimuth", np.pi / 2),
    ],
)
def test_units_are_read(tmp_path, stated, name, value):
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    label = stated.partition(":")[0]
    lines = path.read_text().splitlines()
    lines = [f"   {stated}" if line.strip().startswith(label) else line for line in lines]
    path.write_text("\n".join(lines))
    assert getattr(read_openfast_lin(path), name) == pytest.approx(value, rel=1e-15)


# ---- refusals ------------------------------------------------------------------------------------


ROW = "  1  1.000E-01   F   2   ED 1st"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Azimuth:", "Angle:", "the header does not give 'Azimuth'"),
        ("0.7 rad/s", "NaN rad/s", "'Rotor Speed' holds 'NaN', which is not a finite number"),
        ("0.7 rad/s", "******** rad/s", r"'Rotor Speed' holds '\*+', which is not a finite"),
        ("0.7 rad/s", "1e999 rad/s", "'Rotor Speed' holds '1e999', which is not a finite"),
        ("0.7 rad/s", "0_7 rad/s", "'Rotor Speed' holds '0_7', which is not a finite"),
        ("0.7 rad/s", "0.7 Hz", "the unit 'hz'; it must be rad/s or deg/s or rpm"),
        ("0.7 rad/s", "0.7", "the unit ''; it must be rad/s"),
        ("8.0 m/s", "8.0 knots", "'Wind Speed' has the unit 'knots'; it must be m/s"),
        (
            "0.7 rad/s",
            "0.7 rad/s\n  Number of inputs:  4",
            "says '4', but 'Order of inputs' lists 3",
        ),
        ("Wind Speed", "\0Wind Speed", "this is not text"),
        ("A: 8 x 8", "E: 8 x 8", "there is no matrix A"),
        ("D: 3 x 3", "E: 3 x 3", "there is no matrix D"),
        ("A: 8 x 8", "A: 9 x 8", "A is '9 x 8', but the file lists 8 states, 3 inputs"),
        ("A: 8 x 8", "A: 8 x 99999999999", "A is '8 x 99999999999', but the file lists 8"),
        ("A: 8 x 8", "A: eight x 8", "A is 'eight x 8', but the file lists 8"),
        ("B: 8 x 3", "A: 8 x 8", "A appears twice"),
        ("B: 8 x 3", "B: 8 x 3\n", "row 1 of B has 0 entries instead of 3"),
        ("B: 8 x 3", "B: 8 x 3\nNaN 0.0 0.0", "row 1 of B holds 'NaN', which is not a finite"),
        ("B: 8 x 3", "B: 8 x 3\n1.0 0,5 0.0", "row 1 of B holds '0,5', which is not a finite"),
        ("Order of inputs", "Order of outputs", "'Order of outputs' appears twice"),
        ("   -------", "", "'Order of continuous states' has no heading with a rule below it"),
        (ROW, ROW.replace("1.000E-01", "high"), "row 1 of a table holds 'high', which is no"),
        (ROW, ROW.replace("  1 ", "  2 "), "lists no signal"),
        (ROW, ROW.replace("F", "f"), "lists no signal"),
        (ROW, ROW.replace("1.000E-01", ""), "lists no signal"),
    ],
)
def test_broken_files_are_refused(tmp_path, old, new, message):
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as refusal:
        read_openfast_lin(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert str(refusal.value).endswith("; give a .lin file that OpenFAST wrote")


@pytest.mark.parametrize("rows", [0, 2])
def test_a_file_that_breaks_off_is_refused(tmp_path, rows):
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[: lines.index("D: 3 x 3") + 1 + rows]))
    with pytest.raises(ValueError, match=f"D ends after {rows} of 3 rows"):
        read_openfast_lin(path)


@pytest.mark.parametrize("name", ["none.lin", "."])
def test_no_file_and_a_folder(tmp_path, name):
    with pytest.raises(OSError, match=f"(No such file|Is a directory|denied).*{tmp_path.name}"):
        read_openfast_lin(tmp_path / name)


@pytest.mark.parametrize("path", [None, 3, b"a.lin", "a\0.lin"])
def test_no_path(path):
    with pytest.raises(ValueError, match=r"is not a path; give that of a \.lin file"):
        read_openfast_lin(path)


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "a.outb"
    path.write_bytes(np.random.default_rng(0).bytes(100_000))
    with pytest.raises(ValueError, match=r"a\.outb: this is not text; give a \.lin file"):
        read_openfast_lin(path)


def outcome(path):
    """The linearization that a file holds, or the words in which it is refused."""
    try:
        return read_openfast_lin(path)
    except ValueError as refusal:
        return str(refusal)


LONG = 300_000


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (ROW, ROW.replace("   F", " " * LONG + "G")),
        (ROW, f"  1  {'1 ' * LONG}"),
        (ROW, f"  1  {'1' * LONG}x  F  2  ED 1st"),
        ("DOF_TFA1), m", "DOF_" * LONG),
        ("DOF_TFA1), m", f"DOF_{'1' * LONG}"),
        ("A: 8 x 8", f"A: {'8' * LONG} x {' ' * LONG}"),
        ("A: 8 x 8", "A: 8 x 8\n" * (LONG // 10)),
        ("A: 8 x 8", f"A: 8 x 8\n{'1' * LONG}e"),
        ("0.7 rad/s", f"0.7{' ' * LONG}rad/s x"),
        ("0.7 rad/s", f"{'7' * LONG}x rad/s"),
        ("Order of inputs:", "Order of inputs:\n" * (LONG // 20)),
    ],
)
def test_reading_takes_time_in_proportion_to_the_text(tmp_path, old, new):
    """300 000 characters where a pattern that tries every split would take hours."""
    path, _ = lin_file(tmp_path / "a.lin", 0.0)
    path.write_text(path.read_text().replace(old, new, 1))
    start = time.process_time()
    assert len(str(outcome(path))) < 1000
    assert time.process_time() - start < 5.0


def test_a_long_table_without_its_matrix_takes_no_memory_for_it(tmp_path):
    states = [(f"ED state {k}, -", "F") for k in range(20_000)]
    lines = lin_file(tmp_path / "a.lin", 0.0)[0].read_text().splitlines()
    head = lines[: lines.index("Order of continuous states:")]
    path = tmp_path / "b.lin"
    path.write_text("\n".join([*head, *section("continuous states", states)]))
    with pytest.raises(ValueError, match="there is no matrix A"):
        read_openfast_lin(path)


SHIPPED = Path(load_wind_turbine().filenames[0]).read_text(encoding="utf-8")
JUNK = ["", "\n", " " * 50, "NaN", "-", "1e400", "9" * 30, "T", "A: 3 x 3\n", "\0", ":"]
PIECES = st.one_of(st.text(max_size=8), st.sampled_from(JUNK))


@pytest.mark.slow
@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_spoilt_file_gives_a_model_or_a_refusal_that_names_it(tmp_path, data):
    """Law: whatever is cut out, put in or moved, all that comes back is finite, and fits."""
    text = data.draw(st.sampled_from([SHIPPED, lin_file(tmp_path / "a.lin", 0.3)[0].read_text()]))
    for _ in range(data.draw(st.integers(1, 4))):
        first = data.draw(st.integers(0, len(text)))
        last = first + data.draw(st.sampled_from([0, 1, 3, 40, 2000, len(text)]))
        text = text[:first] + data.draw(PIECES) + text[last:]
    path = tmp_path / "spoilt.lin"
    path.write_bytes(text.encode("utf-8", errors="surrogatepass"))
    file = outcome(path)
    if isinstance(file, str):
        assert file.startswith(f"{path}: ")
        return
    n, m, n_outputs = len(file.states), len(file.inputs), len(file.outputs)
    assert [M.shape for M in (file.A, file.B, file.C, file.D)] == [
        (n, n), (n, m), (n_outputs, n), (n_outputs, m),
    ]  # fmt: skip
    numbers = [file.A, file.B, file.C, file.D, file.rotor_speed, file.azimuth, file.wind_speed]
    assert all(np.all(np.isfinite(value)) for value in numbers)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 0.8}, "rotor speeds of the files lie between 0.7 and 0.8"),
        ({"inputs": []}, "list different inputs"),
    ],
)
def test_files_that_do_not_belong_together(files, tmp_path, changes, message):
    other = read_openfast_lin(lin_file(tmp_path / "other.lin", 0.5, **changes)[0])
    with pytest.raises(ValueError, match=message):
        multiblade_model([*files[0], other])


def test_states_that_turn_without_three_blades(tmp_path):
    two = [row for row in STATES + RATES if "blade 3" not in row[0]]
    states = [*two, *(("ED filler, -", "F"), ("ED other, -", "F"))]
    path, _ = lin_file(tmp_path / "a.lin", 0.0, states=states)
    with pytest.raises(ValueError, match=r"BF1_b1.*are not states of three blades"):
        multiblade_model([read_openfast_lin(path)])


def test_rates_that_are_missing(tmp_path):
    states = [*STATES, RATES[0], *((f"ED lag of blade {b}, m", "T") for b in (1, 2, 3))]
    path, _ = lin_file(tmp_path / "a.lin", 0.0, states=states)
    with pytest.raises(ValueError, match="with a rate each"):
        rotor_system([read_openfast_lin(path)])


def test_signals_that_turn_with_the_shaft(tmp_path):
    outputs = [*MOMENTS, ("ED LSSTipMys, (kN-m)", "T")]
    files = [read_openfast_lin(lin_file(tmp_path / "a.lin", 0.0, outputs=outputs)[0])]
    with pytest.raises(ValueError, match=r"outputs=\['LSSTipMys'\] turn with the rotor"):
        multiblade_model(files)
    assert multiblade_model(files, outputs=["RootMyc_mean"]).noutputs == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inputs": ["TFA1"]}, r"inputs=\['TFA1'\] are not known; choose from \['Blade 1"),
        ({"outputs": ["RootMyc4"]}, r"outputs=\['RootMyc4'\] are not known"),
        ({"outputs": [3]}, "must name each signal in text"),
        ({"coordinates": "fixed"}, "coordinates='fixed' is not known"),
        ({"n_harmonics": -1}, "n_harmonics must be a whole number of at least 0"),
        ({"n_harmonics": 2}, "do not determine the 5 coefficients of harmonics"),
    ],
)
def test_settings_are_checked(files, settings, message):
    with pytest.raises(ValueError, match=message):
        rotor_system(files[0], **settings)


@pytest.mark.parametrize("given", [[], ["a.lin"], None])
def test_linearizations_are_wanted(given):
    with pytest.raises(ValueError, match="must be a list of results of read_openfast_lin"):
        multiblade_model(given)


def test_outputs_without_inputs():
    with pytest.raises(ValueError, match=r"such as inputs=\['TFA1_dot'\]"):
        multiblade_model(load_wind_turbine().linearizations, outputs=["TFA1"])


def test_one_file_is_enough(files):
    single = multiblade_model(files[0][0])
    np.testing.assert_allclose(single.A, files[1][0], atol=1e-12)
