"""Records and models that others measured or published, as shipped."""

from importlib.resources import files
from numbers import Real
from pathlib import Path

import numpy as np
import pandas as pd
from sklearn.utils import Bunch

from sklearn_hd.systems import read_openfast_lin

DAISY = (
    "B. De Moor (ed.), DaISy: Database for the Identification of Systems, Department of "
    "Electrical Engineering, ESAT/SISTA, KU Leuven; as packaged by SLICOT-SystemIdentification"
)
SLICOT = "SLICOT Library, example programs of IB01AD, IB01BD and IB01CD; SLICOT-Reference"
OPENFAST = "openfast_toolbox, OpenFAST's tools (NREL 5 MW reference turbine)"
TURBINES = {
    3: ("ws03.0.1.lin", "ws03.0.13.lin", "ws03.0.34.lin"),
    8: ("Main.1.lin", "Main.12.lin", "Main.24.lin"),
}


def load_robot_arm():
    """A flexible robot arm on an electric motor (DaISy): 1024 samples, one input, one output.

    The input is a periodic sine sweep. The sample time is not on record, so rows count as samples.

    Returns
    -------
    data : Bunch
        ``inputs`` (DataFrame: reaction_torque of the structure on the ground), ``outputs``
        (DataFrame: acceleration of the arm), ``sample_time`` (None), ``DESCR``,
        ``source``, ``licence``, ``filename``.

    References
    ----------
    B. De Moor (ed.), *DaISy: Database for the Identification of Systems*, KU Leuven.

    Examples
    --------
    >>> data = load_robot_arm()
    >>> data.inputs.shape, data.outputs.columns.tolist()
    ((1024, 1), ['acceleration'])
    """
    about = """\
A flexible robot arm, mounted on an electric motor and driven by a periodic sine sweep.
Input: reaction torque of the structure on the ground. Output: acceleration of the arm.
1024 samples; units and sample time are not on record. Contributed by W. Favoreel (KU Leuven).
"""
    return _record("robot_arm", 1, about, DAISY, "LICENSE-BSD-3-Clause")


def load_power_plant():
    """A 120 MW power plant at Pont-sur-Sambre (DaISy): 200 samples, five inputs, three outputs.

    Returns
    -------
    data : Bunch
        ``inputs`` (DataFrame: gas_flow, turbine_valves, superheater_spray_flow,
        gas_dampers, air_flow), ``outputs`` (DataFrame: steam_pressure,
        main_steam_temperature, reheat_steam_temperature), indexed by seconds;
        ``sample_time`` (1228.8 s), ``DESCR``, ``source``, ``licence``, ``filename``.

    References
    ----------
    R. P. Guidorzi, P. Rossi, "Identification of a power plant from normal operating
    records", Automatic Control Theory and Applications 2 (1974), 63-67.

    Examples
    --------
    >>> data = load_power_plant()
    >>> data.inputs.shape, data.outputs.shape, float(data.inputs.index[1])
    ((200, 5), (200, 3), 1228.8)
    """
    about = """\
The power plant of Pont-sur-Sambre (France), 120 MW, in normal operation. Inputs: gas flow,
opening of the turbine valves, spray flow of the superheater, gas dampers, air flow. Outputs:
steam pressure, main steam temperature, reheat steam temperature. 200 samples, one in 1228.8 s;
units are not on record. Contributed by P. Van Overschee (KU Leuven).
"""
    return _record("power_plant", 5, about, DAISY, "LICENSE-BSD-3-Clause", 1228.8)


def load_cd_player_arm():
    """The arm of a CD player (DaISy): 2048 samples, two inputs, two outputs.

    The record was measured in closed loop and converted to an equivalent record in open loop. The
    sample time is not on record, so rows count as samples.

    Returns
    -------
    data : Bunch
        ``inputs`` (DataFrame: force_1, force_2 of the actuators), ``outputs`` (DataFrame:
        tracking_1, tracking_2), ``sample_time`` (None), ``DESCR``, ``source``,
        ``licence``, ``filename``.

    References
    ----------
    P. M. J. Van den Hof, R. J. P. Schrama, "An indirect method for transfer function
    estimation from closed loop data", Automatica 29 (1993), 1523-1527.

    Examples
    --------
    >>> data = load_cd_player_arm()
    >>> data.inputs.shape, data.outputs.shape
    ((2048, 2), (2048, 2))
    """
    about = """\
The mechanical construction of a CD player arm. Inputs: forces of the mechanical actuators.
Outputs: tracking accuracy of the arm. Measured in closed loop, and converted to equivalent
open-loop data by a two-step procedure; the inputs are highly coloured. 2048 samples; units and
sample time are not on record. Contributed by W. Favoreel (KU Leuven); measured by R. de
Callafon (TU Delft).
"""
    return _record("cd_player_arm", 2, about, DAISY, "LICENSE-BSD-3-Clause")


