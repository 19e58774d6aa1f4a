"""Simulated and measured records: make_* computes them with the truth, load_* reads them."""

from sklearn_hd.datasets._flapping_wing import make_flapping_wing
from sklearn_hd.datasets._hawkmoth import make_hawkmoth
from sklearn_hd.datasets._measured import (
    load_cd_player_arm,
    load_power_plant,
    load_robot_arm,
    load_slicot_example,
    load_wind_turbine,
)
from sklearn_hd.datasets._rotor import make_rotor

__all__ = [
    "load_cd_player_arm",
    "load_power_plant",
    "load_robot_arm",
    "load_slicot_example",
    "load_wind_turbine",
    "make_flapping_wing",
    "make_hawkmoth",
    "make_rotor",
]
