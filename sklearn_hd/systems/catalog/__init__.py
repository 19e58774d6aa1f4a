"""Named periodic systems of the literature, their parameters as keyword arguments."""

from sklearn_hd.systems.catalog.flapping_wing import flapping_wing
from sklearn_hd.systems.catalog.hawkmoth import hawkmoth
from sklearn_hd.systems.catalog.oscillators import (
    coupled_oscillators,
    duffing,
    mathieu,
    meissner,
)
from sklearn_hd.systems.catalog.rotor import flapping_blade
from sklearn_hd.systems.catalog.textbook import bittanti_colaneri, vinograd

__all__ = [
    "bittanti_colaneri",
    "coupled_oscillators",
    "duffing",
    "flapping_blade",
    "flapping_wing",
    "hawkmoth",
    "mathieu",
    "meissner",
    "vinograd",
]
