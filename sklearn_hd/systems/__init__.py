"""Step 1 and what a model is: periodic systems, nonlinear and linear, and a catalog."""

from sklearn_hd.systems.catalog import (
    bittanti_colaneri,
    coupled_oscillators,
    duffing,
    flapping_blade,
    flapping_wing,
    hawkmoth,
    mathieu,
    meissner,
    vinograd,
)
from sklearn_hd.systems.harmonic_transfer import (
    HarmonicTransferFunction,
    estimate_harmonic_transfer_function,
)
from sklearn_hd.systems.held_feedback import HeldFeedback
from sklearn_hd.systems.ltp import FourierMatrix, LTPSystem
from sklearn_hd.systems.multiblade import multiblade_model, rotor_system
from sklearn_hd.systems.openfast import OpenFASTLinearization, read_openfast_lin
from sklearn_hd.systems.periodic import PeriodicSystem
from sklearn_hd.systems.trim import Trim

__all__ = [
    "FourierMatrix",
    "HarmonicTransferFunction",
    "HeldFeedback",
    "LTPSystem",
    "OpenFASTLinearization",
    "PeriodicSystem",
    "Trim",
    "bittanti_colaneri",
    "coupled_oscillators",
    "duffing",
    "estimate_harmonic_transfer_function",
    "flapping_blade",
    "flapping_wing",
    "hawkmoth",
    "mathieu",
    "meissner",
    "multiblade_model",
    "read_openfast_lin",
    "rotor_system",
    "vinograd",
]
