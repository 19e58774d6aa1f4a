"""Step 1, and the model classes: nonlinear and linear periodic systems, and named ones."""

from sklearn_hd.systems.arguments import FourierMatrix
from sklearn_hd.systems.export import export_model
from sklearn_hd.systems.flapping_flight import flapping_wing, hawkmoth
from sklearn_hd.systems.harmonic_transfer import (
    HarmonicTransferFunction,
    estimate_harmonic_transfer_function,
)
from sklearn_hd.systems.held_feedback import HeldFeedback
from sklearn_hd.systems.load import load_model
from sklearn_hd.systems.ltp import LTPSystem
from sklearn_hd.systems.openfast import OpenFASTLinearization, read_openfast_lin
from sklearn_hd.systems.periodic import PeriodicSystem, Trim
from sklearn_hd.systems.textbook import coupled_oscillators, duffing, flapping_blade, mathieu
from sklearn_hd.systems.turbines import multiblade_model, rotor_system

__all__ = [
    "FourierMatrix",
    "HarmonicTransferFunction",
    "HeldFeedback",
    "LTPSystem",
    "OpenFASTLinearization",
    "PeriodicSystem",
    "Trim",
    "coupled_oscillators",
    "duffing",
    "estimate_harmonic_transfer_function",
    "export_model",
    "flapping_blade",
    "flapping_wing",
    "hawkmoth",
    "load_model",
    "mathieu",
    "multiblade_model",
    "read_openfast_lin",
    "rotor_system",
]