def load_slicot_example():
    """The record of SLICOT's example programs of subspace identification: 1000 samples.

    Returns
    -------
    data : Bunch
        ``inputs`` (DataFrame: u), ``outputs`` (DataFrame: y), ``sample_time`` (None),
        ``DESCR``, ``source``, ``licence``, ``filename``.

    References
    ----------
    V. Sima, D. M. Sima, S. Van Huffel, "High-performance numerical algorithms and software
    for subspace-based linear multivariable system identification", Journal of Computational
    and Applied Mathematics 170 (2004), 371-397.

    Examples
    --------
    >>> load_slicot_example().outputs.shape
    (1000, 1)
    """
    about = """\
Input and output of the example programs of SLICOT's routines IB01AD, IB01BD and IB01CD, whose
results are published with them (15 block rows: order 4). 1000 samples of one input and one
output; units and sample time are not on record.
"""
    return _record("slicot_example", 1, about, SLICOT, "LICENSE-BSD-3-Clause-SLICOT-Reference")


def load_wind_turbine(wind_speed=3):
    """The NREL 5 MW wind turbine, linearised by OpenFAST at three azimuths.

    Parameters
    ----------
    wind_speed : {3, 8}, default=3
        In m/s. 3: 30 states (tower, yaw, drivetrain, blades), 0.7301 rad/s, azimuths 0°,
        120° and 330°. 8: 20 states (azimuth of the generator, blades), 0.9425 rad/s,
        azimuths 1°, 110° and 230°.

    Returns
    -------
    data : Bunch
        ``linearizations`` (list of OpenFASTLinearization), ``omega`` (rotor speed in
        rad/s), ``DESCR``, ``source``, ``licence``, ``filenames``.

    Raises
    ------
    ValueError
        For another wind speed.

    References
    ----------
    J. Jonkman, S. Butterfield, W. Musial, G. Scott, *Definition of a 5-MW Reference Wind
    Turbine for Offshore System Development*, NREL/TP-500-38060 (2009).

    Examples
    --------
    >>> data = load_wind_turbine()
    >>> data.omega, [round(file.azimuth, 4) for file in data.linearizations]
    (0.7301, [0.0067, 2.0948, 5.76])
    """
    if not isinstance(wind_speed, Real) or wind_speed not in TURBINES:
        raise ValueError(f"wind_speed={wind_speed!r} is not shipped; use 3 or 8 (m/s)")
    paths = [_path(name) for name in TURBINES[wind_speed]]
    linearizations = [read_openfast_lin(path) for path in paths]
    first = linearizations[0]
    about = f"""\
The NREL 5 MW reference wind turbine, linearised by OpenFAST about its periodic steady state at
three azimuths. Wind {first.wind_speed:g} m/s, rotor speed {first.rotor_speed:g} rad/s,
{len(first.states)} states, no inputs and no outputs. "{first.description}"
"""
    return Bunch(
        linearizations=linearizations,
        omega=first.rotor_speed,
        DESCR=about,
        source=OPENFAST,
        licence=_text("LICENSE-Apache-2.0"),
        filenames=[str(path) for path in paths],
    )


def _record(name, n_inputs, about, source, licence, sample_time=None):
    """Inputs and outputs of a CSV file, whose first columns are the inputs."""
    path = _path(f"{name}.csv")
    with path.open(encoding="utf-8") as file:
        columns = file.readline().strip().split(",")
        values = np.loadtxt(file, delimiter=",")
    index = None
    if sample_time is not None:
        index = pd.Index(sample_time * np.arange(len(values)), name="time")
    table = pd.DataFrame(values, index, columns)
    return Bunch(
        inputs=table.iloc[:, :n_inputs],
        outputs=table.iloc[:, n_inputs:],
        sample_time=sample_time,
        DESCR=about,
        source=source,
        licence=_text(licence),
        filename=str(path),
    )


def _path(name):
    return Path(str(files("sklearn_hd.datasets") / "data" / name))


def _text(name):
    return _path(name).read_text(encoding="utf-8")
